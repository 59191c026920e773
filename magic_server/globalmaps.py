"""Merging as an operation: wait for open loops, merge in a worker, keep the files."""

from __future__ import annotations

import asyncio
import dataclasses
import logging
import shutil
import time
from collections import Counter
from concurrent.futures import Executor
from pathlib import Path

from magicslam.v1 import global_map_service_pb2 as map_pb
from magicslam.v1 import mapping_service_pb2 as mapping_pb

from magic_core.errors import HeldElsewhere, InvalidInput, MagicError, NotFound, WrongState
from magic_core.wire import geometry, names, records
from magic_server.blockwise import BlockwiseMerge, is_blockwise
from magic_server.config import ServerConfig
from magic_server.coordinator import SessionCoordinator
from magic_server.jobs import JobExecutor
from magic_server.jobs.delivery import Deliveries, Delivery, JobFile
from magic_server.jobs.tasks import MergeOutcome, MergeTask, PlacedFiles, merge_submaps
from magic_server.seams import seams_of
from magic_server.sessions import Sessions
from magic_server.store import MapFile, NewMap, SessionRow, Store, WrittenBlob
from magic_server.store.blobs import translated_disk_errors
from magic_server.store.bucket import Delivered
from magic_server.tasks import TaskScope

logger = logging.getLogger(__name__)

_COPY_BYTES = 1 << 20
_MERGE_PREFIX = "merge-"


class GlobalMaps:
    """Operations that merge, and the progress of those under way."""

    def __init__(
        self,
        store: Store,
        sessions: Sessions,
        *,
        jobs: JobExecutor,
        threads: Executor,
        config: ServerConfig,
    ) -> None:
        self._store = store
        self._sessions = sessions
        self._jobs = jobs
        self._deliveries = Deliveries(store, shares_folder=jobs.shares_folder)
        self._threads = threads
        self._config = config
        self._tasks = TaskScope("global maps")
        self._under_way: dict[int, set[asyncio.Task[None]]] = {}
        self._handed_on: set[asyncio.Task[None]] = set()
        self._changed = asyncio.Event()
        self._stopping = False
        self._closing = False

    async def start(self, *, everything: bool = True) -> None:
        """Go on with every operation that a stopped server left open.

        Unless `everything` is taken up, that waits for `resume`.
        """
        left = await self._in_thread(self._deliveries.lasting)  # before: new ones may begin
        unfinished = await self._store.maps.unfinished()
        open_folders = {self._folder_of(operation.id) for operation in unfinished}
        for name in left - {folder.name for folder in open_folders}:
            await self._in_thread(self._delivery(self._store.scratch / name).clear)
        for leftover in self._store.scratch.glob(f"{_MERGE_PREFIX}*"):
            if leftover not in open_folders:
                await self._in_thread(shutil.rmtree, leftover, True)
        for operation in unfinished if everything else ():
            session = await self._store.agents.session(operation.session)
            self._begin(operation.id, session, operation.request)

    async def resume(self, session: SessionRow) -> None:
        """Go on with the operations of a session that this server has taken."""
        for operation in await self._store.maps.unfinished():
            if operation.session == session.name:
                self._begin(operation.id, session, operation.request)

    def dismiss_waiters(self) -> None:
        """Answer those who wait for an operation now: the server is stopping."""
        self._stopping = True
        self._notify()

    async def close(self) -> None:
        """Stop; operations under way go on after the next start."""
        self._closing = True
        await self._tasks.close()

    async def forget(self, session: SessionRow) -> None:
        """Stop what is under way in a session that is being deleted."""
        await _ended(set(self._under_way.pop(session.id, ())))

    async def hand_on(self, session: int) -> None:
        """Stop what is under way in a session, by row id, that another server may have: it goes on
        there, with what the jobs left in a bucket."""
        mine = set(self._under_way.pop(session, ()))
        self._handed_on |= mine
        try:
            await _ended(mine)
        finally:
            self._handed_on -= mine

    async def build(self, request: map_pb.BuildGlobalMapRequest) -> records.OperationStatus:
        """The operation of a request, begun now unless it was before."""
        name = names.parse_session(request.session, field="session")
        session = await self._store.agents.session(name)
        if not 0.0 <= request.drain_timeout_s <= 86400.0:
            raise InvalidInput.field("drain_timeout_s", "expected 0 to 86400 seconds")
        limit = self._config.limits.open_operations
        operation, new = await self._store.maps.begin(
            session, request, max_open=limit, now=time.time()
        )
        if new:
            self._begin(operation, session, request)
        return await self._store.maps.operation(name, str(operation))

    async def wait(
        self, session: str, operation: str, *, timeout_s: float, above_progress: float
    ) -> records.OperationStatus:
        """The operation once it is done or its progress is above a share, or after the timeout."""
        end = time.monotonic() + timeout_s
        while True:
            changed = self._changed
            status = await self._store.maps.operation(session, operation)
            left = end - time.monotonic()
            if status.done or left <= 0 or status.progress > above_progress or self._stopping:
                return status
            try:
                async with asyncio.timeout(left):
                    await changed.wait()
            except TimeoutError:
                continue

    def _begin(
        self, operation: int, session: SessionRow, request: map_pb.BuildGlobalMapRequest
    ) -> None:
        work = self._run(operation, session, request)
        task = self._tasks.start(work, name=f"{session.name}/{operation}")
        mine = self._under_way.setdefault(session.id, set())
        mine.add(task)
        task.add_done_callback(mine.discard)

    async def _run(
        self, operation: int, session: SessionRow, request: map_pb.BuildGlobalMapRequest
    ) -> None:
        try:
            with translated_disk_errors():
                await self._merge(operation, session, request)
        except HeldElsewhere as error:
            logger.warning("%s: its merge goes on there: %s", session.name, error)
        except MagicError as error:
            await self._store.maps.fail(operation, error, now=time.time())
        except Exception:
            logger.exception("merging %s failed", session.name)
            error = MagicError("the merge failed; the server's log says why")
            await self._store.maps.fail(operation, error, now=time.time())
        finally:
            self._notify()

    async def _merge(
        self, operation: int, session: SessionRow, request: map_pb.BuildGlobalMapRequest
    ) -> None:
        coordinator = await self._sessions.coordinator(session)
        await self._advance(operation, "PENDING", 0.0, "waiting for loops under verification")
        timeout_s = request.drain_timeout_s or self._config.limits.drain_timeout_s
        if not await coordinator.idle(timeout_s):
            logger.warning("%s: merging with loops still open", session.name)
        snapshot = coordinator.board.snapshot
        chosen = chosen_poses(snapshot, request.component)
        folder = self._folder_of(operation)
        await self._in_thread(lambda: folder.mkdir(exist_ok=True))
        delivery = self._delivery(folder)
        ours, ended = True, False
        try:
            try:
                task = await self._task(coordinator, chosen, request, delivery)
                outcome = await self._followed(operation, task, folder)
            except Exception as error:
                _require_all(coordinator, chosen, error)
                raise
            await self._keep(operation, session, snapshot.revision, chosen, outcome)
            ended = True
        except HeldElsewhere:
            ours = False
            raise
        finally:
            ours = ours and asyncio.current_task() not in self._handed_on
            # A server that stops keeps what it has, to go on from there.
            if ended or not self._closing:
                left = delivery if ours else None
                await asyncio.shield(self._in_thread(_clear, folder, left))

    def _delivery(self, folder: Path) -> Delivery:
        return self._deliveries.of(folder, lasting=True)

    def _folder_of(self, operation: int) -> Path:
        return self._store.scratch / f"{_MERGE_PREFIX}{operation}"

    async def _task(
        self,
        coordinator: SessionCoordinator,
        chosen: list[mapping_pb.CorrectedPose],
        request: map_pb.BuildGlobalMapRequest,
        delivery: Delivery,
    ) -> MergeTask:
        seams = await self._in_thread(seams_of, chosen, coordinator.graph.odometry_of)
        placed = []
        for pose in chosen:
            _, agent, index = names.parse_submap(pose.submap)
            stored = await self._store.submaps.stored(coordinator.session, agent, index)
            transform = geometry.pose_from_proto(pose.world_from_anchor)
            placed.append(PlacedFiles(pose.submap, stored, transform, seams[pose.submap]))
        config = self._config.merge
        if request.coarse_only:
            config = dataclasses.replace(config, refine=False, fill=False)
        return MergeTask(tuple(placed), config, self._config.jobs.merge_threads, delivery)

    async def _followed(self, operation: int, task: MergeTask, folder: Path) -> MergeOutcome:
        """Run the merge and store its progress while it goes on."""
        await self._advance(operation, "RUNNING", 0.0, "starting")
        if await self._in_thread(is_blockwise, task):
            merge = self._blockwise(task, folder)
            work, reported = merge.run(), merge.progress
        else:
            work, reported = self._jobs.run(merge_submaps, task), task.delivery.progress
        job = self._tasks.start(work, name="merge job")
        last = None
        try:
            while not job.done():
                await asyncio.wait([job], timeout=self._deliveries.poll_s)
                progress = await self._in_thread(reported)
                if progress is not None and progress != last:
                    last = progress
                    await self._advance(operation, "RUNNING", *progress)
            return job.result()
        finally:
            job.cancel()  # where the operation is given up

    def _blockwise(self, task: MergeTask, folder: Path) -> BlockwiseMerge:
        config = self._config.jobs
        at_once = config.merge_blocks
        if not at_once:
            at_once = 1 if config.executor == "pool" else self._jobs.workers
        return BlockwiseMerge(
            task, folder, jobs=self._jobs, deliveries=self._deliveries, at_once=at_once
        )

    async def _keep(
        self,
        operation: int,
        session: SessionRow,
        revision: int,
        chosen: list[mapping_pb.CorrectedPose],
        outcome: MergeOutcome,
    ) -> None:
        paths: dict[records.MapFormat, JobFile] = {
            "ply": outcome.ply,
            "lossless": outcome.lossless,
            "compact": outcome.compact,
        }
        files: dict[records.MapFormat, MapFile] = {}
        written: list[WrittenBlob] = []
        for kind, path in paths.items():
            blob = await self._in_thread(self._copied, path)
            written.append(blob)
            files[kind] = MapFile(blob.sha256, blob.length)
        made = NewMap(
            component=chosen[0].component,
            revision=revision,
            submaps=tuple(pose.submap for pose in chosen),
            gaussian_count=outcome.gaussian_count,
            files=files,
        )
        now = time.time()
        await self._store.add_map(operation, session, made, written=written, now=now)

    def _copied(self, path: JobFile) -> WrittenBlob:
        """A file of a merge as a blob that is ready to be adopted."""
        if isinstance(path, Delivered):
            return self._deliveries.adoptable(path)
        blob = self._store.blobs.writer()
        with path.open("rb") as file:
            while piece := file.read(_COPY_BYTES):
                blob.write(piece)
        blob.finish()
        return blob

    async def _advance(self, operation: int, state: str, progress: float, stage: str) -> None:
        await self._store.maps.advance(
            operation, state=state, progress=progress, stage=stage, now=time.time()
        )
        self._notify()

    def _notify(self) -> None:
        changed, self._changed = self._changed, asyncio.Event()
        changed.set()

    async def _in_thread(self, function, *arguments):
        return await asyncio.get_running_loop().run_in_executor(self._threads, function, *arguments)


def _clear(folder: Path, delivery: Delivery | None) -> None:
    """Remove a merge's folder, and what its jobs left."""
    if delivery is not None:
        delivery.clear()
    shutil.rmtree(folder, ignore_errors=True)


async def _ended(tasks: set[asyncio.Task[None]]) -> None:
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


def _require_all(
    coordinator: SessionCoordinator, chosen: list[mapping_pb.CorrectedPose], cause: Exception
) -> None:
    """Raise WrongState when a merge failed because a sub-map of it was deleted."""
    gone = [pose.submap for pose in chosen if pose.submap not in coordinator.graph]
    if gone:
        message = f"{gone[0]} was deleted while it was merged; build the map again"
        raise WrongState(message) from cause


def chosen_poses(
    snapshot: mapping_pb.PoseSnapshot, component: str
) -> list[mapping_pb.CorrectedPose]:
    """The poses of a component, the largest where none is named.

    A component that has been joined to an older one is found under any of its sub-maps' names.
    """
    if not snapshot.poses:
        raise WrongState(f"{snapshot.session} has no corrected sub-maps yet; nothing to merge")
    wanted = component or _largest_component(snapshot)
    wanted = next((pose.component for pose in snapshot.poses if pose.submap == wanted), wanted)
    chosen = [pose for pose in snapshot.poses if pose.component == wanted]
    if not chosen:
        raise NotFound(f"{snapshot.session} has no component {component!r}")
    return chosen


def _largest_component(snapshot: mapping_pb.PoseSnapshot) -> str:
    """The component with most sub-maps: the first in the list, or counted while none is listed."""
    if snapshot.components:
        return snapshot.components[0].id
    return Counter(pose.component for pose in snapshot.poses).most_common(1)[0][0]
