"""Graduated non-convexity with truncated least squares (Yang et al. 2020) over GTSAM.

Odometry is trusted; loops get weights in [0, 1]. Loops with no weight are *left out* of the
linear system: with zero-weight factors in it, GTSAM's own GncLMOptimizer fills in and takes
minutes.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from magic_server.posegraph.arrays import EdgeArrays
from magic_server.posegraph.optimiser import (
    FactorCache,
    anchored,
    chordal_start,
    optimise,
    poses_of,
    values_of,
)

logger = logging.getLogger(__name__)

Array = NDArray[np.float64]

LEAST_MU = 0.002
"""Annealing starts no wider than loops 22 times beyond their bound: the start is placed already."""
LAST_MU = 0.5
"""Here loops count up to 3 times beyond their bound; the polish then cuts at the bound."""
MAX_ROUNDS = 30
LEAST_WEIGHT = 1e-3
SAME_WEIGHTS = 0.005
"""A round whose weights differ from the last one's by less than this on average is left out."""
ROUGHLY = 1e-3
"""Rounds whose optimum is not the end result stop once they gain less than this share."""
FINELY = 1e-7
"""Near the optimum an iteration that gains less than this has arrived."""
POLISH_ROUNDS = 5
POLISH_ITERATIONS = 1
FINAL_ITERATIONS = 50
SEED_ITERATIONS = 6


@dataclass(frozen=True, slots=True)
class Annealing:
    """How fast graduated non-convexity goes from nearly convex to truncated least squares."""

    step: float
    """Factor of the control parameter mu from round to round."""
    iterations: int
    """Iterations per round."""


CAREFUL = Annealing(step=2.0, iterations=2)
"""From a start that drift may have carried far away."""
SWIFT = Annealing(step=2.0, iterations=1)
"""From a start that most loops agree with already."""
ROUGH = Annealing(step=4.0, iterations=1)
"""Of what is annealed again in a larger whole."""


@dataclass(frozen=True, slots=True)
class GncResult:
    """Poses (n, 4, 4), which loops (m,) they rest on, and where the search began."""

    poses: Array
    kept: NDArray[np.bool_]
    start: Array


class RobustGraph:
    """A component with trusted edges and doubtful loops, solved again and again."""

    def __init__(self, odometry: EdgeArrays, loops: EdgeArrays, anchors: dict[int, Array]) -> None:
        self.odometry = odometry
        self.loops = loops
        self.anchors = anchors
        self._last: tuple[Array, gtsam.Values] | None = None
        self._loop_factors = FactorCache(loops)
        self._base = anchored(anchors)
        odometry_factors = FactorCache(odometry)
        for index in range(len(odometry)):
            self._base.add(odometry_factors.factor(index))

    def solve(
        self, poses: Array, weights: Array, *, max_iterations: int, tolerance: float = 1e-9
    ) -> Array:
        """Optimise with the loops' weights (m,); weights below LEAST_WEIGHT are dropped."""
        graph = self._weighted(weights)
        start = self._values(poses)
        values = optimise(graph, start, max_iterations=max_iterations, tolerance=tolerance)
        found = poses_of(values, len(poses))
        self._last = found, values
        return found

    def optimum(self, poses: Array, kept: NDArray[np.bool_]) -> Array:
        """Poses (n, 4, 4) at the optimum with the loops that are kept, from near it."""
        return self.solve(
            poses, kept.astype(float), max_iterations=FINAL_ITERATIONS, tolerance=FINELY
        )

    def _values(self, poses: Array) -> gtsam.Values:
        """GTSAM's copy of the poses; that of the last result is still at hand."""
        if self._last is not None and self._last[0] is poses:
            return self._last[1]
        return values_of(poses)

    def _weighted(self, weights: Array) -> gtsam.NonlinearFactorGraph:
        graph = self._base.clone()
        for index in np.flatnonzero(weights > LEAST_WEIGHT).tolist():
            graph.add(self._loop_factors.factor(index, float(weights[index])))
        return graph

    def best_start(self, poses: Array, weights: Array) -> Array:
        """The given poses, or chordal initialisation where that is possible and starts lower."""
        graph = self._weighted(weights)
        chordal = chordal_start(graph, len(poses))
        if chordal is None:
            return poses
        errors = [graph.error(values_of(start)) for start in (poses, chordal)]
        return chordal if np.isfinite(errors[1]) and errors[1] < errors[0] else poses


def graduated(
    graph: RobustGraph,
    poses: Array,
    *,
    limit: float,
    seed: NDArray[np.bool_] | None,
    candidates: NDArray[np.bool_] | None = None,
    annealing: Annealing = CAREFUL,
    final: bool = True,
) -> GncResult:
    """Anneal from nearly convex to truncated least squares; `limit` is the chi-square bound.

    `seed` are loops to solve with first. `candidates` keeps the annealing to some loops; the
    polish may take up the others. `final` ends at the optimum, else near it.
    """
    allowed = np.ones(len(graph.loops), bool) if candidates is None else candidates
    start = poses
    if seed is not None:
        poses = graph.solve(
            poses, seed.astype(float), max_iterations=SEED_ITERATIONS, tolerance=ROUGHLY
        )
    squared = graph.loops.squared_norms(poses)
    largest = float(squared[allowed].max(initial=0.0))
    if largest > limit:
        mu = max(limit / max(2.0 * largest - limit, 1e-9), LEAST_MU)
        solved_with = np.full(len(squared), np.inf)
        for _ in range(MAX_ROUNDS):
            weights = np.where(allowed, _weights(squared, mu, limit), 0.0)
            if np.abs(weights - solved_with).mean() > SAME_WEIGHTS:
                poses = graph.solve(
                    poses, weights, max_iterations=annealing.iterations, tolerance=ROUGHLY
                )
                squared, solved_with = graph.loops.squared_norms(poses), weights
            if mu >= LAST_MU:
                break
            mu *= annealing.step
    return polished(graph, poses, limit=limit, start=start, final=final)


def polished(
    graph: RobustGraph,
    poses: Array,
    *,
    limit: float,
    start: Array | None = None,
    kept: NDArray[np.bool_] | None = None,
    final: bool = True,
) -> GncResult:
    """Alternate between keeping what fits and solving with it, until nothing changes.

    `kept` (m,) are the loops to begin with; without them, those that fit the poses.
    """
    start = poses if start is None else start
    kept = graph.loops.squared_norms(poses) < limit if kept is None else kept
    for _ in range(POLISH_ROUNDS):
        poses = graph.solve(
            poses, kept.astype(float), max_iterations=POLISH_ITERATIONS, tolerance=ROUGHLY
        )
        fits = graph.loops.squared_norms(poses) < limit
        if (fits == kept).all():
            break
        kept = fits
    if final:
        poses = graph.optimum(poses, kept)
    return GncResult(poses=poses, kept=kept, start=start)


def _weights(squared: Array, mu: float, limit: float) -> Array:
    """Weights of truncated least squares at control parameter mu (equation 14 of the paper)."""
    upper, lower = (mu + 1.0) / mu * limit, mu / (mu + 1.0) * limit
    middle = np.sqrt(limit * mu * (mu + 1.0) / np.maximum(squared, 1e-12)) - mu
    return np.where(squared >= upper, 0.0, np.where(squared <= lower, 1.0, np.clip(middle, 0, 1)))
