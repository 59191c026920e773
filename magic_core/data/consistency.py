"""Do the poses, the depth and the intrinsics of a recording fit each other?

Depth of one frame is carried into another by their poses and compared with the depth measured
there. Only the right reading of the pose file and the right depth unit bring the two together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magic_core.data.frame import Frame
from magic_core.geometry import Camera, se3

Array = NDArray[np.float64]

_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_MIN_BASELINE_M, _MAX_BASELINE_M = 0.04, 0.6
_MAX_TURN_RAD = np.deg2rad(30.0)
_SAMPLE_STRIDE = 6  # pixels
_MIN_SHARED = 60  # points

_QUARTER = se3.from_rotation_translation(se3.rotation_exp([0.0, 0.0, np.pi / 2]), np.zeros(3))

CONVENTIONS = {
    "world_from_camera, OpenCV axes": lambda pose: pose,
    "camera_from_world, OpenCV axes": se3.inverse,
    "world_from_camera, OpenGL axes": lambda pose: pose @ _OPENGL,
    "camera_from_world, OpenGL axes": lambda pose: se3.inverse(pose) @ _OPENGL,
    "world_from_camera of images turned a quarter left": lambda pose: pose @ _QUARTER,
    "world_from_camera of images turned a quarter right": lambda pose: pose @ _QUARTER.T,
    "world_from_camera of images turned upside down": lambda pose: pose @ _QUARTER @ _QUARTER,
}
"""Ways in which pose files are written, and how to turn each into ours (the first)."""

DOCUMENTED = next(iter(CONVENTIONS))
DEPTH_FACTORS = (1.0, 0.1, 0.2, 0.5, 2.0, 5.0, 10.0, 0.001, 1000.0, 0.1526, 6.5535, 1.3107, 0.763)
"""Mistakes in the depth unit: mm for 1/5000 m, for 1/6553.5 m, for metres, and so on."""


@dataclass(frozen=True, slots=True)
class Fit:
    """How well one reading of poses and depth explains the images."""

    convention: str
    depth_factor: float
    """What the metric depth must be multiplied with."""
    error: float
    """Median relative difference of carried and measured depth; infinity where nothing overlaps."""


def fits(frames: Sequence[Frame], camera: Camera) -> list[Fit]:
    """All readings of poses and depth unit, best first; empty where no pair of frames helps.

    A pair helps if the camera moved, but not so much that the views part.
    """
    pairs = [pair for pair in _pairs(frames) if _moves_enough(*pair)]
    if not pairs:
        return []
    found = [
        Fit(name, factor, _error(pairs, camera, name, factor))
        for name in CONVENTIONS
        for factor in (DEPTH_FACTORS if name == DOCUMENTED else (1.0,))
    ]
    return sorted(found, key=lambda fit: fit.error)


def _pairs(frames: Sequence[Frame]) -> list[tuple[Frame, Frame]]:
    posed = [frame for frame in frames if frame.world_from_camera is not None]
    return [(a, b) for i, a in enumerate(posed) for b in posed[i + 1 : i + 4]]


def _moves_enough(first: Frame, second: Frame) -> bool:
    assert first.world_from_camera is not None
    assert second.world_from_camera is not None
    # Holds for poses and inverse poses alike: the rotation's angle, and roughly the translation's.
    relative = se3.inverse(first.world_from_camera) @ second.world_from_camera
    baseline = float(np.linalg.norm(relative[:3, 3]))
    near = baseline <= _MAX_BASELINE_M and se3.rotation_angle(relative) <= _MAX_TURN_RAD
    return near and (baseline >= _MIN_BASELINE_M or se3.rotation_angle(relative) > 0.03)


def _error(
    pairs: Sequence[tuple[Frame, Frame]], camera: Camera, convention: str, factor: float
) -> float:
    errors = [_pair_error(first, second, camera, convention, factor) for first, second in pairs]
    finite = [error for error in errors if np.isfinite(error)]
    return float(np.median(finite)) if len(finite) * 2 >= len(errors) else float("inf")


def _pair_error(
    first: Frame, second: Frame, camera: Camera, convention: str, factor: float
) -> float:
    convert = CONVENTIONS[convention]
    second_from_first = se3.inverse(convert(second.world_from_camera)) @ convert(
        first.world_from_camera
    )
    sampled = np.s_[::_SAMPLE_STRIDE, ::_SAMPLE_STRIDE]
    points = camera.back_project(first.depth)[sampled].reshape(-1, 3)
    points = points[points[:, 2] > 0] * factor
    pixels, z = camera.project(se3.transform_points(second_from_first, points))
    column, row = np.rint(pixels).astype(np.int64).T
    inside = (z > 0) & (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
    measured = second.depth[row[inside], column[inside]] * factor
    carried, measured = z[inside][measured > 0], measured[measured > 0]
    if len(measured) < _MIN_SHARED:
        return float("inf")
    return float(np.median(np.abs(carried - measured) / measured))
