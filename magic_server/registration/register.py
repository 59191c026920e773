"""Register two views: hypotheses, refinement of the best ones, verification, information."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from magic_server.registration.coarse import Hypothesis, coarse_method
from magic_server.registration.config import RegistrationConfig
from magic_server.registration.refine import FramePair, Pyramids, Refined, refine
from magic_server.registration.verify import Figures, figures_of, refusal, strictest
from magic_server.registration.view import AnchorView, PreparedView, prepare

Array = NDArray[np.float64]

ACCEPTED = "ACCEPTED"
NO_HYPOTHESIS = "NO_HYPOTHESIS"
MAX_FRAME_PAIRS = 4
LEAST_PAIR_OVERLAP = 0.1
NO_FIGURES = Figures(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class RegistrationResult:
    """The verdict on a pair of views, with the figures it rests on."""

    accepted: bool
    reason: str
    """ACCEPTED, or why not: NO_HYPOTHESIS, FEW_INLIERS, LOW_OVERLAP, LOW_FITNESS, HIGH_RMSE,
    FREE_SPACE, TEXTURE_MISMATCH, COLOUR_MISMATCH, DEGENERATE."""
    target_from_source: Array
    """(4, 4): maps points in the source's anchor frame to the target's."""
    information: Array
    """(6, 6), tangent order (translation, rotation), right perturbation; 1/m^2, 1/rad^2."""
    fitness: float
    rmse_m: float
    inliers: int
    """Correspondences of the coarse method that agree."""
    overlap: float
    texture_correlation: float
    colour_correlation: float
    free_space: float
    method: str
    """The coarse method whose hypothesis won; empty if none."""
    seconds: float


def register(
    source: AnchorView | PreparedView,
    target: AnchorView | PreparedView,
    config: RegistrationConfig,
    *,
    clock: Callable[[], float] = time.perf_counter,
) -> RegistrationResult:
    """Find and verify target_from_source. Never raises for views that do not match."""
    started = clock()
    if isinstance(source, AnchorView):
        source = prepare(source, config)
    if isinstance(target, AnchorView):
        target = prepare(target, config)
    best = _best_candidate(source, target, config)
    if best is None:
        return _result(NO_HYPOTHESIS, None, clock() - started)
    reason = best.refusal(config) or ACCEPTED
    information = best.information(config, rmse_m=best.figures.rmse_m)
    return _result(reason, best, clock() - started, information)


def loop_information(
    hessian: Array, config: RegistrationConfig, *, by_anchors: bool = True, rmse_m: float = 0.0
) -> Array:
    """The information of a loop edge from the Gauss-Newton matrix of all pixels.

    Neighbouring pixels err together, and calibration and surface bias do not average out. Nor does
    what keeps two sub-maps' surfaces `rmse_m` apart where they lie best: each is bent by its own
    drift, and another place of the same two would say another transform.
    """
    left_m = config.residual_share * rmse_m
    variance_m2 = config.systematic_m**2 + left_m**2
    variance_rad2 = config.systematic_rad**2 + (left_m / config.residual_lever_m) ** 2
    if not by_anchors:
        variance_m2 += config.keyframe_drift_m**2
        variance_rad2 += config.keyframe_drift_rad**2
    systematic = np.diag([variance_m2] * 3 + [variance_rad2] * 3)
    scaled = hessian / config.correlated_pixels
    # (S + M^-1)^-1 without inverting M, which may be singular: M (S M + I)^-1.
    information = scaled @ np.linalg.inv(systematic @ scaled + np.eye(6))
    return 0.5 * (information + information.T)


@dataclass(frozen=True, slots=True)
class _Candidate:
    hypothesis: Hypothesis
    refined: Refined
    figures: Figures
    pairs: tuple[FramePair, ...]

    def refusal(self, config: RegistrationConfig) -> str:
        """The reason code of the first gate that fails; empty if all pass."""
        inliers = self.hypothesis.inliers
        return refusal(self.figures, inliers, self.information(config), config)

    def information(self, config: RegistrationConfig, *, rmse_m: float = 0.0) -> Array:
        """Of target_from_source, (6, 6)."""
        by_anchors = self.pairs == (FramePair(0, 0),)
        hessian = self.refined.hessian
        return loop_information(hessian, config, by_anchors=by_anchors, rmse_m=rmse_m)


def _best_candidate(
    source: PreparedView, target: PreparedView, config: RegistrationConfig
) -> _Candidate | None:
    """The first hypothesis that passes every gate, or else the one that agrees best.

    Hypotheses are made one after the other, cheap ones first, and refined coarsely. What then
    looks right is refined fully; if it passes, the remaining ones are never made.
    """
    a, b = Pyramids(source, config), Pyramids(target, config)
    best: _Candidate | None = None
    for hypothesis in _hypotheses(source, target, config):
        candidate = _coarsely_refined(a, b, hypothesis, config)
        if candidate is None:
            continue
        if not candidate.refusal(config):
            fine = _finely_refined(a, b, candidate, config)
            if not fine.refusal(config):
                return fine
        if best is None or candidate.figures.score > best.figures.score:
            best = candidate
    return best and _finely_refined(a, b, best, config)


def _hypotheses(
    source: PreparedView, target: PreparedView, config: RegistrationConfig
) -> Iterator[Hypothesis]:
    if "visual" in config.methods and (source.lead or target.lead):
        # What the two that look alike share is clearer without all the others' keypoints.
        proposed = coarse_method("visual").propose(source.of_lead, target.of_lead, config)
        yield from islice(proposed, config.max_hypotheses)
    for name in config.methods:
        proposed = coarse_method(name).propose(source, target, config)
        yield from islice(proposed, config.max_hypotheses)


def _coarsely_refined(
    a: Pyramids, b: Pyramids, hypothesis: Hypothesis, config: RegistrationConfig
) -> _Candidate | None:
    coarsest = config.pyramid_levels - 1
    pairs = _overlapping_pairs(a, b, hypothesis.target_from_source, coarsest)
    if not pairs:
        return None
    levels = range(coarsest, min(coarsest, 1) - 1, -1)
    refined = refine(a, b, hypothesis.target_from_source, pairs=pairs, levels=levels, config=config)
    level = min(coarsest, 1)
    figures = figures_of(a, b, refined.target_from_source, pairs=pairs, level=level)
    return _Candidate(hypothesis, refined, figures, pairs)


def _finely_refined(
    a: Pyramids, b: Pyramids, candidate: _Candidate, config: RegistrationConfig
) -> _Candidate:
    """At full size, by the pairs of images that see most of each other, keyframes included:
    that spreads the tracker's drift within the sub-maps, where anchors alone would be nearer to
    each other and leave the rest of both trajectories farther off (measured on whole runs)."""
    start = candidate.refined.target_from_source
    coarsest = config.pyramid_levels - 1
    pairs = _overlapping_pairs(a, b, start, coarsest) or candidate.pairs
    refined = refine(a, b, start, pairs=pairs, levels=(0,), config=config)
    figures = figures_of(a, b, refined.target_from_source, pairs=pairs, level=0)
    everything = figures_of(
        a, b, refined.target_from_source, pairs=_all_pairs(a, b), level=min(coarsest, 1)
    )
    return _Candidate(candidate.hypothesis, refined, strictest(figures, everything), pairs)


def _overlapping_pairs(
    a: Pyramids, b: Pyramids, target_from_source: Array, level: int
) -> tuple[FramePair, ...]:
    """The pairs of images that see most of each other."""
    everything = _all_pairs(a, b)
    if len(everything) == 1:
        return everything
    overlaps = [
        figures_of(a, b, target_from_source, pairs=(pair,), level=level).overlap
        for pair in everything
    ]
    order = np.argsort(-np.array(overlaps), kind="stable")[:MAX_FRAME_PAIRS]
    return tuple(everything[i] for i in order if overlaps[i] >= LEAST_PAIR_OVERLAP)


def _all_pairs(a: Pyramids, b: Pyramids) -> tuple[FramePair, ...]:
    return tuple(
        FramePair(i, j) for i in range(len(a.view.frames)) for j in range(len(b.view.frames))
    )


def _result(
    reason: str, best: _Candidate | None, seconds: float, information: Array | None = None
) -> RegistrationResult:
    figures = best.figures if best else NO_FIGURES
    return RegistrationResult(
        accepted=reason == ACCEPTED,
        reason=reason,
        target_from_source=best.refined.target_from_source if best else np.eye(4),
        information=np.zeros((6, 6)) if information is None else information,
        fitness=figures.fitness,
        rmse_m=figures.rmse_m,
        inliers=best.hypothesis.inliers if best else 0,
        overlap=figures.overlap,
        texture_correlation=figures.texture_correlation,
        colour_correlation=figures.colour_correlation,
        free_space=figures.free_space,
        method=best.hypothesis.method if best else "",
        seconds=seconds,
    )
