"""One component of a pose graph as arrays, which every step of the solver works on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magic_server.posegraph import stacked
from magic_server.posegraph.problem import Edge, PoseGraphConfig

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class EdgeArrays:
    """m edges over numbered vertices."""

    source: NDArray[np.int64]  # (m,)
    target: NDArray[np.int64]  # (m,)
    source_from_target: Array  # (m, 4, 4)
    information: Array  # (m, 6, 6), (translation, rotation)

    def __len__(self) -> int:
        return len(self.source)

    @classmethod
    def of(cls, edges: Sequence[Edge], number: dict[str, int]) -> EdgeArrays:
        """Arrays of edges, given the number of each vertex."""
        return cls(
            source=np.array([number[edge.source] for edge in edges], dtype=np.int64),
            target=np.array([number[edge.target] for edge in edges], dtype=np.int64),
            source_from_target=np.array(
                [edge.source_from_target for edge in edges], dtype=np.float64
            ).reshape(-1, 4, 4),
            information=np.array(
                [0.5 * (edge.information + edge.information.T) for edge in edges], dtype=np.float64
            ).reshape(-1, 6, 6),
        )

    @classmethod
    def joined(cls, parts: Sequence[EdgeArrays]) -> EdgeArrays:
        """The edges of several, one after the other."""
        if not parts:
            return cls.of([], {})
        return cls(
            np.concatenate([part.source for part in parts]),
            np.concatenate([part.target for part in parts]),
            np.concatenate([part.source_from_target for part in parts]),
            np.concatenate([part.information for part in parts]),
        )

    def ends(self, edge: int) -> tuple[int, int]:
        """The numbers of an edge's vertices."""
        return int(self.source[edge]), int(self.target[edge])

    def select(self, index: NDArray) -> EdgeArrays:
        """The edges of a mask or an index array."""
        return EdgeArrays(
            self.source[index],
            self.target[index],
            self.source_from_target[index],
            self.information[index],
        )

    def renumbered(self, new_number: NDArray[np.int64]) -> EdgeArrays:
        """The same edges over other vertex numbers."""
        return EdgeArrays(
            new_number[self.source],
            new_number[self.target],
            self.source_from_target,
            self.information,
        )

    def residuals(self, poses: Array) -> Array:
        """log(measured^-1 predicted) as (m, 6): GTSAM's between factor, our order."""
        predicted = stacked.inverse(poses[self.source]) @ poses[self.target]
        return stacked.log(stacked.inverse(self.source_from_target) @ predicted)

    def squared_norms(self, poses: Array) -> Array:
        """Squared Mahalanobis norms (m,) at poses (n, 4, 4)."""
        if not len(self):
            return np.zeros(0)
        return stacked.squared_norms(self.residuals(poses), self.information)

    def variances(self) -> tuple[Array, Array]:
        """Mean variance of translation (m^2) and rotation (rad^2) of each edge, (m,) each."""
        covariance = safe_inverse(self.information)
        diagonal = np.diagonal(covariance, axis1=1, axis2=2)
        return diagonal[:, :3].mean(axis=1), diagonal[:, 3:].mean(axis=1)

    def with_odometry_floor(self, config: PoseGraphConfig) -> EdgeArrays:
        """The edges with the tracker's optimism taken out of their information."""
        floor = (config.odometry_floor_m, config.odometry_floor_rad, config.odometry_floor_share)
        if not len(self) or not any(floor):
            return self
        moved = np.linalg.norm(self.source_from_target[:, :3, 3], axis=1)
        turned = stacked.rotation_angles(self.source_from_target)
        sigma_m = floor[0] + floor[2] * moved
        sigma_rad = floor[1] + floor[2] * turned
        added = np.repeat(np.stack([sigma_m, sigma_rad], axis=1) ** 2, 3, axis=1)
        covariance = safe_inverse(self.information)
        covariance[:, range(6), range(6)] += added
        information = np.linalg.inv(covariance).astype(np.float64)
        return EdgeArrays(self.source, self.target, self.source_from_target, information)


@dataclass(frozen=True, slots=True)
class GraphArrays:
    """A whole pose graph over vertices numbered from 0, oldest first: cheap to hand to a job."""

    count: int
    odometry: EdgeArrays
    """With the tracker's own information; the solver widens it."""
    loops: EdgeArrays
    priors: Mapping[int, Array]
    """Known world_from_anchor (4, 4) of some vertices, all in one world."""
    initial: Array | None = None
    """(n, 4, 4) an estimate to start from, NaN where there is none."""


@dataclass(frozen=True, slots=True)
class ArraySolution:
    """What comes out, by number."""

    poses: Array  # (n, 4, 4) world_from_anchor, each in the frame of its component
    component: NDArray[np.int64]  # (n,) the number of its component's oldest vertex
    kept: NDArray[np.bool_]  # (m,) which loops it rests on


def safe_inverse(information: Array) -> Array:
    """Covariances of information matrices; unseen directions get a huge, finite variance."""
    if not len(information):
        return information.copy()
    values, vectors = np.linalg.eigh(information)
    largest = np.maximum(values[:, -1:], 1e-12)
    values = np.maximum(values, 1e-12 * largest)
    return (vectors / values[:, None, :]) @ vectors.swapaxes(1, 2)


def connected_sets(count: int, *edges: EdgeArrays) -> NDArray[np.int64]:
    """The smallest vertex number that each of `count` vertices is joined with, (count,)."""
    parent = list(range(count))

    def root(vertex: int) -> int:
        while parent[vertex] != vertex:
            parent[vertex] = parent[parent[vertex]]
            vertex = parent[vertex]
        return vertex

    for group in edges:
        for a, b in zip(group.source.tolist(), group.target.tolist(), strict=True):
            a, b = root(a), root(b)
            parent[max(a, b)] = min(a, b)
    return np.array([root(vertex) for vertex in range(count)], dtype=np.int64)
