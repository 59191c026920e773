"""Rotation between two images from tiny copies of them, for turns too fast for the pyramid.

Everything is taken to be so far away that translation does not show: the colour residuals of
`magic_core.render.linearisation` then depend on the rotation alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magic_agent.tracking.pyramid import Pyramid
from magic_core.geometry import se3
from magic_core.render.linearisation import ResidualModel, estimate_scales, linearise

_FAR_M = 100.0
_ITERATIONS = 12
_MODEL = ResidualModel(depth_weight=0.0, gate=1e9, colour_width=5.0)


@dataclass(frozen=True, slots=True)
class RotationFit:
    """The rotation found, and colour costs before and after."""

    previous_from_current: NDArray[np.float64]  # (4, 4), the translation of the start kept
    cost_before: float
    cost_after: float


def align_rotation(
    previous: Pyramid, current: Pyramid, *, previous_from_current: NDArray[np.float64]
) -> RotationFit:
    """Turn the given motion so that the coarsest images of two pyramids agree best."""
    image, camera = current.levels[-1], current.cameras[-1]
    reference = _far_reference(previous.levels[-1])
    turn = se3.from_rotation_translation(previous_from_current[:3, :3], np.zeros(3))
    pose = {"camera": camera, "camera_from_reference": se3.inverse(turn)}
    model = estimate_scales(reference, image, model=_MODEL, **pose)
    equations = linearise(reference, image, model=model, **pose)
    first_cost = equations.mean_cost
    for _ in range(_ITERATIONS):
        hessian = equations.hessian[3:6, 3:6] + 1e-6 * np.eye(3)
        step = np.concatenate([np.zeros(3), np.linalg.solve(hessian, -equations.gradient[3:6])])
        trial = se3.exp(step) @ turn
        trial_equations = linearise(
            reference, image, camera=camera, camera_from_reference=se3.inverse(trial), model=model
        )
        if trial_equations.mean_cost >= equations.mean_cost:
            break
        turn, equations = trial, trial_equations
    result = previous_from_current.copy()
    result[:3, :3] = turn[:3, :3]
    return RotationFit(result, first_cost, equations.mean_cost)


def _far_reference(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """(5, h, w) reference view of an (h, w, 4) image with all pixels far away."""
    height, width = image.shape[:2]
    reference = np.ones((5, height, width), np.float32)
    reference[:3] = np.moveaxis(image[:, :, :3], -1, 0)
    reference[3] = _FAR_M
    return reference
