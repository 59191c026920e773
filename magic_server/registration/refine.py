"""Joint refinement of a coarse transform against the depth and texture of both views.

Gauss-Newton over image pyramids: every point of either view is projected into the other one; its
point-to-plane distance and its texture difference are weighted by the sensor's noise. Using both
directions halves the bias that either view's normals bring.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magic_core.geometry import se3
from magic_server.registration import projective
from magic_server.registration.config import RegistrationConfig
from magic_server.registration.view import Level, PreparedFrame, PreparedView, depth_sigma

Array = NDArray[np.float64]

GATES_M = (0.06, 0.12, 0.30)
"""Largest depth difference of a correspondence, finest level first."""
ITERATIONS = (12, 12, 20)
CONVERGED_M = 1e-5
MAX_POINTS = 20_000
LEAST_POINTS = 50
DAMPING = 1e-6


@dataclass(frozen=True, slots=True)
class FramePair:
    """One image of the source and one of the target, as indices."""

    source: int
    target: int


@dataclass(frozen=True, slots=True)
class Refined:
    """A refined transform and the Gauss-Newton matrix there, per pixel and uncorrected."""

    target_from_source: Array  # (4, 4)
    hessian: Array  # (6, 6), order (translation, rotation)


class Sampling:
    """Points of one level of one image, in its anchor's frame."""

    def __init__(self, frame: PreparedFrame, level: Level, config: RegistrationConfig) -> None:
        self.level = level
        self.camera_from_anchor = se3.inverse(frame.anchor_from_camera)
        camera = level.camera
        self.intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
        self.depth_variance = depth_sigma(level.depth, config) ** 2
        pixels = level.pixels
        pixels = pixels[:: max(1, -(-len(pixels) // MAX_POINTS))]
        points = camera.back_project(level.depth).reshape(-1, 3)[pixels]
        self.points = se3.transform_points(frame.anchor_from_camera, points)
        self.texture = level.texture.reshape(-1)[pixels]
        self.colour = level.colour.reshape(-1, 3)[pixels]
        self.variance = self.depth_variance.reshape(-1)[pixels]


class Pyramids:
    """Samplings of a view, made when first needed."""

    def __init__(self, view: PreparedView, config: RegistrationConfig) -> None:
        self.view = view
        self._config = config
        self._made: dict[tuple[int, int], Sampling] = {}

    def at(self, frame: int, level: int) -> Sampling:
        """The sampling of one image at one level, 0 the finest."""
        if (frame, level) not in self._made:
            prepared = self.view.frames[frame]
            self._made[frame, level] = Sampling(prepared, prepared.levels[level], self._config)
        return self._made[frame, level]


def refine(
    source: Pyramids,
    target: Pyramids,
    target_from_source: Array,
    *,
    pairs: Sequence[FramePair],
    levels: Sequence[int],
    config: RegistrationConfig,
) -> Refined:
    """Refine over the given levels, coarse to fine (for example `(2, 1)`, then `(0,)`)."""
    hessian = np.zeros((6, 6))
    for level in levels:
        step_kind = min(level, len(GATES_M) - 1)
        for _ in range(ITERATIONS[step_kind]):
            hessian, slope, used = _linearised(
                source, target, target_from_source, pairs, level, GATES_M[step_kind], config
            )
            if used < LEAST_POINTS:
                break
            damped = hessian + DAMPING * np.trace(hessian) / 6.0 * np.eye(6)
            step = -np.linalg.solve(damped, slope)
            target_from_source = target_from_source @ se3.exp(step)
            if np.abs(step).max() < CONVERGED_M:
                break
    return Refined(se3.orthonormalised(target_from_source), hessian)


def _linearised(
    source: Pyramids,
    target: Pyramids,
    target_from_source: Array,
    pairs: Sequence[FramePair],
    level: int,
    gate_m: float,
    config: RegistrationConfig,
) -> tuple[Array, Array, int]:
    hessian, slope, used = np.zeros((6, 6)), np.zeros(6), 0
    source_from_target = se3.inverse(target_from_source)
    texture_variance = config.texture_sigma**2
    for pair in pairs:
        a, b = source.at(pair.source, level), target.at(pair.target, level)
        b_from_source = b.camera_from_anchor @ target_from_source
        used += _linearise(
            a.points, a, b, b_from_source, 1.0, gate_m, texture_variance, hessian, slope
        )
        points_source = se3.transform_points(source_from_target, b.points)
        used += _linearise(
            points_source, b, a, a.camera_from_anchor, -1.0, gate_m, texture_variance,
            hessian, slope,
        )  # fmt: skip
    return np.triu(hessian) + np.triu(hessian, 1).T, slope, used


def _linearise(
    points: Array,
    moving: Sampling,
    fixed: Sampling,
    fixed_from_source: Array,
    sign: float,
    gate_m: float,
    texture_variance: float,
    hessian: Array,
    slope: Array,
) -> int:
    return projective.linearise(
        points, moving.texture, moving.variance, fixed_from_source, sign, fixed.intrinsics,
        fixed.level.depth, fixed.depth_variance, fixed.level.normals, fixed.level.texture,
        fixed.level.gradient, gate_m, texture_variance, hessian, slope,
    )  # fmt: skip
