"""Simulated pose graphs with known truth, and wrong loops of two kinds."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from magic_core.geometry import se3
from magic_server.posegraph.problem import Edge, PoseGraphProblem

Array = NDArray[np.float64]

SIGMA_M = 0.05
SIGMA_RAD = 0.01
SIGMAS = np.array([SIGMA_M] * 3 + [SIGMA_RAD] * 3)
INFORMATION = np.diag(1.0 / SIGMAS**2)


@dataclass(frozen=True, slots=True)
class Simulation:
    """A problem, the true pose of each vertex, and which loops are wrong."""

    problem: PoseGraphProblem
    truth: dict[str, Array]
    wrong: NDArray[np.bool_]


def agents_in_a_hall(
    *, agents: int = 10, submaps: int = 500, loops: int = 5000, seed: int = 0, side_m: float = 60.0
) -> Simulation:
    """Agents wander through one hall, each with its own unknown start; half the loops join two."""
    generator = np.random.default_rng(seed)
    truth = [
        pose
        for agent in range(agents)
        for pose in _wander(generator, submaps, side_m=side_m, height_m=0.2 * agent)
    ]
    names = [f"agent_{a}/{i}" for a in range(agents) for i in range(submaps)]
    successive = [(k, k + 1) for k in range(len(truth) - 1) if (k + 1) % submaps]
    pairs = _near_pairs(truth, submaps, generator, loops=loops)
    problem = PoseGraphProblem(
        vertices=tuple(names),
        odometry=tuple(_measured(i, j, truth, names, generator) for i, j in successive),
        loops=tuple(_measured(i, j, truth, names, generator) for i, j in pairs),
    )
    known = dict(zip(names, truth, strict=True))
    return Simulation(problem, known, np.zeros(len(pairs), dtype=bool))


def with_wrong_loops(
    problem: PoseGraphProblem,
    *,
    share: float,
    kind: Literal["random", "groups"],
    seed: int = 0,
    group_size: int = 10,
    reach_m: float = 2.0,
) -> tuple[PoseGraphProblem, NDArray[np.bool_]]:
    """Add wrong loops until they are `share` of all loops; returns which ones are wrong.

    `random`: two vertices anywhere, a plausible small transform. `groups`: runs of successive
    vertices whose wrong loops agree with each other, as when two corridors look the same.
    """
    generator = np.random.default_rng(seed)
    wanted = round(len(problem.loops) * share / (1.0 - share))
    local = _locally_consistent_poses(problem)
    information = problem.loops[0].information if problem.loops else INFORMATION
    sigmas = 1.0 / np.sqrt(np.diag(information))
    added: list[Edge] = []
    while len(added) < wanted:
        size = 1 if kind == "random" else min(group_size, wanted - len(added))
        first, second = generator.integers(0, len(problem.vertices) - size, 2)
        if abs(first - second) < 2 * group_size:
            continue
        alias = _alias(generator, reach_m)
        for k in range(size):
            a, b = problem.vertices[first + k], problem.vertices[second + k]
            # Both runs move as tracked; the alias ties their first vertices together.
            moved_a = se3.inverse(local[problem.vertices[first]]) @ local[a]
            moved_b = se3.inverse(local[problem.vertices[second]]) @ local[b]
            noise = se3.exp(generator.normal(size=6) * sigmas)
            relation = se3.inverse(moved_a) @ alias @ moved_b @ noise
            added.append(Edge(a, b, relation, information))
    loops = problem.loops + tuple(added)
    order = generator.permutation(len(loops))
    wrong = (np.arange(len(loops)) >= len(problem.loops))[order]
    return replace(problem, loops=tuple(loops[i] for i in order)), wrong


def _alias(generator: np.random.Generator, reach_m: float) -> Array:
    """A relation as two views of one place have it: near, upright, any heading."""
    rotation = se3.rotation_exp([0, 0, generator.uniform(-np.pi, np.pi)])
    tilt = se3.rotation_exp(generator.normal(size=3) * 0.05)
    offset = generator.uniform(-reach_m, reach_m, 3) * (1, 1, 0.1)
    return se3.from_rotation_translation(rotation @ tilt, offset)


def _wander(
    generator: np.random.Generator, count: int, *, side_m: float, height_m: float
) -> list[Array]:
    position, heading = generator.uniform(0.1 * side_m, 0.9 * side_m, 2), generator.uniform(0, 7)
    poses = []
    for _ in range(count):
        heading += generator.normal() * 0.15
        ahead = position + 0.7 * np.array([np.cos(heading), np.sin(heading)])
        if (ahead < 0).any() or (ahead > side_m).any():
            heading += np.pi / 2 + generator.normal() * 0.3
            ahead = np.clip(ahead, 0, side_m)
        position = ahead
        tilt = se3.rotation_exp(np.append(generator.normal(size=2) * 0.02, 0.0))
        rotation = se3.rotation_exp([0, 0, heading]) @ tilt
        poses.append(se3.from_rotation_translation(rotation, [*position, height_m]))
    return poses


def _near_pairs(
    truth: list[Array], submaps: int, generator: np.random.Generator, *, loops: int
) -> list[tuple[int, int]]:
    """Pairs within 3 m: half between agents, half within one and far apart in time."""
    positions = np.array([pose[:3, 3] for pose in truth])
    pairs = KDTree(positions).query_pairs(3.0, output_type="ndarray")
    pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
    same = pairs[:, 0] // submaps == pairs[:, 1] // submaps
    inside = pairs[same & (np.abs(pairs[:, 0] - pairs[:, 1]) > 20)]
    between = pairs[~same]
    take_between = min(max(loops // 2, loops - len(inside)), len(between))
    take_inside = min(loops - take_between, len(inside))
    chosen = [
        group[generator.choice(len(group), take, replace=False)]
        for group, take in ((inside, take_inside), (between, take_between))
    ]
    return [(int(i), int(j)) for i, j in np.concatenate(chosen)]


def _measured(
    i: int, j: int, truth: list[Array], names: list[str], generator: np.random.Generator
) -> Edge:
    noise = se3.exp(generator.normal(size=6) * SIGMAS)
    return Edge(names[i], names[j], se3.inverse(truth[i]) @ truth[j] @ noise, INFORMATION)


def _locally_consistent_poses(problem: PoseGraphProblem) -> dict[str, Array]:
    """Poses composed from odometry alone: right from one vertex to the next few."""
    poses = {name: np.eye(4) for name in problem.vertices[:1]}
    forward = {edge.target: edge for edge in problem.odometry}
    for name in problem.vertices[1:]:
        edge = forward.get(name)
        known = edge is not None and edge.source in poses
        poses[name] = poses[edge.source] @ edge.source_from_target if known and edge else np.eye(4)
    return poses
