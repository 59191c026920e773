"""How long a submitted sub-map takes until a published revision holds it, as the graph grows.

Ten simulated agents submit their sub-maps in turns, each with the loops that join it to older ones.
Everything behind verification is the server's own: the store on disk, the worker processes, the
task that takes in what is new, the solves of the whole graph behind it.

Example: python benchmarks/posegraph/online.py --agents 10 --submaps 500 --interval-ms 200
"""

from __future__ import annotations

import argparse
import asyncio
import json
import resource
import sys
import tempfile
import time
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from magicslam.v1.mapping_service_pb2 import RegisterAgentRequest

from magic_core.submap import Descriptor, OdometryEdge
from magic_core.wire import names, records
from magic_server.graph import SessionGraph
from magic_server.jobs import JobConfig, ProcessExecutor
from magic_server.posegraph import Edge, PoseGraphConfig
from magic_server.posegraph.simulated import agents_in_a_hall, with_wrong_loops
from magic_server.solving import Solving
from magic_server.store import SessionRow, Store, Vertex
from magic_server.store.answers import Asked
from magic_server.tasks import TaskScope

SESSION = "hall"
CONFIG = PoseGraphConfig(odometry_floor_m=0.0, odometry_floor_rad=0.0, odometry_floor_share=0.0)
DESCRIPTOR = Descriptor("none", np.ones(1, np.float32))


class Measured:
    """Milliseconds from submission, by number in order of arrival."""

    def __init__(self) -> None:
        self.placed_ms: dict[int, float] = {}
        """Until a published revision held the sub-map."""
        self.looped_ms: dict[int, float] = {}
        """Until a published revision relied on all of its loops, for those that have some."""


@dataclass(frozen=True, slots=True)
class Arrival:
    """A sub-map and the loops to older ones."""

    vertex: Vertex
    loops: tuple[records.LoopCandidate, ...]


def arrivals(agents: int, submaps: int, *, wrong: float, seed: int) -> list[Arrival]:
    """What the agents submit, interleaved."""
    loops = agents * submaps
    simulation = agents_in_a_hall(agents=agents, submaps=submaps, loops=loops, seed=seed)
    problem = simulation.problem
    if wrong:
        problem, _ = with_wrong_loops(problem, share=wrong, kind="random", seed=seed)
    order = [f"agent_{a}/{i}" for i in range(submaps) for a in range(agents)]
    age = {name: number for number, name in enumerate(order)}
    odometry = {edge.target: edge for edge in problem.odometry}
    of_newer: dict[str, list[Edge]] = {}
    for edge in problem.loops:
        newer = edge.source if age[edge.source] > age[edge.target] else edge.target
        of_newer.setdefault(newer, []).append(edge)
    return [
        Arrival(_vertex(name, odometry.get(name)), tuple(map(_loop, of_newer.get(name, ()))))
        for name in order
    ]


class Backend:
    """The server's part behind verification, with a store in a folder."""

    def __init__(self, folder: Path) -> None:
        self.threads = ThreadPoolExecutor(4)
        self.jobs = ProcessExecutor(JobConfig())
        self.store = Store(folder, self.threads)
        self.graph = SessionGraph(SESSION, CONFIG)
        self.editing = asyncio.Lock()
        self.tasks = TaskScope("benchmark")
        self.idle = asyncio.Condition()

    async def start(self) -> None:
        await self.store.open()
        request = RegisterAgentRequest(agent=names.agent_name(SESSION, "agent_0"))
        entered = await self.store.agents.register(
            SESSION,
            "agent_0",
            model_id=DESCRIPTOR.model_id,
            dimension=1,
            asked=Asked.of(request, request_id="benchmark", now=time.time()),
        )
        self.session: SessionRow = entered.agent.session
        self.solving = Solving(
            self.session, self.graph, store=self.store, jobs=self.jobs, threads=self.threads,
            config=CONFIG, editing=self.editing,
        )  # fmt: skip
        await self.solving.start(on_idle=self._tell_idle)
        self.tasks.start(self.solving.take_in_for_ever(), name="take in")
        self.tasks.start(self.solving.solve_for_ever(), name="solve")

    async def submit(self, arrival: Arrival) -> None:
        """As the coordinator does once a sub-map is stored and its loops are verified."""
        self.graph.add_vertex(arrival.vertex)
        if arrival.loops:
            await self.store.loops.add_candidates(
                self.session, arrival.vertex.name, list(arrival.loops)
            )
        for loop in arrival.loops:
            self.graph.set_loop(loop)
        self.solving.wake()

    async def settled(self) -> None:
        """Wait until nothing more would change."""
        async with self.idle:
            await self.idle.wait_for(lambda: not self.solving.busy)

    async def _tell_idle(self) -> None:
        async with self.idle:
            self.idle.notify_all()

    async def close(self) -> None:
        await self.tasks.close()
        await self.jobs.close()
        await self.store.close()
        self.threads.shutdown()


async def measure(arrived: list[Arrival], *, interval_s: float, folder: Path) -> dict:
    """Submit everything at a steady rate and watch the board."""
    backend = Backend(folder)
    await backend.start()
    measured = Measured()
    board = backend.solving.board
    waiting: dict[int, float] = {}
    unlooped: dict[int, float] = {}
    rss: list[tuple[int, float]] = []

    async def watch() -> None:
        revision = board.revision
        while True:
            await board.newer_than(revision)
            revision, now = board.revision, time.perf_counter()
            for number in [n for n in waiting if board.holds({arrived[n].vertex.name})]:
                measured.placed_ms[number] = 1e3 * (now - waiting.pop(number))
            kept = backend.graph.kept_loops() if unlooped else set()
            for number in [n for n in unlooped if _ends(arrived[n].loops) <= kept]:
                measured.looped_ms[number] = 1e3 * (now - unlooped.pop(number))

    watcher = asyncio.create_task(watch())
    begun = time.perf_counter()
    for number, arrival in enumerate(arrived):
        await asyncio.sleep(max(0.0, begun + number * interval_s - time.perf_counter()))
        waiting[number] = time.perf_counter()
        if arrival.loops:
            unlooped[number] = waiting[number]
        await backend.submit(arrival)
        if number % 500 == 499:
            rss.append((number + 1, _rss_mib()))
            print(f"{number + 1} submitted", file=sys.stderr, flush=True)
    await backend.settled()
    watcher.cancel()
    result = {
        "revisions": board.revision,
        "components": len(board.snapshot.components),
        "loops": board.snapshot.loop_count,
        "loops_kept": board.snapshot.loops_kept,
        "by_size": [_spread(measured, first) for first in range(0, len(arrived), 500)],
        "all": _spread(measured, 0, len(arrived)),
        "rss_mib": rss,
        "seconds": round(time.perf_counter() - begun, 1),
    }
    await backend.close()
    return result


def _spread(measured: Measured, first: int, count: int = 500) -> dict:
    def inside(times: dict[int, float]) -> dict:
        return _percentiles([ms for n, ms in times.items() if first <= n < first + count])

    return {
        "submaps": first + count,
        "placed_ms": inside(measured.placed_ms),
        "with_loops_ms": inside(measured.looped_ms),
    }


def _percentiles(values: list[float]) -> dict:
    if not values:
        return {}
    names_ = ("p50", "p90", "p99", "max")
    return dict(
        zip(names_, np.percentile(values, (50, 90, 99, 100)).round(1).tolist(), strict=True)
    )


def _ends(loops: Iterable[records.LoopCandidate]) -> set[tuple[str, str]]:
    return {(loop.source, loop.target) for loop in loops}


def _full(name: str) -> str:
    agent, index = name.split("/")
    return names.submap_name(SESSION, agent, int(index))


def _vertex(name: str, edge: Edge | None) -> Vertex:
    agent, index = name.split("/")
    odometry = edge and OdometryEdge(int(index) - 1, edge.source_from_target, edge.information)
    agent_name = names.agent_name(SESSION, agent)
    span_s = (float(index), float(index))
    return Vertex(
        name=_full(name),
        agent=agent_name,
        index=int(index),
        descriptor=DESCRIPTOR,
        odometry=odometry,
        prior=None,
        searched=True,
        span_s=span_s,
    )


def _loop(edge: Edge) -> records.LoopCandidate:
    """A loop's source is the edge's target."""
    return records.LoopCandidate(
        source=_full(edge.target),
        target=_full(edge.source),
        similarity=1.0,
        verdict="ACCEPTED",
        reason="ACCEPTED",
        target_from_source=edge.source_from_target,
        information=edge.information,
    )


def _rss_mib() -> float:
    own = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(own / 1024, 1)


def main() -> None:
    """Run and print one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--agents", type=int, default=10)
    parser.add_argument("--submaps", type=int, default=500, help="of each agent")
    parser.add_argument("--interval-ms", type=float, default=200.0, help="between submissions")
    parser.add_argument("--wrong", type=float, default=0.0, help="share of wrong loops")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    arrived = arrivals(options.agents, options.submaps, wrong=options.wrong, seed=options.seed)
    with tempfile.TemporaryDirectory() as folder:
        result = asyncio.run(
            measure(arrived, interval_s=options.interval_ms / 1e3, folder=Path(folder))
        )
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
