"""Does a transform explain both views? Figures and gates that do not trust ICP fitness alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magic_core.geometry import se3
from magic_server.registration import projective
from magic_server.registration.config import RegistrationConfig
from magic_server.registration.refine import FramePair, Pyramids, Sampling

Array = NDArray[np.float64]


LEAST_COLOUR_SPREAD = 0.02
"""Below this, colours are noise and their correlation says nothing."""


@dataclass(frozen=True, slots=True)
class Figures:
    """How well two views agree under a transform."""

    fitness: float
    """Share of the readings falling on readings of the other view that agree in depth."""
    rmse_m: float
    """Root mean square point-to-plane distance of the agreeing readings."""
    overlap: float
    """Share of a view's readings that the other one confirms; the mean of both directions."""
    texture_correlation: float
    """Correlation of contrast-normalised intensity over the agreeing readings, -1 to 1."""
    colour_correlation: float
    """Correlation of the opponent colours R-G and G-B over the agreeing readings."""
    colour_spread: float
    """Their standard deviation, the smaller of the two views (0 to 1); grey places have none."""
    free_space: float
    """Share of compared readings that stand in space the other view saw through, or on the back
    of what it saw."""

    @property
    def score(self) -> float:
        """Ranks hypotheses of one pair of views."""
        agreement = max(self.texture_correlation, 0.02) * (1.0 - self.free_space) ** 2
        return self.overlap * self.fitness * agreement


def figures_of(
    source: Pyramids,
    target: Pyramids,
    target_from_source: Array,
    *,
    pairs: Sequence[FramePair],
    level: int,
) -> Figures:
    """Compare all pairs of images in both directions at one level."""
    source_from_target = se3.inverse(target_from_source)
    totals = np.zeros(projective.FIGURES)
    shares = []
    for pair in pairs:
        a, b = source.at(pair.source, level), target.at(pair.target, level)
        eye_a, eye_b = (se3.inverse(view.camera_from_anchor)[:3, 3] for view in (a, b))
        forward = _compare(a, b, a.points, eye_a, b.camera_from_anchor @ target_from_source)
        seen_b = se3.transform_points(source_from_target, np.vstack([b.points, eye_b]))
        back = _compare(b, a, seen_b[:-1], seen_b[-1], a.camera_from_anchor)
        totals += forward + back
        shares.append(
            0.5 * forward[projective.CONFIRMED] / max(len(a.points), 1)
            + 0.5 * back[projective.CONFIRMED] / max(len(b.points), 1)
        )
    compared = max(totals[projective.COMPARED], 1.0)
    confirmed = totals[projective.CONFIRMED]
    return Figures(
        fitness=float(confirmed / compared),
        rmse_m=float(np.sqrt(totals[projective.SQUARED_ERROR] / max(confirmed, 1.0))),
        overlap=float(max(shares, default=0.0)),
        texture_correlation=_correlation(totals[projective.TEXTURE_SUMS]),
        colour_correlation=_correlation(totals[projective.COLOUR_SUMS]),
        colour_spread=_spread(totals[projective.COLOUR_SUMS]),
        free_space=float(totals[projective.CONTRADICTED] / compared),
    )


def strictest(chosen: Figures, everything: Figures) -> Figures:
    """The figures of the images that see most of each other, but no contradiction forgotten:
    free space and colour as the worse of theirs and of all pairs of images."""
    return replace(
        chosen,
        free_space=max(chosen.free_space, everything.free_space),
        colour_correlation=min(chosen.colour_correlation, everything.colour_correlation),
    )


def refusal(figures: Figures, inliers: int, information: Array, config: RegistrationConfig) -> str:
    """The reason code of the first gate that fails; empty if all pass."""
    gates = (
        ("FEW_INLIERS", inliers >= config.min_inliers),
        ("LOW_OVERLAP", figures.overlap >= config.min_overlap),
        ("LOW_FITNESS", figures.fitness >= config.min_fitness),
        ("HIGH_RMSE", figures.rmse_m <= config.max_rmse_m),
        ("FREE_SPACE", figures.free_space <= config.max_free_space),
        ("TEXTURE_MISMATCH", figures.texture_correlation >= config.min_texture_correlation),
        (
            "COLOUR_MISMATCH",
            figures.colour_spread < LEAST_COLOUR_SPREAD
            or figures.colour_correlation >= config.min_colour_correlation,
        ),
        ("DEGENERATE", np.linalg.eigvalsh(information)[0] >= config.min_information),
    )
    return next((reason for reason, passed in gates if not passed), "")


def _compare(
    moving: Sampling, fixed: Sampling, points: Array, centre: Array, fixed_from_source: Array
) -> Array:
    figures = np.zeros(projective.FIGURES)
    projective.compare(
        points, moving.texture, moving.colour, moving.variance, centre, fixed_from_source,
        fixed.intrinsics, fixed.level.depth, fixed.depth_variance, fixed.level.normals,
        fixed.level.texture, fixed.level.colour, figures,
    )  # fmt: skip
    return figures


def _correlation(sums: Array) -> float:
    count, a, b, aa, bb, ab = sums
    if count < 10:
        return 0.0
    spread_a, spread_b = aa / count - (a / count) ** 2, bb / count - (b / count) ** 2
    if min(spread_a, spread_b) < 1e-9:
        return 0.0
    return float((ab / count - a * b / count**2) / np.sqrt(spread_a * spread_b))


def _spread(sums: Array) -> float:
    count, a, b, aa, bb, _ = sums
    count = max(count, 1.0)
    least = min(aa / count - (a / count) ** 2, bb / count - (b / count) ** 2)
    return float(np.sqrt(max(least, 0.0)))
