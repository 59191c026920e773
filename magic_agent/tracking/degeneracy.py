"""Which directions of a pose do the images really know?

The curvature that Gauss-Newton computes from image gradients cannot tell texture from noise: the
noise of a bare corridor's images has gradients too, and thousands of them add up to a confident
answer about a motion that nothing in the images shows. But noise does not repeat itself. Where a
direction is truly seen, the cost *rises* when the pose is moved along it; where only noise spoke,
the cost stays as it is. So weak directions are probed: the information along each is at most what
the cost at two displaced poses shows.

Directions are eigenvectors of the information in units of the motion prior (its standard
deviations are the unit of each axis), as metres and radians cannot be compared. Along degenerate
ones the pose goes to where the motion prior expects it, in the ratio of the two informations
(solution remapping: Zhang, Kaess and Singh, ICRA 2016).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magic_agent.tracking.config import GaussNewtonConfig
from magic_agent.tracking.gauss_newton import (
    Alignment,
    GaussNewton,
    MotionPrior,
    View,
    ViewFit,
    pixels_moved,
)
from magic_agent.tracking.pyramid import Pyramid
from magic_core.geometry import se3
from magic_core.render.linearisation import linearise

Float64 = NDArray[np.float64]

_SUSPICIOUS_PER_PIXEL = 0.12
"""Relative information per visible pixel below which a direction is probed. Textured rooms have
mostly more in their weakest direction, the noise of a bare corridor 0.04."""
_NOISE = 0.05
"""A rise of the cost below this share of the predicted one is noise. Measured: texture 0.1 to 1,
noise below 0.01."""


@dataclass(frozen=True, slots=True)
class Directions:
    """The information of a pose along its principal directions."""

    basis: Float64  # (6, 6) columns, each one standard deviation of the prior long
    values: Float64  # (6,) information along each, the prior's is 1

    @classmethod
    def of(cls, information: Float64, prior: Float64) -> Directions:
        """Eigenvectors of (6, 6) `information` in units of the diagonal (6, 6) `prior`."""
        deviations = 1.0 / np.sqrt(np.diag(prior))
        scaled = information * np.outer(deviations, deviations)
        values, vectors = np.linalg.eigh(0.5 * (scaled + scaled.T))
        return cls(deviations[:, None] * vectors, values)

    @property
    def information(self) -> Float64:
        """(6, 6) the matrix that has these directions."""
        inverse = np.linalg.inv(self.basis)
        return inverse.T @ (self.values[:, None] * inverse)


def regularised(
    alignment: Alignment,
    views: Sequence[View],
    image: Pyramid,
    *,
    prior: MotionPrior,
    config: GaussNewtonConfig,
) -> Alignment:
    """The alignment with honest information; its degenerate directions follow the prior."""
    directions = probed(alignment, views, image, prior=prior, config=config)
    alignment = replace(alignment, information=directions.information)
    weak = directions.values < config.degenerate_below
    if not weak.any():
        return alignment
    held = _towards(prior, alignment.anchor_from_camera, directions, weak)
    solution = GaussNewton(config).align(
        views,
        image,
        anchor_from_camera=held.anchor_from_camera,
        prior=held,
        coarsest=config.initialised_level,
    )
    return replace(solution, information=directions.information)


def probed(
    alignment: Alignment,
    views: Sequence[View],
    image: Pyramid,
    *,
    prior: MotionPrior,
    config: GaussNewtonConfig,
) -> Directions:
    """The directions of an alignment; suspicious ones with the information that probing shows."""
    directions = Directions.of(alignment.information, prior.information)
    pixels = sum(fit.equations.visible for fit in alignment.fits)
    suspicious = directions.values < _SUSPICIOUS_PER_PIXEL * pixels
    if not suspicious.any():
        return directions
    probe = _Probe(views, alignment.fits, image)
    pose = alignment.anchor_from_camera
    here, values = probe.cost(pose), directions.values.copy()
    for i in np.flatnonzero(suspicious):
        predicted = directions.values[i]
        step = config.probe_pixels / max(
            pixels_moved(directions.basis[:, i], image.cameras[0]), 1e-9
        )
        offset = step * directions.basis[:, i]
        sides = [probe.cost(pose @ se3.exp(sign * offset)) for sign in (-1.0, 1.0)]
        rise = 0.5 * sum(sides) - here
        shown = 2.0 * rise / step**2 / config.pixels_per_sample
        if shown < _NOISE * predicted:
            values[i] = max(shown, 0.0)
    return Directions(directions.basis, values)


@dataclass(frozen=True, slots=True)
class _Probe:
    """The cost of all views at other poses, with scales, gains and biases as they were found."""

    views: Sequence[View]
    fits: Sequence[ViewFit]
    image: Pyramid

    def cost(self, pose: Float64) -> float:
        """Robust cost per pixel seen, times the pixels seen at the solution."""
        return sum(
            self._of_view(view, fit, pose) for view, fit in zip(self.views, self.fits, strict=True)
        )

    def _of_view(self, view: View, fit: ViewFit, pose: Float64) -> float:
        equations = linearise(
            view.pyramid.levels[fit.level],
            self.image.levels[fit.level],
            camera=view.pyramid.cameras[fit.level],
            camera_from_reference=se3.inverse(se3.inverse(view.anchor_from_view) @ pose),
            model=fit.model,
            gain=fit.exposure.gain,
            bias=fit.exposure.bias,
        )
        return equations.mean_cost * fit.equations.visible


def _towards(
    prior: MotionPrior, pose: Float64, directions: Directions, weak: NDArray[np.bool_]
) -> MotionPrior:
    """A prior at the compromise of pose and motion prior along weak directions, which holds the
    pose there and leaves all other directions free."""
    to_prior = np.linalg.solve(
        directions.basis, se3.log(se3.inverse(pose) @ prior.anchor_from_camera)
    )
    share = np.where(weak, 1.0 / (1.0 + directions.values), 0.0)
    held = pose @ se3.exp(directions.basis @ (share * to_prior))
    firm = replace(directions, values=np.where(weak, 10.0 * directions.values[-1] + 1.0, 0.0))
    return MotionPrior(held, firm.information)
