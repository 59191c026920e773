"""Solve a pose graph: one gauge per component, chains placed first, wrong loops left out."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from magic_server.posegraph import stacked
from magic_server.posegraph.arrays import EdgeArrays, connected_sets
from magic_server.posegraph.chains import Chains, follow
from magic_server.posegraph.gnc import GncResult, RobustGraph
from magic_server.posegraph.placement import known_frames, place
from magic_server.posegraph.problem import PoseGraphConfig, PoseGraphProblem, PoseGraphSolution
from magic_server.posegraph.robust import RobustSolver

Array = NDArray[np.float64]


def solve(problem: PoseGraphProblem, config: PoseGraphConfig) -> PoseGraphSolution:
    """Poses of all vertices, each in the frame of its component.

    Components are what odometry and *kept* loops join. Raises InvalidInput for a broken problem.
    """
    problem.validate()
    number = {name: index for index, name in enumerate(problem.vertices)}
    count = len(number)
    odometry = EdgeArrays.of(problem.odometry, number).with_odometry_floor(config)
    loops = EdgeArrays.of(problem.loops, number)
    priors = {number[name]: pose for name, pose in problem.priors.items()}
    poses = np.tile(np.eye(4), (count, 1, 1))
    kept = np.zeros(len(loops), dtype=bool)
    start = poses.copy()
    for members, component_priors in _components(count, odometry, loops, priors):
        new_number = np.full(count, -1, dtype=np.int64)
        new_number[members] = np.arange(len(members))
        inside = np.flatnonzero(new_number[loops.source] >= 0)
        part_odometry = odometry.select(new_number[odometry.source] >= 0).renumbered(new_number)
        part_loops = loops.select(inside).renumbered(new_number)
        part_priors = {int(new_number[v]): pose for v, pose in component_priors.items()}
        chains = follow(len(members), part_odometry)
        start[members] = place(chains, part_loops, known_frames(chains, part_priors))
        result = _solve_part(part_odometry, part_loops, chains, part_priors, start[members], config)
        poses[members] = result.poses
        kept[inside] = result.kept
    used = loops.select(kept)
    component = connected_sets(count, odometry, used, _joined_by_priors(priors))
    poses, start = _own_gauge(poses, component, priors), _own_gauge(start, component, priors)
    before, after = (
        0.5 * float(odometry.squared_norms(at).sum() + used.squared_norms(at).sum())
        for at in (start, poses)
    )
    return PoseGraphSolution(
        world_from_anchor={name: poses[index] for name, index in number.items()},
        component={name: problem.vertices[component[index]] for name, index in number.items()},
        kept=tuple(kept.tolist()),
        error_before=before,
        error_after=after,
    )


def _solve_part(
    odometry: EdgeArrays,
    loops: EdgeArrays,
    chains: Chains,
    priors: Mapping[int, Array],
    start: Array,
    config: PoseGraphConfig,
) -> GncResult:
    """Poses of one connected set of vertices, numbered from 0."""
    if not len(loops):
        return GncResult(start, np.zeros(0, dtype=bool))
    graph = RobustGraph(odometry, loops, priors or {0: start[0]})
    if config.robust == "gnc":
        return RobustSolver(graph, chains, priors, config).solve()
    weights = np.ones(len(loops))
    start = graph.best_start(start, weights)
    poses = graph.solve(start, weights, max_iterations=config.max_iterations)
    return GncResult(poses, weights > 0)


def _components(
    count: int, odometry: EdgeArrays, loops: EdgeArrays, priors: Mapping[int, Array]
) -> list[tuple[NDArray[np.int64], dict[int, Array]]]:
    """Members and priors of each set that edges or priors join."""
    label = connected_sets(count, odometry, loops, _joined_by_priors(priors))
    return [
        (members, {v: priors[v] for v in members.tolist() if v in priors})
        for members in (np.flatnonzero(label == oldest) for oldest in np.unique(label))
    ]


def _joined_by_priors(priors: Mapping[int, Array]) -> EdgeArrays:
    """Vertices with priors share one world: edges without content that say so."""
    vertices = np.array(sorted(priors), dtype=np.int64)
    joined = max(len(vertices) - 1, 0)
    empty = np.zeros((joined, 4, 4)), np.zeros((joined, 6, 6))
    return EdgeArrays(vertices[:-1][:joined], vertices[1:], *empty)


def _own_gauge(poses: Array, component: NDArray[np.int64], priors: Mapping[int, Array]) -> Array:
    """Express each component without priors in the frame of its oldest vertex."""
    fixed = {int(component[vertex]) for vertex in priors}
    oldest = np.array([v if v not in fixed else -1 for v in component.tolist()], dtype=np.int64)
    frames = stacked.inverse(poses[np.maximum(oldest, 0)])
    moved = frames @ poses
    return np.where((oldest >= 0)[:, None, None], moved, poses)
