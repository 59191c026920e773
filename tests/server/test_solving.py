"""A session's solution while solves of the whole run elsewhere: nothing waits, nothing is lost."""

from __future__ import annotations

import asyncio
import contextlib
import copy
import itertools
import uuid
from collections.abc import AsyncIterator, Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from magic_core.errors import Unavailable
from magic_core.submap import Descriptor, OdometryEdge
from magic_core.wire import convert, names, records
from magic_server import solving
from magic_server.graph import SessionGraph
from magic_server.jobs import JobConfig, ProcessExecutor
from magic_server.posegraph import Edge, PoseGraphConfig
from magic_server.posegraph.settlement import settled
from magic_server.posegraph.simulated import agents_in_a_hall
from magic_server.pruning import without
from magic_server.solving import Solving
from magic_server.store import Store, Vertex
from magic_server.store.agents import Asked
from tests.waiting import eventually

LARGE = PoseGraphConfig(
    odometry_floor_m=0, odometry_floor_rad=0, odometry_floor_share=0, hierarchy="on"
)
AGENTS, SUBMAPS = 2, 24
WAIT_S = 120.0


class Gated(ProcessExecutor):
    """Runs jobs in processes, once it is told to; jobs can be made to fail before."""

    def __init__(self) -> None:
        super().__init__(JobConfig(workers=1))
        self.open = asyncio.Event()
        self.open.set()
        self.failures = 0
        self.asked: list[str] = []

    async def run(self, function: Callable[..., Any], /, *arguments: Any) -> Any:
        self.asked.append(function.__name__)
        await self.open.wait()
        if self.failures:
            self.failures -= 1
            raise Unavailable("no workers")
        return await super().run(function, *arguments)


def name_of(agent: int, index: int) -> str:
    return names.submap_name("room", f"agent_{agent}", index)


class Hall:
    """What a simulated session would send, by resource names."""

    def __init__(self) -> None:
        problem = agents_in_a_hall(
            agents=AGENTS, submaps=SUBMAPS, loops=150, seed=3, side_m=8.0
        ).problem
        renamed = {f"agent_{a}/{i}": name_of(a, i) for a in range(AGENTS) for i in range(SUBMAPS)}
        self.odometry = {renamed[edge.target]: edge for edge in problem.odometry}
        self.loops = [
            loop_of(renamed[edge.target], renamed[edge.source], edge) for edge in problem.loops
        ]

    def vertex(self, agent: int, index: int) -> Vertex:
        edge, odometry = self.odometry.get(name_of(agent, index)), None
        if edge is not None:
            odometry = OdometryEdge(index - 1, edge.source_from_target, edge.information)
        return Vertex(
            name=name_of(agent, index),
            agent=names.agent_name("room", f"agent_{agent}"),
            odometry=odometry,
            prior=None,
            span_s=(float(index), index + 1.0),
            index=index,
            descriptor=Descriptor("model", np.ones(1, np.float32)),
            searched=True,
        )

    def up_to(self, index: int) -> list[records.LoopCandidate]:
        """The loops among the first sub-maps of each agent."""
        return [
            loop
            for loop in self.loops
            if max(names.parse_submap(end)[2] for end in (loop.source, loop.target)) < index
        ]


def loop_of(source: str, target: str, edge: Edge) -> records.LoopCandidate:
    return records.LoopCandidate(
        source, target, 0.9, "ACCEPTED", "ACCEPTED",
        target_from_source=edge.source_from_target, information=edge.information,
    )  # fmt: skip


class Session:
    """A session's graph and solution, at work."""

    def __init__(self, graph: SessionGraph, solving: Solving, jobs: Gated, hall: Hall) -> None:
        self.graph, self.solving, self.jobs, self.hall = graph, solving, jobs, hall
        self.editing = solving._editing

    def arrive(self, index: int) -> None:
        """The next sub-map of each agent, with its loops."""
        known = {(loop.source, loop.target) for loop in self.hall.up_to(index)}
        for agent in range(AGENTS):
            self.graph.add_vertex(self.hall.vertex(agent, index))
        for loop in self.hall.up_to(index + 1):
            if (loop.source, loop.target) not in known:
                self.graph.set_loop(loop)
        self.solving.wake()

    async def at_rest(self) -> None:
        await eventually(
            lambda: not self.solving.busy and not self.graph.online.is_uncondensed,
            timeout_s=WAIT_S,
        )

    def missed_m(self) -> float:
        """How far what clients are told is from the optimum of what counts."""
        online = copy.deepcopy(self.graph.online)  # asking changes it
        expected = dict(zip(online.names, settled(online.counted()).poses, strict=True))
        told = convert.snapshot_from_proto(self.solving.board.snapshot).poses
        assert told.keys() == expected.keys()
        return max(
            float(np.linalg.norm(pose.world_from_anchor[:3, 3] - expected[name][:3, 3]))
            for name, pose in told.items()
        )

    async def remove(self, gone: set[str]) -> None:
        """As a coordinator does it."""
        async with self.editing:
            kept = sum(gone.isdisjoint(ends) for ends in self.graph.kept_loops())
            message = without(
                self.solving.board.snapshot, gone,
                accepted=self.graph.loops_without(gone), kept=kept, known_starts=set(),
            )  # fmt: skip
            self.graph.remove(gone, keep_odometry=True)
            await self.solving.replace(message)


@contextlib.asynccontextmanager
async def at_work(folder: Path, *, submaps: int) -> AsyncIterator[Session]:
    """A large graph of the first sub-maps, at rest."""
    hall, jobs = Hall(), Gated()
    with ThreadPoolExecutor(4) as threads:
        async with Store(folder, threads) as store:
            asked = Asked(uuid.uuid4().hex, bytes(32), 1.0)
            entered = await store.agents.register(
                "room", "agent_0", model_id="model", dimension=1, asked=asked
            )
            graph = SessionGraph("room", LARGE)
            found = Solving(
                entered.agent.session, graph,
                store=store, jobs=jobs, threads=threads, config=LARGE, editing=asyncio.Lock(),
            )  # fmt: skip
            for index in range(submaps):
                for agent in range(AGENTS):
                    graph.add_vertex(hall.vertex(agent, index))
            for loop in hall.up_to(submaps):
                graph.set_loop(loop)
            await found.start(on_idle=_nothing)
            endless = (found.take_in_for_ever, found.solve_for_ever, found.condense_for_ever)
            tasks = [asyncio.create_task(work()) for work in endless]
            session = Session(graph, found, jobs, hall)
            try:
                await session.at_rest()
                yield session
            finally:
                for task in tasks:
                    task.cancel()
                await asyncio.gather(*tasks, return_exceptions=True)
                await jobs.close()


async def _nothing() -> None:
    pass


@pytest.fixture(autouse=True)
def swift_retries(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(solving, "RETRY_S", 0.01)


def test_loops_come_with_the_last_submaps() -> None:
    """Else the tests below would wait for solves that nobody asks for."""
    hall = Hall()
    counts = [len(hall.up_to(index)) for index in range(SUBMAPS - 3, SUBMAPS + 1)]
    assert all(more > less for less, more in itertools.pairwise(counts))


async def test_a_submap_is_placed_while_the_whole_is_settled_elsewhere(tmp_path: Path) -> None:
    async with at_work(tmp_path, submaps=SUBMAPS - 3) as session:
        assert session.graph.online.regions is not None
        assert session.missed_m() < 0.003
        session.jobs.open.clear()
        session.jobs.asked.clear()
        session.arrive(SUBMAPS - 3)
        await eventually(lambda: session.jobs.asked, timeout_s=WAIT_S)
        session.arrive(SUBMAPS - 2)
        late = {name_of(agent, SUBMAPS - 2) for agent in range(AGENTS)}
        await eventually(lambda: session.solving.board.holds(late), timeout_s=WAIT_S)
        assert len(session.jobs.asked) == 1  # one at a time, and still under way
        assert session.missed_m() < 0.05  # regions alone
        session.jobs.open.set()
        await session.at_rest()
        assert session.missed_m() < 0.003
        assert "settle_pose_graph" in session.jobs.asked
        told = convert.snapshot_from_proto(session.solving.board.snapshot)
        assert len(told.components) == 1


async def test_a_settlement_that_fails_is_tried_again(tmp_path: Path) -> None:
    async with at_work(tmp_path, submaps=SUBMAPS - 1) as session:
        session.jobs.asked.clear()
        session.jobs.failures = 2
        session.arrive(SUBMAPS - 1)
        await session.at_rest()
        assert session.jobs.failures == 0
        assert len(session.jobs.asked) >= 3
        assert session.missed_m() < 0.003


async def test_submaps_removed_during_a_settlement_stay_removed(tmp_path: Path) -> None:
    async with at_work(tmp_path, submaps=SUBMAPS - 1) as session:
        session.jobs.open.clear()
        session.jobs.asked.clear()
        session.arrive(SUBMAPS - 1)
        await eventually(lambda: session.jobs.asked, timeout_s=WAIT_S)
        gone = {name_of(0, 7), name_of(1, 3)}
        await session.remove(gone)
        session.jobs.open.set()
        await session.at_rest()
        told = convert.snapshot_from_proto(session.solving.board.snapshot).poses
        assert gone.isdisjoint(told)
        assert len(told) == AGENTS * SUBMAPS - len(gone)
        assert session.missed_m() < 0.003
