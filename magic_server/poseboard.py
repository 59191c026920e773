"""The newest pose graph solution of a session, and those who wait for the next."""

from __future__ import annotations

import asyncio

from magicslam.v1 import mapping_service_pb2 as mapping_pb

from magic_core.errors import MagicError, Unavailable
from magic_server.snapshot_changes import copied, copy_head, merge


class PoseBoard:
    """Holds one solution, the newest. A slow reader skips; nothing queues up for it.

    A change costs by its own size: the whole is copied only when somebody reads it.
    """

    def __init__(self, snapshot: mapping_pb.PoseSnapshot) -> None:
        self._whole = snapshot
        self._public: mapping_pb.PoseSnapshot | None = snapshot
        self._row: dict[str, int] = {}
        self._rows_of_agent: dict[str, list[int]] = {}
        self._of_agent: dict[str, mapping_pb.PoseSnapshot] = {}
        self._changed = asyncio.Event()
        self._closed: MagicError | None = None
        self.publish(snapshot)

    @property
    def snapshot(self) -> mapping_pb.PoseSnapshot:
        """The newest solution; never changed after it was handed out."""
        if self._public is None:
            self._public = copied(self._whole)
        return self._public

    @property
    def revision(self) -> int:
        """Its revision."""
        return self._whole.revision

    @property
    def bytes(self) -> int:
        """About how large the whole is when it is serialised."""
        return 150 * len(self._whole.poses)

    def holds(self, submaps: set[str]) -> bool:
        """Whether the solution has a pose for each of these sub-maps."""
        return submaps <= self._row.keys()

    def publish(self, snapshot: mapping_pb.PoseSnapshot) -> None:
        """Replace the solution and wake everyone who waits."""
        self._whole = self._public = snapshot
        self._row, self._rows_of_agent = {}, {}
        for row, pose in enumerate(snapshot.poses):
            self._index(pose.submap, row)
        self._wake()

    def apply(self, change: mapping_pb.PoseSnapshot) -> None:
        """A new revision, of which the message holds new and changed poses only, and wake all."""
        if self._public is self._whole:
            self._whole = copied(self._whole)
        self._public = None
        for name in merge(self._whole, change, self._row):
            self._index(name, len(self._row))
        self._wake()

    def merged(self, change: mapping_pb.PoseSnapshot) -> mapping_pb.PoseSnapshot:
        """The whole as `apply` would leave it; nothing is published."""
        whole = copied(self._whole)
        merge(whole, change, self._row)
        return whole

    def close(self, error: MagicError | None = None) -> None:
        """Send everyone who waits away: with the error, or because the server is stopping."""
        self._closed = error or Unavailable("the server is stopping; watch again later")
        self._wake()

    def of_agent(self, agent: str) -> mapping_pb.PoseSnapshot:
        """The newest solution with the poses of one agent only; made once per solution."""
        if agent not in self._of_agent:
            chosen = mapping_pb.PoseSnapshot()
            copy_head(self._whole, chosen)
            rows = self._rows_of_agent.get(agent, ())
            chosen.poses.extend(self._whole.poses[row] for row in rows)
            self._of_agent[agent] = chosen
        return self._of_agent[agent]

    async def newer_than(self, revision: int) -> None:
        """Wait until the solution's revision is above `revision`; raises once closed."""
        while self.revision <= revision or self._closed:
            if self._closed:
                raise self._closed
            await self._changed.wait()

    def _index(self, submap: str, row: int) -> None:
        self._row[submap] = row
        agent = submap.rpartition("/submaps/")[0]
        self._rows_of_agent.setdefault(agent, []).append(row)

    def _wake(self) -> None:
        self._of_agent.clear()
        changed, self._changed = self._changed, asyncio.Event()
        changed.set()
