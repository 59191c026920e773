"""Odometry chains: what the tracker alone says, and how sure it is of it."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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

    @property
    def oldest(self) -> list[int]:
        """The oldest vertex of each chain, which stands for it."""
        return np.unique(self.chain).tolist()


def follow(count: int, odometry: EdgeArrays, start: Array | None = None) -> Chains:
    """Compose odometry from each chain's oldest vertex; `start` (n, 4, 4) replaces composing."""
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
                poses[other] = poses[vertex] @ (forward[edge] if along else backward[edge])
                drift_m2[other] = drift_m2[vertex] + variance_m2[edge]
                drift_rad2[other] = drift_rad2[vertex] + variance_rad2[edge]
    if start is not None:
        poses = stacked.inverse(start[chain]) @ start
    return Chains(chain=chain, poses=poses, drift_m2=drift_m2, drift_rad2=drift_rad2)
