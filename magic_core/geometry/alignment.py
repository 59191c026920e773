"""The rigid transform between corresponding points (Umeyama, PAMI 1991, without scale)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magic_core.errors import InvalidInput
from magic_core.geometry import se3


def align_points(
    source: ArrayLike, target: ArrayLike, *, weights: ArrayLike | None = None
) -> NDArray[np.float64]:
    """(4, 4) target_from_source that minimises sum_i w_i |T source_i - target_i|^2.

    Args:
        source: (n, 3) points, metres.
        target: (n, 3) the same points in the target frame.
        weights: (n,) >= 0, default all one.

    Where the points do not determine the rotation (fewer than three, or on one line) a
    minimiser is still returned: the error is the least possible, the free angle arbitrary.

    Raises InvalidInput for no points, differing shapes or non-finite numbers.
    """
    source_points = np.asarray(source, dtype=np.float64)
    target_points = np.asarray(target, dtype=np.float64)
    _check(source_points, target_points)
    w = np.ones(len(source_points)) if weights is None else np.asarray(weights, dtype=np.float64)
    w = w / w.sum()
    source_mean, target_mean = w @ source_points, w @ target_points
    covariance = (target_points - target_mean).T @ ((source_points - source_mean) * w[:, None])
    u, _, vt = np.linalg.svd(covariance)
    handedness = np.sign(np.linalg.det(u) * np.linalg.det(vt))  # reflections are no rotations
    rotation = u @ np.diag([1.0, 1.0, handedness]) @ vt
    return se3.from_rotation_translation(rotation, target_mean - rotation @ source_mean)


def _check(source: NDArray[np.float64], target: NDArray[np.float64]) -> None:
    if source.shape != target.shape or source.ndim != 2 or source.shape[1] != 3:
        raise InvalidInput.field(
            "source", f"shape {source.shape} against target {target.shape}, expected both (n, 3)"
        )
    if not len(source):
        raise InvalidInput.field("source", "no points; alignment needs at least one")
    if not (np.isfinite(source).all() and np.isfinite(target).all()):
        raise InvalidInput.field("source", "NaN or infinity among the points")
