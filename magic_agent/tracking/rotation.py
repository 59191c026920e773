"""Rotation between two images from tiny copies of them, for turns too fast for the pyramid.

Everything is taken to be so far away that translation does not show: the colour residuals of
`magic_core.render.linearisation` then depend on the rotation alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_agent.tracking.pyramid import Pyramid
from magic_core.geometry import Camera, se3
from magic_core.render.linearisation import (
    NormalEquations,
    ResidualModel,
    estimate_scales,
    linearise,
)

_FAR_M = 100.0
_ITERATIONS = 8
_CONVERGED_PIXELS = 0.05
_MIN_WIDTH = 40  # pixels
_EXPECTED_PIXELS = 2.0  # a smaller surprise is within reach of the coarse-to-fine alignment
_MIN_CONTRAST = 0.01  # of full scale; below, all turns fit equally well
_MODEL = ResidualModel(depth_weight=0.0, gate=1e9, colour_width=5.0)


@dataclass(frozen=True, slots=True)
class RotationFit:
    """The rotation found, and colour costs before and after."""

    previous_from_current: NDArray[np.float64]  # (4, 4), the translation of the start kept
    cost_before: float
    cost_after: float


def align_rotation(
    previous: Pyramid, current: Pyramid, *, previous_from_current: NDArray[np.float64]
) -> RotationFit | None:
    """Turn the given motion so that tiny images of two frames agree best.

    Phase correlation, which knows no local minima, tells how the images are shifted. None where
    that is what the given motion expects, or an image shows nothing; otherwise both rotations are
    refined and the better one counts.
    """
    level = _level(current)
    image, camera = current.levels[level], current.cameras[level]
    if min(previous.levels[level][..., 1].std(), image[..., 1].std()) < _MIN_CONTRAST:
        return None
    reference = _far_reference(previous.levels[level])
    given = se3.from_rotation_translation(previous_from_current[:3, :3], np.zeros(3))
    shifted = shifting_rotation(reference, image, camera)
    if se3.rotation_angle(se3.inverse(given) @ shifted) * camera.fx < _EXPECTED_PIXELS:
        return None
    model = estimate_scales(
        reference, image, camera=camera, camera_from_reference=se3.inverse(given), model=_MODEL
    )
    problem = _Problem(reference, image, camera, model)
    turn, cost = min((problem.solve(start) for start in (given, shifted)), key=lambda fit: fit[1])
    result = previous_from_current.copy()
    result[:3, :3] = turn[:3, :3]
    return RotationFit(result, problem.linearise(given).mean_cost, cost)


def shifting_rotation(
    reference: NDArray[np.float32], image: NDArray[np.float32], camera: Camera
) -> NDArray[np.float64]:
    """(4, 4) previous_from_current that turns about x and y as the whole image seems to shift."""
    before, after = reference[:3].mean(axis=0), image[..., :3].mean(axis=-1)
    window = cv2.createHanningWindow((camera.width, camera.height), cv2.CV_32F)
    (shift_u, shift_v), _ = cv2.phaseCorrelate(
        np.ascontiguousarray(before), np.ascontiguousarray(after), window
    )
    about_x, about_y = np.arctan2(shift_v, camera.fy), -np.arctan2(shift_u, camera.fx)
    return se3.exp([0.0, 0.0, 0.0, about_x, about_y, 0.0])


@dataclass(frozen=True, slots=True)
class _Problem:
    """Two tiny images whose rotation is sought."""

    reference: NDArray[np.float32]
    image: NDArray[np.float32]
    camera: Camera
    model: ResidualModel

    def linearise(self, turn: NDArray[np.float64]) -> NormalEquations:
        return linearise(
            self.reference,
            self.image,
            camera=self.camera,
            camera_from_reference=se3.inverse(turn),
            model=self.model,
            threads=1,
        )

    def solve(self, turn: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
        """Gauss-Newton on the rotation alone: (rotation, cost) where it stops improving."""
        equations = self.linearise(turn)
        for _ in range(_ITERATIONS):
            hessian = equations.hessian[3:6, 3:6] + 1e-6 * np.eye(3)
            step = np.concatenate([np.zeros(3), np.linalg.solve(hessian, -equations.gradient[3:6])])
            trial = se3.exp(step) @ turn
            trial_equations = self.linearise(trial)
            if trial_equations.mean_cost >= equations.mean_cost:
                break
            turn, equations = trial, trial_equations
            if np.linalg.norm(step) * self.camera.fx < _CONVERGED_PIXELS:
                break
        return turn, equations.mean_cost


def _level(pyramid: Pyramid) -> int:
    """The coarsest level that is still wide enough to be shifted."""
    wide = [i for i, camera in enumerate(pyramid.cameras) if camera.width >= _MIN_WIDTH]
    return wide[-1] if wide else 0


def _far_reference(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """(5, h, w) reference view of an (h, w, 4) image with all pixels far away."""
    height, width = image.shape[:2]
    reference = np.ones((5, height, width), np.float32)
    reference[:3] = np.moveaxis(image[:, :, :3], -1, 0)
    reference[3] = _FAR_M
    return reference
