"""Solve pose graphs that lie in g2o files: the work behind `magic posegraph solve`."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

from magic_server.posegraph.g2o import G2oGraph, problem_of, read_g2o, write_g2o
from magic_server.posegraph.problem import PoseGraphConfig, PoseGraphProblem, PoseGraphSolution
from magic_server.posegraph.solve import solve


def solve_files(
    paths: Sequence[Path],
    *,
    robust: Literal["none", "gnc"] = "gnc",
    output: Path | None = None,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, Any]:
    """Solve one or several g2o files (one per robot too) as one graph.

    Every edge counts with the file's own information. Errors are half the squared Mahalanobis
    norm of odometry and kept loops, before at the files' own poses. Writes the solution to
    `output`, without the rejected loops. Returns what `magic posegraph solve --json` prints.
    """
    graph = read_g2o(paths)
    problem = problem_of(graph)
    config = PoseGraphConfig(
        robust=robust,
        odometry_floor_m=0.0,
        odometry_floor_rad=0.0,
        odometry_floor_share=0.0,
    )
    started = clock()
    solution = solve(problem, config)
    seconds = clock() - started
    if output is not None:
        write_g2o(output, _poses(solution), _kept_edges(graph, problem, solution))
    rejected = [
        [int(loop.source), int(loop.target)]
        for loop, kept in zip(problem.loops, solution.kept, strict=True)
        if not kept
    ]
    return {
        "vertices": len(problem.vertices),
        "edges": len(graph.edges),
        "error_before": solution.error_before,
        "error_after": solution.error_after,
        "seconds": seconds,
        "loops_kept": len(problem.loops) - len(rejected),
        "loops_rejected": rejected,
        "components": len(set(solution.component.values())),
    }


def _poses(solution: PoseGraphSolution) -> dict[int, Any]:
    return {int(name): pose for name, pose in solution.world_from_anchor.items()}


def _kept_edges(
    graph: G2oGraph, problem: PoseGraphProblem, solution: PoseGraphSolution
) -> list[tuple]:
    dropped = {
        (int(loop.source), int(loop.target), loop.source_from_target.tobytes())
        for loop, kept in zip(problem.loops, solution.kept, strict=True)
        if not kept
    }
    return [edge for edge in graph.edges if (edge[0], edge[1], edge[2].tobytes()) not in dropped]
