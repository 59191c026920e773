"""A merged preview of each session that follows its pose graph while agents run.

Sub-maps are appended as they were sent, each moved by its one transform; nothing is optimised. The
preview is built in a worker, one sub-map in memory at a time, and lies on disk. Whoever asks gets
the last one at once, at most a few seconds behind the pose graph.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import shutil
import time
from collections.abc import AsyncIterator
from concurrent.futures import Executor
from dataclasses import dataclass

from magicslam.v1 import mapping_service_pb2 as mapping_pb
from magicslam.v1 import submap_pb2

from magic_core.errors import NotFound, WrongState
from magic_core.wire import geometry, names, records
from magic_core.wire.convert import moment
from magic_server.coordinator import SessionCoordinator
from magic_server.jobs import JobExecutor
from magic_server.jobs.delivery import Deliveries, Delivery, JobFile
from magic_server.jobs.tasks import PlacedFiles, PreviewTask, append_submaps
from magic_server.preview_config import PreviewConfig
from magic_server.sending import open_chunks
from magic_server.sessions import Sessions
from magic_server.store import Store
from magic_server.store.blob_store import StreamedFile
from magic_server.tasks import TaskScope

logger = logging.getLogger(__name__)

PREVIEW_ID = "preview"
_FOLDER = "previews"
_REST = 10.0  # between two previews at least so many times as long as one takes
_TICK_S = 0.5


@dataclass(slots=True)
class _Preview:
    """The last preview of a session."""

    info: records.GlobalMapInfo
    files: dict[records.MapFormat, tuple[JobFile, str, int]]
    """The file, its SHA-256 in hex and its length for each format that was asked for."""
    delivery: Delivery
    took_s: float
    made_at: float
    """Monotonic clock."""
    readers: int = 0
    replaced: bool = False
    """Whether it goes with its last reader."""


class Previews:
    """The previews of all sessions of a server."""

    def __init__(
        self,
        store: Store,
        sessions: Sessions,
        *,
        jobs: JobExecutor,
        threads: Executor,
        config: PreviewConfig,
    ) -> None:
        self._store, self._sessions = store, sessions
        self._jobs, self._threads, self._config = jobs, threads, config
        self._root = store.scratch / _FOLDER
        self._deliveries = Deliveries(store, shares_folder=jobs.shares_folder)
        self._last: dict[int, _Preview] = {}
        self._locks: dict[int, asyncio.Lock] = {}
        self._seen: dict[int, int] = {}
        self._tasks = TaskScope("previews")

    async def start(self) -> None:
        """Drop what an earlier server left, and begin to follow the sessions' pose graphs."""
        await self._in_thread(shutil.rmtree, self._root, True)
        for coordinator in self._sessions.live():
            self._seen[coordinator.session.id] = coordinator.board.revision
        if self._config.enabled:
            self._tasks.start(self._follow(), name="follow")

    async def close(self) -> None:
        """Stop following."""
        await self._tasks.close()

    @contextlib.asynccontextmanager
    async def stream(
        self, session: str, kind: records.MapFormat
    ) -> AsyncIterator[tuple[records.GlobalMapInfo, str, int, AsyncIterator[submap_pb2.BlobChunk]]]:
        """The last preview of a session: what it is, its SHA-256 and length, and its chunks.

        Made now where there is none in this format. NotFound while no sub-map is placed.
        """
        last = await self._newest(session, kind)
        made, sha256, length = last.files[kind]
        async with self._reading(last):
            file = await self._in_thread(self._deliveries.opened, made)
            try:
                yield last.info, sha256, length, open_chunks(file, self._threads)
            finally:
                file.close()

    @contextlib.asynccontextmanager
    async def held(self, session: str) -> AsyncIterator[tuple[records.GlobalMapInfo, StreamedFile]]:
        """The last preview of a session and its lossless file, which stays there for the block.

        Made now where there is none. NotFound while no sub-map is placed.
        """
        last = await self._newest(session, "lossless")
        made, sha256, _ = last.files["lossless"]
        async with self._reading(last):
            yield last.info, self._deliveries.streamed(made, sha256)

    async def _newest(self, session: str, kind: records.MapFormat) -> _Preview:
        row = await self._store.agents.session(session)
        coordinator = await self._sessions.coordinator(row)
        await self._forget_deleted(coordinator)
        last = self._last.get(row.id)
        if last is None or kind not in last.files:
            # It is made to its end whoever leaves: a worker that has begun does not stop, and what
            # it leaves would lie there unknown.
            making = self._tasks.start(self._outcome(coordinator, kind), name="making")
            found = await asyncio.shield(making)
            if isinstance(found, Exception):
                raise found
            return found
        return last

    async def _outcome(
        self, coordinator: SessionCoordinator, kind: records.MapFormat
    ) -> _Preview | Exception:
        try:
            return await self._made(coordinator, kind)
        except Exception as error:  # whoever waits raises it
            return error

    async def _follow(self) -> None:
        """Build anew whatever session's pose graph has changed, one after another."""
        while True:
            await asyncio.sleep(_TICK_S)
            live = self._sessions.live()
            await self._drop_all_but({coordinator.session.id for coordinator in live})
            for coordinator in live:
                await self._forget_deleted(coordinator)
                if self._is_due(coordinator):
                    self._seen[coordinator.session.id] = coordinator.board.revision
                    with contextlib.suppress(NotFound):
                        await self._tried(coordinator)

    def _is_due(self, coordinator: SessionCoordinator) -> bool:
        session = coordinator.session.id
        if coordinator.board.revision <= self._seen.get(session, 0):
            return False
        last = self._last.get(session)
        if last is None:
            return True
        rest = max(self._config.interval_s, _REST * last.took_s)
        return time.monotonic() - last.made_at >= rest

    async def _tried(self, coordinator: SessionCoordinator) -> None:
        try:
            await self._made(coordinator, None)
        except NotFound:
            raise
        except Exception:
            # The last preview stays; the next change of the pose graph tries again.
            logger.exception("the preview of %s failed", coordinator.session.name)

    async def _made(
        self, coordinator: SessionCoordinator, asked: records.MapFormat | None
    ) -> _Preview:
        """Build a session's preview in all formats that were asked for so far."""
        session = coordinator.session
        async with self._locks.setdefault(session.id, asyncio.Lock()):
            last = self._last.get(session.id)
            if last is not None and asked in last.files:
                return last
            kinds: set[records.MapFormat] = set(last.files) if last else {"lossless"}
            kinds |= {asked} if asked else set()
            started = time.monotonic()
            snapshot = coordinator.board.snapshot
            chosen = _largest(snapshot)
            folder = self._root / str(session.id) / f"{snapshot.revision}-{time.monotonic_ns()}"
            delivery = self._deliveries.of(folder)
            placed = await self._placed(coordinator, chosen)
            task = PreviewTask(placed, tuple(sorted(kinds)), delivery)
            try:
                outcome = await self._jobs.run(append_submaps, task)
            except Exception:
                await self._in_thread(delivery.clear)
                raise
            info = records.GlobalMapInfo(
                name=names.map_name(session.name, PREVIEW_ID),
                component=chosen[0].component,
                revision=snapshot.revision,
                submaps=tuple(pose.submap for pose in chosen),
                gaussian_count=outcome.gaussian_count,
                created_at=moment(time.time()),
            )
            now = time.monotonic()
            files, took_s = dict(outcome.files), now - started
            made = _Preview(info, files, delivery, took_s=took_s, made_at=now)
            self._last[session.id] = made
            if last is not None:
                await self._replace(last)
            return made

    async def _placed(
        self, coordinator: SessionCoordinator, chosen: list[mapping_pb.CorrectedPose]
    ) -> tuple[PlacedFiles, ...]:
        placed = []
        for pose in chosen:
            _, agent, index = names.parse_submap(pose.submap)
            stored = await self._store.submaps.stored(coordinator.session, agent, index)
            transform = geometry.pose_from_proto(pose.world_from_anchor)
            placed.append(PlacedFiles(pose.submap, stored, transform))
        return tuple(placed)

    async def _forget_deleted(self, coordinator: SessionCoordinator) -> None:
        """Forget a preview that shows a sub-map which was deleted since."""
        last = self._last.get(coordinator.session.id)
        if last is not None:
            there = {pose.submap for pose in coordinator.board.snapshot.poses}
            if not there.issuperset(last.info.submaps):
                await self._forget(coordinator.session.id)

    async def _drop_all_but(self, live: set[int]) -> None:
        """Forget sessions that were deleted."""
        for session in self._last.keys() - live:
            await self._forget(session)

    async def _forget(self, session: int) -> None:
        if (last := self._last.pop(session, None)) is not None:
            await self._replace(last)
        await self._in_thread(shutil.rmtree, self._root / str(session), True)

    async def _replace(self, preview: _Preview) -> None:
        """Remove what nobody will ask for again, once nobody reads it."""
        preview.replaced = True
        if not preview.readers:
            await self._in_thread(preview.delivery.clear)

    @contextlib.asynccontextmanager
    async def _reading(self, preview: _Preview) -> AsyncIterator[None]:
        """Keep a preview's files for a block."""
        preview.readers += 1
        try:
            yield
        finally:
            preview.readers -= 1
            if preview.replaced and not preview.readers:
                await asyncio.shield(self._in_thread(preview.delivery.clear))

    async def _in_thread(self, function, *arguments):
        return await asyncio.get_running_loop().run_in_executor(self._threads, function, *arguments)


def _largest(snapshot: mapping_pb.PoseSnapshot) -> list[mapping_pb.CorrectedPose]:
    from magic_server.globalmaps import chosen_poses

    try:
        return chosen_poses(snapshot, "")
    except WrongState as error:
        raise NotFound(f"{snapshot.session} has no placed sub-maps yet; nothing to show") from error
