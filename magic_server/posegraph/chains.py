"""Odometry chains: what the tracker alone says, and how sure it is of it."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from magic_server.posegraph import stacked
from magic_server.posegraph.arrays import EdgeArrays, connected_sets

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Chains:
    """Of each vertex: its chain, its pose in the chain, and the drift since the chain's start."""

    chain: NDArray[np.int64]  # (n,) the number of the chain's oldest vertex
    poses: Array  # (n, 4, 4) chain_from_anchor
    drift_m2: Array  # (n,) accumulated variance of translation, without the lever of rotation
    drift_rad2: Array  # (n,) accumulated variance of rotation
    step: NDArray[np.int64]  # (n,) edges from the chain's oldest vertex
    reach_m2: Array  # (n,) least variance from the oldest vertex, by loops too; inf if not known
    reach_rad2: Array  # (n,) the same for rotation

    @property
    def oldest(self) -> list[int]:
        """The oldest vertex of each chain, which stands for it."""
        return np.unique(self.chain).tolist()


def follow(count: int, odometry: EdgeArrays) -> Chains:
    """Compose odometry from each chain's oldest vertex."""
    variance_m2, variance_rad2 = odometry.variances()
    neighbours: list[list[tuple[int, int, bool]]] = [[] for _ in range(count)]
    for edge, (a, b) in enumerate(
        zip(odometry.source.tolist(), odometry.target.tolist(), strict=True)
    ):
        neighbours[a].append((b, edge, True))
        neighbours[b].append((a, edge, False))
    chain = connected_sets(count, odometry)
    poses = np.tile(np.eye(4), (count, 1, 1))
    drift_m2, drift_rad2 = np.zeros(count), np.zeros(count)
    forward = odometry.source_from_target
    backward = stacked.inverse(forward)
    step = np.zeros(count, dtype=np.int64)
    seen = np.zeros(count, dtype=bool)
    for oldest in np.unique(chain).tolist():
        seen[oldest] = True
        queue = deque([oldest])
        while queue:
            vertex = queue.popleft()
            for other, edge, along in neighbours[vertex]:
                if seen[other]:
                    continue
                seen[other] = True
                queue.append(other)
                step[other] = step[vertex] + 1
                poses[other] = poses[vertex] @ (forward[edge] if along else backward[edge])
                drift_m2[other] = drift_m2[vertex] + variance_m2[edge]
                drift_rad2[other] = drift_rad2[vertex] + variance_rad2[edge]
    unknown = np.full(count, np.inf)
    return Chains(
        chain, poses, drift_m2=drift_m2, drift_rad2=drift_rad2, step=step,
        reach_m2=unknown, reach_rad2=unknown,
    )  # fmt: skip


def shortened(chains: Chains, odometry: EdgeArrays, loops: EdgeArrays) -> Chains:
    """The chains with what loops within them (already solved for) take off the uncertainty:
    the variance along the best path, instead of along odometry alone."""
    count = len(chains.chain)
    rows = np.concatenate([odometry.source, loops.source])
    columns = np.concatenate([odometry.target, loops.target])
    reach = []
    for odometry_variance, loop_variance in zip(
        odometry.variances(), loops.variances(), strict=True
    ):
        weights = np.concatenate([odometry_variance, loop_variance]) + 1e-12
        graph = _least_parallel(rows, columns, weights, count)
        distances = dijkstra(graph, directed=False, indices=chains.oldest, min_only=True)
        reach.append(distances)
    return replace(chains, reach_m2=reach[0], reach_rad2=reach[1])


def _least_parallel(
    rows: NDArray[np.int64], columns: NDArray[np.int64], weights: Array, count: int
) -> coo_matrix:
    """A sparse graph in which the smallest of parallel edges counts (a matrix would add them)."""
    low, high = np.minimum(rows, columns), np.maximum(rows, columns)
    order = np.lexsort((weights, high, low))
    low, high, weights = low[order], high[order], weights[order]
    first = np.ones(len(low), dtype=bool)
    first[1:] = (low[1:] != low[:-1]) | (high[1:] != high[:-1])
    return coo_matrix((weights[first], (low[first], high[first])), shape=(count, count))
