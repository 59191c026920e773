"""Regions against the whole: what a new sub-map costs in a large graph, and how far off it ends.

Agents of 500 sub-maps wander through one hall whose floor grows with their number. All but the
last sub-maps are solved as a whole; these then arrive one at a time, each with its loops, and the
server's own graph takes them in. At the end GTSAM solves everything at once with the same loops.
Times are of the processor, one thread.

Example: OMP_NUM_THREADS=1 python benchmarks/posegraph/hierarchy.py --submaps 5000 --added 500
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
from magic_server.posegraph.gnc import RobustGraph
from magic_server.posegraph.online import NewVertex, OnlineGraph
from magic_server.posegraph.simulated import agents_in_a_hall
from magic_server.posegraph.solve import solve_arrays

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
    solution = solve_arrays(graph, dataclasses.replace(REGIONAL, hierarchy="off"))
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


def measure(submaps: int, added: int, *, config: PoseGraphConfig, cache: Path | None) -> dict:
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
    graph.advance([], [])
    first_s = time.process_time() - started
    times_ms, told, doubts, before = [], [], 0, len(graph.kept)
    for vertex, loops in arrived[submaps - added :]:
        started = time.process_time()
        change = graph.advance([vertex], loops)
        times_ms.append(1e3 * (time.process_time() - started))
        told.append(len(change.vertices))
        doubts += graph.unsettled
        graph.unsettled = False
    peak_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    apart, whole_s = against_the_whole(graph)
    hierarchy = graph._hierarchy  # only to say how large it is
    return {
        "submaps": submaps,
        "added": added,
        "begin_s": round(first_s, 2),
        "advance_ms": spread(times_ms),
        "told": spread(told),
        "loops_added": len(graph.kept) - before,
        "taken_up_share": round(float(graph.kept[before:].mean()), 4),
        "whole_solves_asked_for": doubts,
        "apart_mm": apart,
        "whole_s": round(whole_s, 2),
        "regions": hierarchy.regions if hierarchy else 0,
        "condensed_mib": round(hierarchy.nbytes / 2**20, 1) if hierarchy else 0.0,
        "peak_mib": round(peak_mib, 1),
    }


def against_the_whole(graph: OnlineGraph) -> tuple[dict, float]:
    """Millimetres from the optimum that GTSAM finds with the same loops, and its seconds."""
    arrays = graph.arrays()
    edges = EdgeArrays.joined([arrays.odometry, arrays.loops.select(graph.kept)])
    held = {v: graph.poses[v] for v in np.unique(graph.component).tolist()}
    started = time.process_time()
    whole = RobustGraph(edges, EdgeArrays.of([], {}), held)
    found = whole.solve(graph.poses, np.zeros(0), max_iterations=20, tolerance=1e-9)
    seconds = time.process_time() - started
    apart = 1e3 * np.linalg.norm(found[:, :3, 3] - graph.poses[:, :3, 3], axis=1)
    rms = float(np.sqrt((apart**2).mean()))
    return {"rms": round(rms, 3), "max": round(float(apart.max()), 3)}, seconds


def spread(values: list) -> dict:
    """p50, p90, p99 and the largest."""
    names = ("p50", "p90", "p99", "max")
    found = np.percentile(values, (50, 90, 99, 100)).round(1).tolist()
    return dict(zip(names, found, strict=True))


def main() -> None:
    """Run and print one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--submaps", type=int, default=5000, help="a multiple of 500")
    parser.add_argument("--added", type=int, default=500, help="how many arrive one at a time")
    parser.add_argument("--hierarchy", choices=("on", "off"), default="on")
    parser.add_argument("--cache", type=Path, help="keep the solved base in this .npz")
    options = parser.parse_args()
    config = dataclasses.replace(REGIONAL, hierarchy=options.hierarchy)
    print(json.dumps(measure(options.submaps, options.added, config=config, cache=options.cache)))


if __name__ == "__main__":
    main()
