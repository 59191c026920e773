"""Registration of two depth images by shape alone, from any relative pose.

KISS-Matcher (Lim et al. 2025) matches point features and keeps the largest consistent set of
matches. In boxy rooms shape alone is ambiguous: its answer is a hypothesis, and whoever asks must
check it against the images.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magic_core.geometry import Camera

_VOXEL_M = 0.08
_MAX_DEPTH_M = 6.0  # farther points are too noisy for features
_MOST_POINTS = 20_000
_LEAST_POINTS = 200


@dataclass(frozen=True, slots=True)
class ShapeMatch:
    """A transform between two clouds and the number of matches that support it."""

    target_from_source: NDArray[np.float64]  # (4, 4)
    inliers: int


def points_of(depth: NDArray[np.float32], camera: Camera) -> NDArray[np.float64]:
    """(n, 3) points of a depth image (h, w), evenly thinned, camera frame."""
    points = camera.back_project(depth)[(depth > 0.0) & (depth < _MAX_DEPTH_M)]
    return points[:: max(1, len(points) // _MOST_POINTS)].astype(np.float64)


def match_shapes(source: NDArray[np.float64], target: NDArray[np.float64]) -> ShapeMatch | None:
    """The transform that most matches of two clouds (n, 3), (m, 3) agree on; None for too few."""
    if min(len(source), len(target)) < _LEAST_POINTS:
        return None
    import kiss_matcher as extension  # loaded when a frame is lost, not before

    kiss: Any = extension  # the package re-exports its extension module at run time
    matcher = kiss.KISSMatcher(kiss.KISSMatcherConfig(voxel_size=_VOXEL_M))
    solution = matcher.estimate(source, target)
    transform = np.eye(4)
    transform[:3, :3] = np.asarray(solution.rotation)
    transform[:3, 3] = np.asarray(solution.translation).reshape(3)
    if not np.isfinite(transform).all():
        return None
    return ShapeMatch(transform, int(matcher.get_num_final_inliers()))
