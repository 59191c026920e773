"""What happens to a session's sub-maps after they are stored.

A new sub-map is compared with all others by descriptor; pairs that look alike are verified by
registration; the pose graph is solved again whenever a sub-map or an accepted loop arrives. The
heavy parts run as jobs. Everything is in the store before anyone hears of it, so that a server that
is started again goes on where it was.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import logging
from collections import OrderedDict, deque
from collections.abc import Awaitable, Callable, Iterator
from concurrent.futures import Executor

import numpy as np
from magicslam.v1 import mapping_service_pb2 as mapping_pb

from magic_core import logs, tracing
from magic_core.errors import CorruptData, DiskFull, NotFound, Unavailable
from magic_core.wire import names, records
from magic_server.config import ServerConfig
from magic_server.graph import SessionGraph
from magic_server.jobs import JobExecutor
from magic_server.jobs.tasks import verify_loop
from magic_server.loops import LoopCandidate, SubmapKey, left_over, select_candidates
from magic_server.metrics import Metrics
from magic_server.places import Hit, LocalPlaces, Place, Places
from magic_server.poseboard import PoseBoard
from magic_server.pruning import without
from magic_server.solving import Solving
from magic_server.store import Deleted, NewSolution, SessionRow, Store, StoredSubmap, Vertex
from magic_server.tasks import TaskScope

logger = logging.getLogger(__name__)

MAX_TRACES = 10_000
"""Sub-maps whose traces are remembered; the oldest is forgotten first."""
ROOM_RETRY_S = 2.0
"""Pause before work whose result a full disk did not take is done again."""
QUERY_MARGIN = 8
"""So many times more neighbours are fetched than candidates wanted, since some are left out."""


class SessionCoordinator:
    """One session's descriptor index, pending verifications, pose graph and newest solution."""

    def __init__(
        self,
        session: SessionRow,
        store: Store,
        *,
        jobs: JobExecutor,
        threads: Executor,
        config: ServerConfig,
        metrics: Metrics,
    ) -> None:
        self.session = session
        self._metrics = metrics
        self.graph = SessionGraph(session.name, config.posegraph)
        self._store = store
        self._jobs = jobs
        self._threads = threads
        self._config = config
        self._places: Places = store.places(session) or LocalPlaces(session.dimension, threads)
        # Held while the store and what is kept here change together.
        self._editing = asyncio.Lock()
        self._solving = Solving(
            session,
            self.graph,
            store=store,
            jobs=jobs,
            threads=threads,
            config=config.posegraph,
            editing=self._editing,
        )
        # The trace that brought a sub-map; what is made of the sub-map belongs to it.
        self._traces: OrderedDict[str, str] = OrderedDict()
        self._arrived: deque[Vertex] = deque()
        self._pending: deque[records.LoopCandidate] = deque()
        self._verifying = 0
        self._searching = False
        self._wake = asyncio.Event()
        self._work_done = asyncio.Condition()
        self._tasks = TaskScope(f"session {session.name}")

    async def start(self) -> None:
        """Rebuild everything from the store and begin to work."""
        await self._places.open()
        async for vertices in self._store.submaps.pages(self.session):
            for vertex in vertices:
                self.graph.add_vertex(vertex)
                if not vertex.searched:
                    self._arrived.append(vertex)
            await self._places.load([_place(vertex) for vertex in vertices if vertex.searched])
        for removed in await self._store.submaps.removed(self.session):
            self.graph.add_removed(removed)
        async for loops in self._store.loops.pages(self.session):
            for loop in loops:
                self.graph.set_loop(loop)
                if loop.verdict == "PENDING":
                    self._pending.append(loop)
        await self._solving.start(on_idle=self._tell_idle)
        for worker in range(self._jobs.workers):
            self._tasks.start(self._verify_for_ever(), name=f"verify {worker}", detached=True)
        self._tasks.start(self._search_for_ever(), name="search", detached=True)
        self._tasks.start(self._solving.take_in_for_ever(), name="take in", detached=True)
        self._tasks.start(self._solving.solve_for_ever(), name="solve", detached=True)
        self._tasks.start(self._solving.condense_for_ever(), name="condense", detached=True)

    @property
    def board(self) -> PoseBoard:
        """The newest poses, and those who wait for newer ones."""
        return self._solving.board

    async def close(self) -> None:
        """Stop working; what was begun is done again after the next start."""
        await self._tasks.close()

    def submap_stored(self, vertex: Vertex) -> None:
        """Tell of a sub-map that is durable. Returns at once."""
        self.graph.add_vertex(vertex)
        self._arrived.append(vertex)
        if (parent := tracing.traceparent()) is not None:
            self._traces[vertex.name] = parent
            if len(self._traces) > MAX_TRACES:
                self._traces.popitem(last=False)
        self._solving.wake()
        self._notify()

    async def remove(
        self,
        gone: Callable[[], set[str]],
        erase: Callable[[NewSolution | None], Awaitable[Deleted]],
        *,
        agent: str | None = None,
    ) -> Deleted:
        """Delete sub-maps: `erase` takes them out of the store, together with their poses.

        The solution without them is a new revision at once; then the graph is solved again.
        `agent` names an agent that goes with them; the odometry of others is carried on.
        """
        async with self._editing:
            message, solution = await self._pruned(gone())
            deleted = await erase(solution)
            # No await since the store's transaction: what it held is what is known here.
            removed = gone()
            self.graph.remove(removed, keep_odometry=agent is None)
            if agent is not None:
                self.graph.forget_removed(agent)
            self._arrived = deque(v for v in self._arrived if v.name not in removed)
            self._pending = deque(
                loop for loop in self._pending if removed.isdisjoint((loop.source, loop.target))
            )
            await self._solving.replace(message)
            await self._places.remove(removed)
        self._notify()
        await self._tell_idle()
        return deleted

    async def _pruned(
        self, gone: set[str]
    ) -> tuple[mapping_pb.PoseSnapshot | None, NewSolution | None]:
        """The newest solution without sub-maps, as a message and for the store."""
        snapshot = self.board.snapshot
        if not snapshot.revision:
            return None, None
        kept = await self._store.loops.kept(self.session)
        message = await self._in_thread(
            lambda: without(
                snapshot,
                gone,
                accepted=self.graph.loops_without(gone),
                kept=sum(gone.isdisjoint(ends) for ends in kept),
                known_starts=self.graph.known_starts,
            )
        )
        return message, NewSolution(message.revision, message.SerializeToString())

    @property
    def busy(self) -> bool:
        """Whether a search, a verification or a solve is waiting or under way."""
        waiting = self._arrived or self._pending or self._solving.busy
        return bool(waiting or self._searching or self._verifying)

    @property
    def waiting_searches(self) -> int:
        """Sub-maps whose loops are still to be looked for."""
        return len(self._arrived)

    @property
    def pending_loops(self) -> int:
        """Candidates that wait for, or are under, verification."""
        return len(self._pending) + self._verifying

    async def idle(self, timeout_s: float) -> bool:
        """Wait until nothing is left to do; False when that took too long."""
        try:
            async with asyncio.timeout(timeout_s), self._work_done:
                await self._work_done.wait_for(lambda: not self.busy)
        except TimeoutError:
            return False
        return True

    async def placed(self, agent: str, *, timeout_s: float) -> bool:
        """Wait until the newest solution holds every sub-map that an agent has stored by now.

        `agent` is its resource name. False when that took too long.
        """
        wanted = self.graph.names_of(agent)
        try:
            async with asyncio.timeout(timeout_s):
                while not self.board.holds(wanted & self.graph.names_of(agent)):
                    await self.board.newer_than(self.board.revision)
        except TimeoutError:
            return False
        return True

    async def nearest(
        self, vector: np.ndarray, *, count: int, min_similarity: float
    ) -> list[records.LoopCandidate]:
        """The sub-maps most similar to a raw descriptor (d,), best first."""
        hits = await self._places.nearest(vector[None], count)
        return [
            _candidate("", hit, "SIMILAR", "NOT_VERIFIED")
            for hit in hits
            if hit.similarity >= min_similarity
        ]

    # Search: which pairs look alike

    async def _search_for_ever(self) -> None:
        while True:
            if not self._arrived:
                await self._sleep()
                continue
            self._searching = True
            vertex = self._arrived.popleft()
            try:
                with self._about(vertex.name, "search loops"):
                    async with self._editing:
                        await self._search(vertex)
            except (DiskFull, Unavailable) as error:
                await self._wait_for_room(error)
                self._arrived.appendleft(vertex)
            except Exception:
                # The store does not say "searched": the next start looks again.
                logger.exception("looking for loops of %s failed", vertex.name)
            finally:
                self._searching = False
                await self._tell_idle()

    async def _search(self, vertex: Vertex) -> None:
        if vertex.name not in self.graph:
            return  # deleted meanwhile
        config = self._config.loops
        hits = await self._places.nearest(_views(vertex), config.top_k * QUERY_MARGIN)
        await self._places.add(_place(vertex))  # it is there when the disk was full before
        chosen = select_candidates(
            self._key(vertex.name),
            [(self._key(hit.name), hit.similarity) for hit in hits],
            config,
            model_id=self.session.model_id,
            is_known_pair=self.graph.knows_pair,
        )
        chosen += await self._chosen_by_older(vertex, hits, chosen)
        hit_of = {hit.name: hit for hit in hits}
        found = [_pending(vertex, hit_of[candidate.hit.name]) for candidate in chosen]
        await self._store.loops.add_candidates(self.session, vertex.name, found)
        for loop in found:
            self.graph.set_loop(loop)
        self._pending.extend(found)
        logger.info("%s: %d loop candidates", vertex.name, len(found))
        self._notify()

    async def _chosen_by_older(
        self, vertex: Vertex, hits: list[Hit], chosen: list[LoopCandidate]
    ) -> list[LoopCandidate]:
        """Older sub-maps that would choose the new one, where it had no room for them."""
        config, model_id = self._config.loops, self.session.model_id
        keys = [(self._key(hit.name), hit.similarity) for hit in hits]
        query = self._key(vertex.name)
        found = []
        for candidate in left_over(
            query, keys, chosen, config, model_id=model_id, is_known_pair=self.graph.knows_pair
        ):
            _, agent, index = names.parse_submap(candidate.hit.name)
            try:
                older = await self._store.submaps.vertex(self.session, agent, index)
            except NotFound:  # deleted meanwhile
                continue
            around = await self._places.nearest(_views(older), config.top_k * QUERY_MARGIN)
            would = select_candidates(
                candidate.hit,
                [(self._key(hit.name), hit.similarity) for hit in around],
                config,
                model_id=model_id,
            )
            if query in [other.hit for other in would]:
                found.append(candidate)
        return found

    # Verification: which of them are the same place

    async def _verify_for_ever(self) -> None:
        while True:
            if not self._pending:
                await self._sleep()
                continue
            loop = self._pending.popleft()
            self._verifying += 1
            try:
                with self._about(loop.source, "verify loop", target=loop.target):
                    settled = await self._verified(loop)
                async with self._editing:
                    if loop.source not in self.graph or loop.target not in self.graph:
                        continue  # deleted meanwhile
                    await self._store.loops.settle(self.session, settled)
                    self.graph.set_loop(settled)
                self._metrics.loops.labels(settled.reason).inc()
                if settled.verdict == "ACCEPTED":
                    self._solving.wake()
            except (DiskFull, Unavailable) as error:
                await self._wait_for_room(error)
                self._pending.appendleft(loop)
            except Exception:
                # The store still says "pending": the next start verifies again.
                logger.exception("storing the verdict on %s failed", loop.source)
            finally:
                self._verifying -= 1
                await self._tell_idle()

    async def _verified(self, loop: records.LoopCandidate) -> records.LoopCandidate:
        """The candidate with its verdict; a job that fails is a refusal with its own reason."""
        try:
            source, target = await self._stored(loop.source), await self._stored(loop.target)
            keyframes = loop.source_keyframe, loop.target_keyframe
            config = self._config.registration
            result = await self._jobs.run(verify_loop, source, target, config, keyframes)
        except Exception as error:
            logger.exception("verification of %s -> %s failed", loop.source, loop.target)
            damaged = isinstance(error, CorruptData)
            reason = error.reason if damaged else "VERIFICATION_FAILED"
            return dataclasses.replace(loop, verdict="REJECTED", reason=reason)
        logger.info("%s -> %s: %s", loop.source, loop.target, result.reason)
        return dataclasses.replace(
            loop,
            verdict="ACCEPTED" if result.accepted else "REJECTED",
            reason=result.reason,
            target_from_source=result.target_from_source if result.accepted else None,
            information=result.information if result.accepted else None,
            fitness=float(result.fitness),
            rmse_m=float(result.rmse_m),
            inliers=int(result.inliers),
            overlap=float(result.overlap),
            verify_seconds=float(result.seconds),
        )

    async def _stored(self, name: str) -> StoredSubmap:
        _, agent, index = names.parse_submap(name)
        return await self._store.submaps.stored(self.session, agent, index)

    @contextlib.contextmanager
    def _about(self, submap: str, doing: str, **attributes: str) -> Iterator[None]:
        """Logs and traces of a block say which sub-map it is about."""
        _, agent, index = names.parse_submap(submap)
        ids = {"session": self.session.name, "agent": agent, "submap": str(index)}
        parent = self._traces.get(submap)
        with logs.bound(**ids), tracing.span(doing, parent=parent, **ids, **attributes):
            yield

    async def _wait_for_room(self, error: DiskFull | Unavailable) -> None:
        logger.warning("%s: %s", self.session.name, error)
        await asyncio.sleep(ROOM_RETRY_S)

    # Waiting and waking

    def _notify(self) -> None:
        wake, self._wake = self._wake, asyncio.Event()
        wake.set()

    async def _sleep(self) -> None:
        await self._wake.wait()

    async def _tell_idle(self) -> None:
        if not self.busy:
            async with self._work_done:
                self._work_done.notify_all()

    def _key(self, name: str) -> SubmapKey:
        session, agent, index = names.parse_submap(name)
        agent_name = names.agent_name(session, agent)
        return SubmapKey(agent=agent_name, index=index, name=name, span_s=self.graph.span_of(name))

    async def _in_thread(self, function, *arguments):
        return await asyncio.get_running_loop().run_in_executor(self._threads, function, *arguments)


def _place(vertex: Vertex) -> Place:
    return Place(vertex.name, vertex.descriptor.vector, vertex.keyframes)


def _views(vertex: Vertex) -> np.ndarray:
    """The descriptors (n, d) by which a sub-map looks for others, the anchor's first."""
    return np.stack([vertex.descriptor.vector, *(vector for _, vector in vertex.keyframes)])


def _pending(vertex: Vertex, hit: Hit) -> records.LoopCandidate:
    """A candidate that waits for its verification."""
    places = (0, *(place for place, _ in vertex.keyframes))
    found = _candidate(vertex.name, hit, "PENDING", "PENDING")
    return dataclasses.replace(found, source_keyframe=places[hit.query])


def _candidate(
    source: str, hit: Hit, verdict: records.Verdict, reason: str
) -> records.LoopCandidate:
    return records.LoopCandidate(
        source, hit.name, hit.similarity, verdict, reason, target_keyframe=hit.keyframe
    )
