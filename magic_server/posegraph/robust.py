"""Find the wrong loops of one component: who supports whom, chains first, then everything.

1. Every loop asks its neighbours (consistency): those that disagree are not trusted at first.
2. Every odometry chain is solved with its own trusted loops, which takes most of its drift out.
3. Chains are placed by the consensus of the loops between them (placement).
4. Graduated non-convexity over all trusted loops (in a large graph: with short runs of vertices
   as rigid bodies), then everything that fits is taken up.
All of it again with wider bounds where that explains the loops better (noise was understated).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from magic_server.posegraph.arrays import connected_sets
from magic_server.posegraph.bodies import bodies_of
from magic_server.posegraph.chains import Chains, shortened
from magic_server.posegraph.consistency import LocalSupport, local_support, odometry_miss
from magic_server.posegraph.gnc import (
    ROUGH,
    SWIFT,
    GncResult,
    RobustGraph,
    graduated,
    polished,
)
from magic_server.posegraph.placement import known_frames, place
from magic_server.posegraph.problem import PoseGraphConfig

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

LEAST_SUPPORT_SHARE = 0.5
"""A trusted loop agrees with this share of its neighbours, and with two at least."""
MIN_TRUSTED_SHARE = 0.25
"""Below this, loops are too sparse to speak for each other, and all of them take part."""
SEED_SHARE = 0.25
"""Clusters of this size, relative to the largest, are solved with first."""
CONTINUED_FROM = 300
"""Smaller graphs are solved from the start every time: that takes no longer than a blink."""
CONTINUED_SHARE = 0.7
"""An earlier solution that explains fewer loops than this is no start."""
BODIES = 1000
"""Graphs of twice as many vertices are annealed as this many rigid runs."""
DRIFT_SIGMAS = 3.0
MAX_SCALE = 8.0
NEAR_MISS_SHARE = 0.1
REJECTION_NATS = 25.0
"""What it costs to call a loop wrong: it could point anywhere in a building."""


class RobustSolver:
    """Solves one component; vertices are numbered from 0, the oldest first."""

    def __init__(
        self,
        graph: RobustGraph,
        chains: Chains,
        priors: Mapping[int, Array],
        config: PoseGraphConfig,
    ) -> None:
        self._graph = graph
        self._priors = priors
        self._max_unsupported_m = config.max_unsupported_correction_m
        self._limit = config.squared_norm_limit
        self._chains = chains

    def solve(self, initial: Array | None = None) -> GncResult:
        """GNC, again with wider bounds while that explains the loops better.

        Where an earlier solution `initial` (n, 4, 4) explains everything, it is only polished.
        """
        warm = None if initial is None else self._continued(initial)
        if warm is not None:
            return warm
        scale = 1.0
        best = self._at_scale(scale)
        cost = self._description_cost(best, scale)
        while scale < MAX_SCALE and self._has_near_misses(best):
            scale *= 2.0
            wider = self._at_scale(scale)
            wider_cost = self._description_cost(wider, scale)
            if wider_cost >= cost:
                break
            best, cost = wider, wider_cost
        return best

    def _continued(self, initial: Array) -> GncResult | None:
        """The earlier solution with what is new, if that leaves no doubt; None if it does.

        Doubt is: a rejected loop that others support or cannot speak about, that drift may
        explain, or that alone would join what is apart.
        """
        graph = self._graph
        if len(initial) < CONTINUED_FROM:
            return None
        fits = graph.loops.squared_norms(initial) < self._limit
        if fits.mean() < CONTINUED_SHARE:
            return None
        result = polished(graph, initial, limit=self._limit)
        if result.kept.all():
            return result
        support = local_support(graph.loops, self._chains)
        unheard = (support.asked == 0) | self._is_drift()
        if ((_trusted(support) | unheard) & ~result.kept).any():
            return None
        sets = connected_sets(len(initial), graph.odometry, graph.loops.select(result.kept))
        return result if (sets == sets[0]).all() else None

    def _at_scale(self, scale: float) -> GncResult:
        graph, limit = self._graph, self._limit * scale**2
        support = local_support(graph.loops, self._chains, scale=scale)
        trusted = _trusted(support)
        if trusted.sum() < MIN_TRUSTED_SHARE * len(trusted):
            trusted = ~self._lacks_witness(support, scale)
        if len(self._chains.oldest) == 1:
            seed = trusted & (support.cluster_size >= SEED_SHARE * support.cluster_size.max())
            start = self._placed(self._chains, trusted)
            return graduated(graph, start, limit=limit, seed=seed, candidates=trusted)
        chains = self._straightened(support, trusted, limit)
        start = self._placed(chains, trusted, scale=scale)
        coarse = self._annealed_as_bodies(replace(chains, poses=start), trusted, limit)
        if coarse is not None:
            return polished(graph, coarse.poses, limit=limit, start=start, kept=coarse.kept)
        return graduated(graph, start, limit=limit, seed=None, candidates=trusted, annealing=SWIFT)

    def _annealed_as_bodies(self, placed: Chains, trusted: Mask, limit: float) -> GncResult | None:
        """Poses and loops by the motion of short runs of vertices; None for a small graph."""
        graph, count = self._graph, len(placed.poses)
        if count < 2 * BODIES:
            return None
        bodies = bodies_of(graph.odometry, graph.loops, placed, -(-count // BODIES))
        if bodies is None:
            return None
        inside = bodies.loops.source == bodies.loops.target
        between = np.flatnonzero(~inside)
        anchors = bodies.held(graph.anchors)
        small = RobustGraph(bodies.odometry, bodies.loops.select(between), anchors)
        result = graduated(
            small,
            placed.poses[bodies.first],
            limit=limit,
            seed=None,
            candidates=trusted[between],
            annealing=SWIFT,
            final=False,
        )
        kept = trusted & inside
        kept[between] = result.kept
        return GncResult(bodies.spread(result.poses), kept, placed.poses)

    def _lacks_witness(self, support: LocalSupport, scale: float) -> Mask:
        """Loops that alone would move a map farther than one witness may."""
        miss_m, sigma_m = odometry_miss(self._graph.loops, self._chains)
        far = miss_m > self._max_unsupported_m + DRIFT_SIGMAS * scale * sigma_m
        return far & (support.agreeing == 0)

    def _is_drift(self) -> Mask:
        """Loops that contradict their chain's odometry by no more than its drift explains."""
        miss_m, sigma_m = odometry_miss(self._graph.loops, self._chains)
        return (miss_m < DRIFT_SIGMAS * sigma_m) & np.isfinite(sigma_m)

    def _placed(self, chains: Chains, trusted: Mask, *, scale: float = 1.0) -> Array:
        known = known_frames(chains, self._priors)
        return place(
            chains, self._graph.loops, known, weights=trusted.astype(np.float64), scale=scale
        )

    def _straightened(self, support: LocalSupport, trusted: Mask, limit: float) -> Chains:
        """The chains, each solved with its own trusted loops."""
        loops, chain = self._graph.loops, self._chains.chain
        own = trusted & (chain[loops.source] == chain[loops.target])
        poses = self._chains.poses.copy()
        kept = np.zeros(len(loops), dtype=bool)
        for oldest in np.unique(chain[loops.source[own]]).tolist():
            inside = np.flatnonzero(own & (chain[loops.source] == oldest))
            members = np.flatnonzero(chain == oldest)
            result = self._solved_alone(members, inside, support, limit)
            poses[members] = result.poses
            kept[inside] = result.kept
        straight = replace(self._chains, poses=poses)
        return shortened(straight, self._graph.odometry, loops.select(kept))

    def _solved_alone(
        self, members: NDArray, inside: NDArray, support: LocalSupport, limit: float
    ) -> GncResult:
        """One chain with the given loops, its oldest vertex at identity."""
        new_number = np.full(len(self._chains.chain), -1, dtype=np.int64)
        new_number[members] = np.arange(len(members))
        odometry = self._graph.odometry
        alone = RobustGraph(
            odometry.select(new_number[odometry.source] >= 0).renumbered(new_number),
            self._graph.loops.select(inside).renumbered(new_number),
            {0: np.eye(4)},
        )
        sizes = support.cluster_size[inside]
        seed = sizes >= SEED_SHARE * sizes.max()
        start = self._chains.poses[members]
        return graduated(alone, start, limit=limit, seed=seed, annealing=ROUGH, final=False)

    def _description_cost(self, result: GncResult, scale: float) -> float:
        """Negative log-likelihood (nats, up to a constant) of noise `scale` times the claimed.

        Residuals count by their degrees of freedom (restricted likelihood, as odometry alone has
        none).
        """
        graph = self._graph
        kept = graph.loops.select(result.kept)
        fixed = len(self._priors) or 1
        freedom = 6 * max(len(graph.odometry) + len(kept) + fixed - len(result.poses), 0)
        squared = graph.odometry.squared_norms(result.poses).sum()
        squared += kept.squared_norms(result.poses).sum()
        rejected = len(graph.loops) - len(kept)
        fit = squared / (2 * scale**2) + freedom * np.log(scale)
        return float(fit + rejected * REJECTION_NATS)

    def _has_near_misses(self, result: GncResult) -> bool:
        """Whether many loops were rejected that a larger noise would explain."""
        squared = self._graph.loops.squared_norms(result.poses)
        near = ~result.kept & (squared < self._limit * MAX_SCALE**2)
        return near.sum() > NEAR_MISS_SHARE * max(result.kept.sum(), 1)


def _trusted(support: LocalSupport) -> Mask:
    return (support.agreeing >= 2) & (support.agreeing >= support.asked * LEAST_SUPPORT_SHARE)
