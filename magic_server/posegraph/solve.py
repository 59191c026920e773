"""Solve a pose graph: one gauge per component, chains placed first, wrong loops left out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magic_server.posegraph import stacked
from magic_server.posegraph.arrays import (
    ArraySolution,
    EdgeArrays,
    GraphArrays,
    connected_sets,
)
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
    graph = GraphArrays(
        count=len(number),
        odometry=EdgeArrays.of(problem.odometry, number),
        loops=EdgeArrays.of(problem.loops, number),
        priors={number[name]: pose for name, pose in problem.priors.items()},
        initial=_known_poses(problem),
    )
    solution, start = _solved(graph, config)
    edges = graph.odometry.with_odometry_floor(config), graph.loops.select(solution.kept)
    before, after = (
        0.5 * sum(float(some.squared_norms(at).sum()) for some in edges)
        for at in (start, solution.poses)
    )
    component = solution.component
    return PoseGraphSolution(
        world_from_anchor={name: solution.poses[index] for name, index in number.items()},
        component={name: problem.vertices[component[index]] for name, index in number.items()},
        kept=tuple(solution.kept.tolist()),
        error_before=before,
        error_after=after,
    )


def solve_arrays(graph: GraphArrays, config: PoseGraphConfig) -> ArraySolution:
    """The same for a graph whose vertices are numbers, which must be sound."""
    return _solved(graph, config)[0]


def _solved(graph: GraphArrays, config: PoseGraphConfig) -> tuple[ArraySolution, Array]:
    """The solution, and the poses (n, 4, 4) that the search began at."""
    count, loops, priors = graph.count, graph.loops, graph.priors
    odometry = graph.odometry.with_odometry_floor(config)
    initial = None if graph.initial is None else extended(graph.initial, odometry)
    poses = np.tile(np.eye(4), (count, 1, 1))
    start = poses.copy()
    kept = np.zeros(len(loops), dtype=bool)
    for members, component_priors in _components(count, odometry, loops, priors):
        part = _part(members, odometry, loops, component_priors, initial)
        result = solve_part(part, config)
        poses[members], start[members] = result.poses, result.start
        kept[part.loop_index] = result.kept
    if graph.initial is not None and not np.isnan(graph.initial).any():
        start = graph.initial
    component = connected_sets(count, odometry, loops.select(kept), _joined_by_priors(priors))
    return ArraySolution(_own_gauge(poses, component, priors), component, kept), start


@dataclass(frozen=True, slots=True)
class Part:
    """A set of vertices that edges join, numbered from 0, the oldest first."""

    odometry: EdgeArrays
    loops: EdgeArrays
    loop_index: NDArray[np.int64]  # (m,) number of each loop in the whole problem
    chains: Chains
    priors: dict[int, Array]
    initial: Array | None
    """(n, 4, 4) an earlier solution to start from, extended by odometry."""


def solve_part(part: Part, config: PoseGraphConfig) -> GncResult:
    """Poses of one connected set of vertices."""
    known = known_frames(part.chains, part.priors)
    if not len(part.loops):
        start = place(part.chains, part.loops, known)
        return GncResult(start, np.zeros(0, dtype=bool), start)
    anchors = part.priors or {0: np.eye(4)}
    graph = RobustGraph(part.odometry, part.loops, anchors)
    if config.robust == "gnc":
        return RobustSolver(graph, part.chains, part.priors, config).solve(part.initial)
    weights = np.ones(len(part.loops))
    start = place(part.chains, part.loops, known)
    poses = graph.solve(
        graph.best_start(start, weights), weights, max_iterations=config.max_iterations
    )
    return GncResult(poses, weights > 0, start)


def _part(
    members: NDArray[np.int64],
    odometry: EdgeArrays,
    loops: EdgeArrays,
    priors: Mapping[int, Array],
    initial: Array | None,
) -> Part:
    count = int(max(members.max(), odometry.source.max(initial=0), odometry.target.max(initial=0),
                    loops.source.max(initial=0), loops.target.max(initial=0))) + 1  # fmt: skip
    new_number = np.full(count, -1, dtype=np.int64)
    new_number[members] = np.arange(len(members))
    inside = np.flatnonzero(new_number[loops.source] >= 0)
    own_odometry = odometry.select(new_number[odometry.source] >= 0).renumbered(new_number)
    own_initial = None if initial is None else initial[members]
    return Part(
        odometry=own_odometry,
        loops=loops.select(inside).renumbered(new_number),
        loop_index=inside,
        chains=follow(len(members), own_odometry),
        priors={int(new_number[vertex]): pose for vertex, pose in priors.items()},
        initial=None if own_initial is None or np.isnan(own_initial).any() else own_initial,
    )


def _known_poses(problem: PoseGraphProblem) -> Array | None:
    """(n, 4, 4) of the earlier solution, NaN where it has none."""
    if not problem.initial:
        return None
    poses = np.full((len(problem.vertices), 4, 4), np.nan)
    for index, name in enumerate(problem.vertices):
        if name in problem.initial:
            poses[index] = problem.initial[name]
    return poses


def extended(initial: Array, odometry: EdgeArrays) -> Array:
    """Poses (n, 4, 4) of an earlier solution; unknown vertices (NaN) follow by odometry."""
    poses = initial.copy()
    for edge in np.argsort(odometry.target, kind="stable").tolist():
        source, target = int(odometry.source[edge]), int(odometry.target[edge])
        if np.isnan(poses[target, 0, 0]):
            poses[target] = poses[source] @ odometry.source_from_target[edge]
    return poses


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
