"""Regions against the whole: what a new sub-map costs in a large graph, and how far off it ends.

Agents of 500 sub-maps wander through one hall whose floor grows with their number. All but the
last sub-maps are solved as a whole; these then arrive one at a time, each with its loops, and the
server's own graph takes them in. Exact solves of what counts, which a server has in a worker, are
asked for whenever there is none under way, and adopted `--lag` sub-maps later. At the end GTSAM
solves everything at once with the same loops. Times are of the processor, one thread.

Example: OMP_NUM_THREADS=1 python benchmarks/posegraph/hierarchy.py --submaps 5000 --added 300
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import resource
import time
from pathlib import Path

import numpy as np

from magic_server.posegraph import Edge, PoseGraphConfig, PoseGraphProblem
from magic_server.posegraph.arrays import ArraySolution, EdgeArrays, GraphArrays
from magic_server.posegraph.online import NewVertex, OnlineGraph
from magic_server.posegraph.regional import Regions
from magic_server.posegraph.settlement import CountedArrays, Optimum, settled
from magic_server.posegraph.simulated import agents_in_a_hall
from magic_server.posegraph.solve import solve_arrays
from magic_server.posegraph.telling import Change

REGIONAL = PoseGraphConfig(odometry_floor_m=0.0, odometry_floor_rad=0.0, odometry_floor_share=0.0)
OF_AN_AGENT = 500
Arrival = tuple[NewVertex, list[Edge]]


def arrivals(problem: PoseGraphProblem, submaps: int) -> list[Arrival]:
    """Each sub-map with its loops to older ones, the agents in turns."""
    agents = submaps // OF_AN_AGENT
    order = [f"agent_{a}/{i}" for i in range(OF_AN_AGENT) for a in range(agents)]
    age = {name: number for number, name in enumerate(order)}
    odometry = {edge.target: edge for edge in problem.odometry}
    loops: dict[str, list[Edge]] = {name: [] for name in order}
    for edge in problem.loops:
        newer = edge.source if age[edge.source] > age[edge.target] else edge.target
        loops[newer].append(edge)
    return [
        (NewVertex(name, odometry.get(name), group=name.split("/", maxsplit=1)[0]), loops[name])
        for name in order
    ]


def solved(base: list[Arrival], cache: Path | None) -> ArraySolution:
    """The first sub-maps, solved as a whole."""
    if cache is not None and cache.is_file():
        stored = np.load(cache)
        return ArraySolution(stored["poses"], stored["component"], stored["kept"])
    number = {vertex.name: index for index, (vertex, _) in enumerate(base)}
    graph = GraphArrays(
        count=len(base),
        odometry=EdgeArrays.of([v.odometry for v, _ in base if v.odometry is not None], number),
        loops=EdgeArrays.of([loop for _, loops in base for loop in loops], number),
        priors={},
    )
    solution = solve_arrays(graph, REGIONAL)
    if cache is not None:
        np.savez(
            cache, **{field: getattr(solution, field) for field in ("poses", "component", "kept")}
        )
    return solution


def begun(base: list[Arrival], solution: ArraySolution, config: PoseGraphConfig) -> OnlineGraph:
    """The server's graph as after a restart."""
    graph = OnlineGraph(config)
    names = [vertex.name for vertex, _ in base]
    graph.restore(
        [vertex for vertex, _ in base],
        [loop for _, loops in base for loop in loops],
        poses={
            name: (names[component], pose)
            for name, component, pose in zip(
                names, solution.component.tolist(), solution.poses, strict=True
            )
        },
        kept=np.flatnonzero(solution.kept).tolist(),
        settled=True,
    )
    return graph


def measure(
    submaps: int, added: int, *, config: PoseGraphConfig, cache: Path | None, lag: int
) -> dict:
    """Let the last sub-maps arrive; what each cost, and how far the result is from the optimum."""
    side_m = 60.0 * (submaps / 5000) ** 0.5
    agents = submaps // OF_AN_AGENT
    simulation = agents_in_a_hall(
        agents=agents, submaps=OF_AN_AGENT, loops=submaps, seed=0, side_m=side_m
    )
    arrived = arrivals(simulation.problem, submaps)
    base = arrived[: submaps - added]
    started = time.process_time()
    graph = begun(base, solved(base, cache), config)
    print(f"base of {len(base)}: {time.process_time() - started:.1f} s", flush=True)
    started = time.process_time()
    regions = graph.outline().condensed() if graph.is_uncondensed else None
    begin_s = time.process_time() - started
    before_mib, (taken_ms, _) = rss_mib(), timed(graph, [], [], regions=regions)
    first, worker = len(graph.kept), Worker(graph, lag)
    with_loops_ms, alone_ms, adopting_ms, told, doubts = [], [], [], [], 0
    for vertex, loops in arrived[submaps - added :]:
        optimum = worker.done()
        took_ms, change = timed(graph, [vertex], loops, optimum)
        kind = with_loops_ms if loops else alone_ms
        (adopting_ms if optimum is not None else kind).append(took_ms)
        told.append(len(change.vertices))
        doubts += graph.unsettled
        graph.unsettled = False
    peak_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    meanwhile, whole_s = against_the_whole(graph)
    exactly = None
    if graph.is_large:
        took_ms, _ = timed(graph, [], [], settled(graph.counted()))
        adopting_ms.append(took_ms)
        exactly, whole_s = against_the_whole(graph)
    return {
        "submaps": submaps,
        "added": added,
        "condensing_s": round(begin_s, 2),
        "taken_into_use_ms": round(taken_ms, 1),
        "every_submap_ms": spread([*with_loops_ms, *alone_ms, *adopting_ms]),
        "with_loops_ms": spread(with_loops_ms),
        "without_ms": spread(alone_ms),
        "with_an_exact_solve_ms": spread(adopting_ms),
        "exact_solves": len(adopting_ms),
        "told": spread(told),
        "loops_added": len(graph.kept) - first,
        "taken_up_share": round(float(graph.kept[first:].mean()), 4),
        "robust_solves_asked_for": doubts,
        "apart_mm": meanwhile,
        "apart_after_an_exact_solve_mm": exactly,
        "whole_s": round(whole_s, 2),
        "regions": graph.regions.count if graph.regions else 0,
        "condensed_mib": round(graph.regions.nbytes / 2**20, 1) if graph.regions else 0.0,
        "with_regions_mib": round(before_mib, 1),
        "peak_mib": round(peak_mib, 1),
    }


class Worker:
    """One exact solve at a time, done when so many more sub-maps have arrived."""

    def __init__(self, graph: OnlineGraph, lag: int) -> None:
        self._graph = graph
        self._lag = lag
        self._left = 0
        self._asked: CountedArrays | None = None

    def done(self) -> Optimum | None:
        """Called before each arrival."""
        found = None
        if self._asked is not None and self._left == 0:
            found, self._asked = settled(self._asked), None
        elif self._asked is None and self._graph.bent:
            self._asked, self._left = self._graph.counted(), self._lag
        self._left -= 1
        return found


def timed(
    graph: OnlineGraph,
    vertices: list[NewVertex],
    loops: list[Edge],
    solution: Optimum | None = None,
    regions: Regions | None = None,
) -> tuple[float, Change]:
    """Milliseconds of a step, and what it changed."""
    started = time.process_time()
    change = graph.advance(vertices, loops, solution, regions)
    return 1e3 * (time.process_time() - started), change


def rss_mib() -> float:
    """Memory of this process now."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20


def against_the_whole(graph: OnlineGraph) -> tuple[dict, float]:
    """Millimetres from the optimum that GTSAM finds with the same loops, and its seconds."""
    counted = graph.counted()
    started = time.process_time()
    found = settled(counted).poses
    seconds = time.process_time() - started
    apart = 1e3 * np.linalg.norm(found[:, :3, 3] - graph.poses[:, :3, 3], axis=1)
    rms = float(np.sqrt((apart**2).mean()))
    return {"rms": round(rms, 3), "max": round(float(apart.max()), 3)}, seconds


def spread(values: list) -> dict:
    """p50, p90, p99 and the largest."""
    names = ("p50", "p90", "p99", "max")
    if not values:
        return {}
    found = np.percentile(values, (50, 90, 99, 100)).round(1).tolist()
    return dict(zip(names, found, strict=True))


def main() -> None:
    """Run and print one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--submaps", type=int, default=5000, help="a multiple of 500")
    parser.add_argument("--added", type=int, default=500, help="how many arrive one at a time")
    parser.add_argument("--hierarchy", choices=("on", "off"), default="on")
    parser.add_argument("--lag", type=int, default=5, help="sub-maps during an exact solve")
    parser.add_argument("--cache", type=Path, help="keep the solved base in this .npz")
    options = parser.parse_args()
    config = dataclasses.replace(REGIONAL, hierarchy=options.hierarchy)
    found = measure(
        options.submaps, options.added, config=config, cache=options.cache, lag=options.lag
    )
    print(json.dumps(found))


if __name__ == "__main__":
    main()
