"""Which loops agree with each other: pairwise consistency (Mangelson et al., PCM, 2018).

Two loops between the same two chains close a cycle with the odometry between their ends. They are
mates if the cycle misses identity by no more than loops and odometry explain.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from magic_server.posegraph import stacked
from magic_server.posegraph.arrays import EdgeArrays
from magic_server.posegraph.chains import Chains

Array = NDArray[np.float64]

NEIGHBOURS = 16
NEIGHBOUR_STEPS = 30
MATE_CHI_SQUARE = 16.81
"""99 % quantile of a chi-square with 6 degrees of freedom."""


def mates(loops: EdgeArrays, chains: Chains, *, scale: float = 1.0) -> NDArray[np.bool_]:
    """(m, m): which loops are consistent; all must join the same two chains, in one direction.

    `scale` widens all standard deviations.
    """
    count = len(loops)
    first, second = np.triu_indices(count, k=1)
    agree = _Cycles(loops, chains).miss(first, second) < MATE_CHI_SQUARE * scale**2
    found = np.zeros((count, count), dtype=bool)
    found[first[agree], second[agree]] = True
    return found | found.T


@dataclass(frozen=True, slots=True)
class LocalSupport:
    """What the nearest loops, in steps along both chains, say about each of m loops."""

    asked: NDArray[np.int64]  # (m,) how many neighbours there are
    agreeing: NDArray[np.int64]  # (m,) how many of them are consistent with the loop
    cluster_size: NDArray[np.int64]  # (m,) loops that agree with it directly or through others


def local_support(loops: EdgeArrays, chains: Chains, *, scale: float = 1.0) -> LocalSupport:
    """Ask every loop's neighbours; `scale` widens all standard deviations.

    Two wrong loops agree by chance only rarely, right ones nearly always: a loop that disagrees
    with its neighbours is suspect. Wrong loops of one mistaken place agree with each other, but
    right ones usually form the larger clusters.
    """
    count = len(loops)
    if count < 2:
        zero = np.zeros(count, np.int64)
        return LocalSupport(zero, zero, np.ones(count, np.int64))
    oriented = oriented_by_age(loops, chains)
    first, second = _neighbours(oriented, chains)
    agree = _Cycles(oriented, chains).miss(first, second) < MATE_CHI_SQUARE * scale**2
    asked = np.bincount(first, minlength=count) + np.bincount(second, minlength=count)
    first, second = first[agree], second[agree]
    links = coo_matrix((np.ones(len(first)), (first, second)), shape=(count, count))
    _, label = connected_components(links, directed=False)
    return LocalSupport(
        asked=asked,
        agreeing=np.bincount(first, minlength=count) + np.bincount(second, minlength=count),
        cluster_size=np.bincount(label)[label],
    )


def _neighbours(loops: EdgeArrays, chains: Chains) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pairs of loops whose ends are within NEIGHBOUR_STEPS of each other, the nearest ones."""
    count = len(loops)
    # Chains lie so far apart that loops of other pairs of chains are never neighbours.
    place = chains.step + chains.chain * (len(chains.chain) + 2 * NEIGHBOUR_STEPS)
    ends = np.stack([place[loops.source], place[loops.target]], axis=1)
    distance, other = KDTree(ends).query(
        ends, k=min(NEIGHBOURS + 1, count), p=np.inf, distance_upper_bound=NEIGHBOUR_STEPS
    )
    other = np.asarray(other)
    first, column = np.nonzero(np.isfinite(distance) & (other != np.arange(count)[:, None]))
    return first, other[first, column]


class _Cycles:
    """Cycles of two loops and the odometry between their ends."""

    def __init__(self, loops: EdgeArrays, chains: Chains) -> None:
        self.loops, self.chains = loops, chains
        self.variance_m2, self.variance_rad2 = loops.variances()
        self.votes_inverse = stacked.inverse(votes(loops, chains))
        left = loops.source_from_target @ stacked.inverse(chains.poses[loops.target])
        right = chains.poses[loops.source]
        # A cycle is left @ votes_inverse @ right. Only its length and its angle are asked for,
        # which do not change when the rotation of `left` goes around to the other side.
        self.turn = right[:, :3, :3] @ left[:, :3, :3]
        self.offset = (left[:, :3, :3].swapaxes(1, 2) @ left[:, :3, 3:])[..., 0]
        self.start = right[:, :3, 3]

    def miss(self, k: NDArray[np.int64], other: NDArray[np.int64]) -> Array:
        """Squared Mahalanobis norms of the cycles of loops k and other, index arrays alike."""
        vote = self.votes_inverse[other]
        missed_m = np.einsum("nij,nj->ni", vote[:, :3, :3], self.start[k])
        missed_m += vote[:, :3, 3] + self.offset[k]
        trace = np.einsum("nij,nji->n", self.turn[k], vote[:, :3, :3])
        missed_rad = np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0))
        ends = self.loops.source, self.loops.target
        positions = self.chains.poses[:, :3, 3]
        apart = [np.linalg.norm(positions[end[k]] - positions[end[other]], axis=1) for end in ends]
        distance_m = np.maximum(apart[0], apart[1])
        drift_m2 = self._drift(self.chains.drift_m2, self.chains.reach_m2, k, other)
        drift_rad2 = self._drift(self.chains.drift_rad2, self.chains.reach_rad2, k, other)
        lever_rad2 = drift_rad2 / 3.0 + self.variance_rad2[other]
        spread_m2 = drift_m2 + self.variance_m2[k] + self.variance_m2[other]
        spread_m2 = spread_m2 + lever_rad2 * distance_m**2
        spread_rad2 = drift_rad2 + self.variance_rad2[k] + self.variance_rad2[other]
        return (missed_m**2).sum(axis=1) / spread_m2 + missed_rad**2 / spread_rad2

    def _drift(
        self, drift: Array, reach: Array, k: NDArray[np.int64], other: NDArray[np.int64]
    ) -> Array:
        """Variance between the ends of two loops: along odometry, or by way of the start."""
        total = np.zeros(len(k))
        for end in (self.loops.source, self.loops.target):
            along = np.abs(drift[end[k]] - drift[end[other]])
            total += np.minimum(along, reach[end[k]] + reach[end[other]])
        return total


def odometry_miss(loops: EdgeArrays, chains: Chains) -> tuple[Array, Array]:
    """How far each loop contradicts its chain's odometry, and how far that may be off, metres.

    (m,) each: the distance of the loop's target where odometry and where the loop puts it, and
    odometry's standard deviation of it. 0 and infinity where the loop joins two chains.
    """
    source, target = loops.source, loops.target
    predicted = stacked.inverse(chains.poses[source]) @ chains.poses[target]
    miss_m = np.linalg.norm(predicted[:, :3, 3] - loops.source_from_target[:, :3, 3], axis=1)
    drift_m2 = np.abs(chains.drift_m2[source] - chains.drift_m2[target])
    drift_rad2 = np.abs(chains.drift_rad2[source] - chains.drift_rad2[target])
    lever_m = np.linalg.norm(predicted[:, :3, 3], axis=1)
    loop_m2, _ = loops.variances()
    # Each axis on its own: three axes make a distance. Drift bends the way: a lever of the
    # distance alone would call a full circle certain, so the steps' own extent counts too.
    extent_m = np.maximum(lever_m, _extent(loops, chains))
    sigma_m = np.sqrt(3.0 * (drift_m2 + loop_m2 + drift_rad2 / 3.0 * extent_m**2))
    same = chains.chain[source] == chains.chain[target]
    return np.where(same, miss_m, 0.0), np.where(same, sigma_m, np.inf)


def _extent(loops: EdgeArrays, chains: Chains) -> Array:
    """How far each chain reaches from its start, metres, for the loops' chains."""
    reach = np.linalg.norm(chains.poses[:, :3, 3], axis=1)
    farthest = np.zeros(len(reach))
    np.maximum.at(farthest, chains.chain, reach)
    return farthest[chains.chain[loops.source]]


def oriented_by_age(loops: EdgeArrays, chains: Chains) -> EdgeArrays:
    """The loops with the older chain (within one chain: the older vertex) as source."""
    a, b = chains.chain[loops.source], chains.chain[loops.target]
    turn = (a > b) | ((a == b) & (loops.source > loops.target))
    if not turn.any():
        return loops
    # The variances are about equal at both ends: the information keeps its frame.
    matrices = np.where(
        turn[:, None, None], stacked.inverse(loops.source_from_target), loops.source_from_target
    )
    return EdgeArrays(
        source=np.where(turn, loops.target, loops.source),
        target=np.where(turn, loops.source, loops.target),
        source_from_target=matrices,
        information=loops.information,
    )


def votes(loops: EdgeArrays, chains: Chains) -> Array:
    """(m, 4, 4): what each loop says about source_chain_from_target_chain."""
    target_inverse = stacked.inverse(chains.poses[loops.target])
    return chains.poses[loops.source] @ loops.source_from_target @ target_inverse
