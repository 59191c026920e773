"""The newest pose graph solution of a session, and those who wait for the next."""

from __future__ import annotations

import asyncio

from magicslam.v1 import mapping_service_pb2 as mapping_pb

from magic_core.errors import MagicError, Unavailable
from magic_core.wire import convert


class PoseBoard:
    """Holds one solution, the newest. A slow reader skips; nothing queues up for it."""

    def __init__(self, snapshot: mapping_pb.PoseSnapshot) -> None:
        self._snapshot = snapshot
        self._of_agent: dict[str, mapping_pb.PoseSnapshot] = {}
        self._changed = asyncio.Event()
        self._closed: MagicError | None = None

    @property
    def snapshot(self) -> mapping_pb.PoseSnapshot:
        """The newest solution; never changed after it was published."""
        return self._snapshot

    @property
    def revision(self) -> int:
        """Its revision."""
        return self._snapshot.revision

    def publish(self, snapshot: mapping_pb.PoseSnapshot) -> None:
        """Replace the solution and wake everyone who waits."""
        self._snapshot = snapshot
        self._of_agent.clear()
        self._wake()

    def close(self, error: MagicError | None = None) -> None:
        """Send everyone who waits away: with the error, or because the server is stopping."""
        self._closed = error or Unavailable("the server is stopping; watch again later")
        self._wake()

    def of_agent(self, agent: str) -> mapping_pb.PoseSnapshot:
        """The newest solution with the poses of one agent only; made once per solution."""
        if agent not in self._of_agent:
            self._of_agent[agent] = convert.snapshot_of_agent(self._snapshot, agent)
        return self._of_agent[agent]

    async def newer_than(self, revision: int) -> None:
        """Wait until the solution's revision is above `revision`; raises once closed."""
        while self.revision <= revision or self._closed:
            if self._closed:
                raise self._closed
            await self._changed.wait()

    def _wake(self) -> None:
        changed, self._changed = self._changed, asyncio.Event()
        changed.set()
