"""What a depth image says about the surface: normals, and which pixels to trust."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core.geometry import Camera

_OPPOSITE_STEPS = (((0, -1), (0, 1)), ((-1, 0), (1, 0)), ((-1, -1), (1, 1)), ((-1, 1), (1, -1)))


@dataclass(frozen=True, slots=True)
class Surface:
    """Per-pixel geometry of one depth image."""

    normals: NDArray[np.float32]  # (h, w, 3) unit, camera frame, facing the camera; 0 = unknown
    reliable: NDArray[np.bool_]  # (h, w) a reading that is no flying pixel


def surface_of(depth: NDArray[np.float32], camera: Camera, *, jump: float = 0.03) -> Surface:
    """Normals and reliable pixels of an (h, w) depth image in metres.

    `jump` is the relative step of inverse depth from a pixel to its neighbour that marks a
    discontinuity. Inverse depth is affine over a plane, so a slanted wall stays below it.
    """
    inverse = np.where(depth > 0, 1.0 / np.maximum(depth, 1e-6), 0.0).astype(np.float32)
    return Surface(_normals(depth, inverse, camera), _reliable(inverse, jump))


def _reliable(inverse: NDArray[np.float32], jump: float) -> NDArray[np.bool_]:
    """Readings that do not float between a nearer and a farther surface.

    A flying pixel is a mixture over an edge: one neighbour is clearly nearer, the opposite one
    clearly farther.
    """
    padded = np.pad(inverse, 1, mode="edge")
    height, width = inverse.shape
    flying = np.zeros(inverse.shape, dtype=bool)
    for (y0, x0), (y1, x1) in _OPPOSITE_STEPS:
        first = padded[1 + y0 : 1 + y0 + height, 1 + x0 : 1 + x0 + width]
        second = padded[1 + y1 : 1 + y1 + height, 1 + x1 : 1 + x1 + width]
        known = (first > 0) & (second > 0)
        step_in, step_out = first - inverse, inverse - second
        flying |= known & (np.minimum(step_in, step_out) > jump * inverse)
        flying |= known & (np.maximum(step_in, step_out) < -jump * inverse)
    return (inverse > 0) & ~flying


def _normals(
    depth: NDArray[np.float32], inverse: NDArray[np.float32], camera: Camera
) -> NDArray[np.float32]:
    """Normals from the gradient of smoothed inverse depth.

    A plane n.p = c seen by the ray r has 1/z = n.r / c, affine in the pixel: its gradient and
    value give n up to scale, with no cross products of noisy points.
    """
    known = (inverse > 0).astype(np.float32)
    weight = cv2.boxFilter(known, -1, (5, 5))
    smooth = cv2.boxFilter(inverse, -1, (5, 5)) / np.maximum(weight, 1e-6)
    # Smoothing over an edge would tilt both sides: keep the raw value where they disagree.
    smooth = np.where(np.abs(smooth - inverse) > 0.03 * inverse, inverse, smooth)
    nx = _rim_from_inside(cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=3, scale=0.125)) * camera.fx
    ny = _rim_from_inside(cv2.Sobel(smooth, cv2.CV_32F, 0, 1, ksize=3, scale=0.125)) * camera.fy
    rays = camera.rays()
    nz = inverse - nx * rays[..., 0] - ny * rays[..., 1]
    normals = -np.stack([nx, ny, nz], axis=-1)
    length = np.linalg.norm(normals, axis=-1)
    usable = (depth > 0) & (length > 1e-9)
    return np.where(usable[..., None], normals / np.maximum(length, 1e-9)[..., None], 0.0).astype(
        np.float32
    )


def _rim_from_inside(image: NDArray[np.float32], rim: int = 3) -> NDArray[np.float32]:
    """Replace the outermost pixels, whose filters left the image, by their inner neighbours."""
    height, width = image.shape
    if min(height, width) <= 2 * rim:
        return image
    return np.pad(image[rim:-rim, rim:-rim], rim, mode="edge")
