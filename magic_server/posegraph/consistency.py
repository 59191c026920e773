"""Which loops agree with each other: pairwise consistency (Mangelson et al., PCM, 2018).

Two loops between the same two chains close a cycle with the odometry between their ends. They are
mates if the cycle misses identity by no more than loops and odometry explain.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magic_server.posegraph import stacked
from magic_server.posegraph.arrays import EdgeArrays
from magic_server.posegraph.chains import Chains

Array = NDArray[np.float64]

MATE_CHI_SQUARE = 16.81
"""99 % quantile of a chi-square with 6 degrees of freedom."""


def mates(loops: EdgeArrays, chains: Chains, *, slack: float = 1.0) -> NDArray[np.bool_]:
    """(m, m): which loops are consistent; all must join the same two chains, in one direction."""
    count = len(loops)
    found = np.zeros((count, count), dtype=bool)
    loop_m2, loop_rad2 = loops.variances()
    votes_inverse = stacked.inverse(votes(loops, chains))
    target_inverse = stacked.inverse(chains.poses[loops.target])
    for k in range(count):
        # What every other loop says where loop k measured: identity if they agree.
        left = loops.source_from_target[k] @ target_inverse[k]
        missed = left @ votes_inverse @ chains.poses[loops.source[k]]
        distance_m = np.maximum(
            _distances(chains.poses, loops.source[k], loops.source),
            _distances(chains.poses, loops.target[k], loops.target),
        )
        drift_m2, drift_rad2 = _drift(chains, loops, k)
        variance_rad2 = drift_rad2 + loop_rad2[k] + loop_rad2
        lever_rad2 = drift_rad2 / 3.0 + loop_rad2
        variance_m2 = drift_m2 + loop_m2[k] + loop_m2 + lever_rad2 * distance_m**2
        miss = (missed[:, :3, 3] ** 2).sum(axis=1) / variance_m2
        miss += stacked.rotation_angles(missed) ** 2 / variance_rad2
        found[k] = miss < MATE_CHI_SQUARE * slack**2
    found = found | found.T
    np.fill_diagonal(found, False)
    return found


def votes(loops: EdgeArrays, chains: Chains) -> Array:
    """(m, 4, 4): what each loop says about source_chain_from_target_chain."""
    target_inverse = stacked.inverse(chains.poses[loops.target])
    return chains.poses[loops.source] @ loops.source_from_target @ target_inverse


def _distances(poses: Array, one: int, others: NDArray[np.int64]) -> Array:
    return np.linalg.norm(poses[others, :3, 3] - poses[one, :3, 3], axis=1)


def _drift(chains: Chains, loops: EdgeArrays, k: int) -> tuple[Array, Array]:
    """Odometry's variance between the ends of loop k and those of every loop."""
    drift = []
    for accumulated in (chains.drift_m2, chains.drift_rad2):
        at_source = np.abs(accumulated[loops.source] - accumulated[loops.source[k]])
        at_target = np.abs(accumulated[loops.target] - accumulated[loops.target[k]])
        drift.append(at_source + at_target)
    return drift[0], drift[1]
