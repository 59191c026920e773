"""Keeps a session's solution up to date: at once where that is certain, exactly a little later.

Three tasks. One takes in what is new (sub-maps, accepted loops, finished solves), stores the change
and publishes it as a revision; that takes milliseconds, however large the graph, or tenths of a
second where it is condensed by regions (`posegraph.regional`). The second solves the whole graph in
a worker process whenever something is unsettled, and rests between two solves for as long as one
took, so that it never takes more than half of a worker: robustly where a loop is in doubt, else
exactly with what counts. The third condenses a large graph, a bit at a time. Nothing waits for the
last two: what comes meanwhile is taken in, and carried along when they are done.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable
from concurrent.futures import Executor
from typing import TypeVar

from magicslam.v1 import mapping_service_pb2 as mapping_pb

from magic_core import logs, tracing
from magic_core.errors import DiskFull, Unavailable
from magic_server.graph import SessionGraph
from magic_server.jobs import JobExecutor
from magic_server.jobs.settling import settle_pose_graph
from magic_server.jobs.tasks import solve_pose_graph
from magic_server.poseboard import PoseBoard
from magic_server.posegraph.arrays import ArraySolution, GraphArrays
from magic_server.posegraph.problem import PoseGraphConfig
from magic_server.posegraph.regional import Regions
from magic_server.posegraph.settlement import CountedArrays, Optimum
from magic_server.posegraph.telling import Change
from magic_server.store import SessionRow, Store

logger = logging.getLogger(__name__)
T = TypeVar("T")

RETRY_S = 1.0
MAX_REST_S = 300.0
JOURNAL_SHARE = 0.5
"""Changes are stored one by one until together they are this large, relative to the whole."""
LEAST_JOURNAL_BYTES = 100_000


class Solving:
    """Owns a session's newest solution.

    `editing` is held while the store and what is kept in memory change together.
    """

    def __init__(
        self,
        session: SessionRow,
        graph: SessionGraph,
        *,
        store: Store,
        jobs: JobExecutor,
        threads: Executor,
        config: PoseGraphConfig,
        editing: asyncio.Lock,
    ) -> None:
        self.board = PoseBoard(graph.empty_snapshot())
        self._session = session
        self._graph = graph
        self._store = store
        self._jobs = jobs
        self._threads = threads
        self._config = config
        self._editing = editing
        self._finished: tuple[int, ArraySolution | Optimum] | None = None
        self._condensed: tuple[int, Regions] | None = None
        self._stepping = False
        self._computing = False
        self._journal_bytes = 0
        self._news = asyncio.Event()
        self._unsettled = asyncio.Event()
        self._uncondensed = asyncio.Event()
        self._on_idle: Callable[[], Awaitable[None]] = _nothing

    async def start(self, *, on_idle: Callable[[], Awaitable[None]]) -> None:
        """Take up the stored solution; the graph must hold all sub-maps and loops."""
        stored = await self._store.loops.solution(self._session)
        if stored.whole is not None:
            self.board.publish(mapping_pb.PoseSnapshot.FromString(stored.whole))
        for change in stored.changes:
            self.board.apply(mapping_pb.PoseSnapshot.FromString(change))
        self._journal_bytes = sum(len(change) for change in stored.changes)
        self._on_idle = on_idle
        await self._restore(settled=stored.settled)
        self.wake()

    def wake(self) -> None:
        """There is something new in the graph."""
        self._news.set()

    @property
    def busy(self) -> bool:
        """Whether the solution is not yet what it would be if nothing more came."""
        waiting = self._graph.has_news or self._finished or self._graph.online.wants_solve
        return bool(waiting or self._stepping or self._computing)

    async def replace(self, snapshot: mapping_pb.PoseSnapshot | None) -> None:
        """Sub-maps were deleted: go on from a solution without them, which the store holds."""
        if snapshot is not None:
            self.board.publish(snapshot)
        self._journal_bytes = 0
        self._finished = self._condensed = None
        await self._restore()
        self.wake()

    async def take_in_for_ever(self) -> None:
        """Take in what is new, whenever there is something."""
        while True:
            await self._news.wait()
            self._news.clear()
            self._stepping = True
            try:
                async with self._editing:
                    await self._take_in()
            except (DiskFull, Unavailable) as error:
                logger.warning("%s: %s", self._session.name, error)
                await self._try_again()
            except Exception:
                logger.exception("publishing the poses of %s failed", self._session.name)
                await self._try_again()
            finally:
                self._stepping = False
            self._ask()
            await self._on_idle()

    def _ask(self) -> None:
        """Wake those whose turn it is."""
        if self._graph.online.wants_solve:
            self._unsettled.set()
        if self._graph.online.is_uncondensed:
            self._uncondensed.set()
        if self._graph.has_news:  # it was too much for one step
            self._news.set()

    async def solve_for_ever(self) -> None:
        """Solve the whole graph in a worker, whenever that may change something."""
        while True:
            await self._unsettled.wait()
            self._unsettled.clear()
            if not self._graph.online.wants_solve:
                continue
            started = time.perf_counter()
            self._computing = True
            doubt = True
            try:
                async with self._editing:
                    edition, doubt = self._graph.edition, self._graph.online.unsettled
                    arrays = await self._in_thread(self._asked, doubt)
                with logs.bound(session=self._session.name), tracing.span("solve pose graph"):
                    if isinstance(arrays, CountedArrays):
                        solution = await self._jobs.run(settle_pose_graph, arrays)
                    else:
                        solution = await self._jobs.run(solve_pose_graph, arrays, self._config)
                self._finished = edition, solution
                self._news.set()
            except Exception:
                # The last solution stays; a worker may be back in a moment.
                logger.exception("solving the pose graph of %s failed", self._session.name)
                self._graph.online.unsettled |= doubt
                self._graph.online.bent |= not doubt
                self._unsettled.set()
                await asyncio.sleep(RETRY_S)
            finally:
                self._computing = False
            await asyncio.sleep(min(time.perf_counter() - started, MAX_REST_S))

    async def condense_for_ever(self) -> None:
        """Condense a large graph, a bit at a time, whenever its regions are missing or outgrown."""
        while True:
            await self._uncondensed.wait()
            self._uncondensed.clear()
            if self._condensed is not None or not self._graph.online.is_uncondensed:
                continue
            started = time.perf_counter()
            try:
                async with self._editing:
                    edition = self._graph.edition
                    outline = await self._in_thread(self._graph.online.outline)
                regions = await self._in_thread(outline.begin)
                while not await self._in_thread(regions.go_on):
                    if edition != self._graph.edition:
                        break  # deleted meanwhile: it is asked for again
                else:
                    self._condensed = edition, regions
                self._news.set()
            except Exception:
                # Without regions, loops go on to move their neighbourhoods.
                logger.exception("condensing the pose graph of %s failed", self._session.name)
                self._uncondensed.set()
                await asyncio.sleep(RETRY_S)
            await asyncio.sleep(min(time.perf_counter() - started, MAX_REST_S))

    async def _take_in(self) -> None:
        finished, condensed = self._finished, self._condensed
        self._finished = self._condensed = None
        solution = self._usable(finished)
        change = await self._in_thread(self._graph.advance, solution, self._usable(condensed))
        if change or solution is not None:
            await self._publish(change)

    def _asked(self, doubt: bool) -> GraphArrays | CountedArrays:
        """What a solve of the whole is to work on."""
        return self._graph.online.arrays() if doubt else self._graph.online.counted()

    def _usable(self, found: tuple[int, T] | None) -> T | None:
        """What was found, unless the graph was begun anew since it was asked for."""
        return found[1] if found is not None and found[0] == self._graph.edition else None

    async def _publish(self, change: Change) -> None:
        revision = self.board.revision + 1
        settled = not self._graph.online.wants_solve
        message = await self._in_thread(self._graph.message, change, revision)
        data = message.SerializeToString()
        if self._journal_is_long(len(data)):
            whole = await self._in_thread(self.board.merged, message)
            data = await self._in_thread(whole.SerializeToString)
            kept = self._graph.kept_loops()
            await self._store.loops.save_solution(
                self._session, revision=revision, snapshot=data, kept=kept, settled=settled
            )
            self._journal_bytes = 0
            self.board.publish(whole)
        else:
            await self._store.loops.save_change(
                self._session,
                revision=revision,
                change=data,
                taken_up=self._graph.ends_of(change.taken_up),
                dropped=self._graph.ends_of(change.dropped),
                settled=settled,
            )
            self._journal_bytes += len(data)
            self.board.apply(message)
        self._graph.remember(change)
        logger.info(
            "%s: revision %d: %d sub-maps placed or moved (up to %.4f m), %d loops taken up, "
            "%d dropped, %d components",
            self._session.name, revision, len(change.vertices), change.largest_move_m,
            len(change.taken_up), len(change.dropped), len(message.components),
        )  # fmt: skip

    async def _try_again(self) -> None:
        """What was published stays; the graph goes back to it and takes in the rest once more."""
        await asyncio.sleep(RETRY_S)
        async with self._editing:
            await self._restore()
        self._news.set()

    async def _restore(self, *, settled: bool = False) -> None:
        facts = self._graph.facts()
        await self._in_thread(self._graph.restore, facts, self.board.snapshot, settled)

    def _journal_is_long(self, added: int) -> bool:
        limit = max(JOURNAL_SHARE * self.board.bytes, LEAST_JOURNAL_BYTES)
        return not self.board.revision or self._journal_bytes + added > limit

    async def _in_thread(self, function, *arguments):
        return await asyncio.get_running_loop().run_in_executor(self._threads, function, *arguments)


async def _nothing() -> None:
    pass
