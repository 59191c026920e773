"""What a depth image says about the surface: normals, and which pixels to trust."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core.geometry import Camera

_STEPS = ((0, 1), (1, 0), (1, 1), (1, -1))  # (rows, columns): along the image's four directions


@dataclass(frozen=True, slots=True)
class Surface:
    """Per-pixel geometry of one depth image."""

    normals: NDArray[np.float32]  # (h, w, 3) unit, camera frame, facing the camera; 0 = unknown
    reliable: NDArray[np.bool_]  # (h, w) a reading that is no flying pixel


def surface_of(depth: NDArray[np.float32], camera: Camera, *, jump: float = 0.03) -> Surface:
    """Normals and reliable pixels of an (h, w) depth image in metres.

    `jump` is the relative step of inverse depth from a pixel to its neighbour that may mark a
    discontinuity.
    """
    inverse = np.where(depth > 0, 1.0 / np.maximum(depth, 1e-6), 0.0).astype(np.float32)
    return Surface(_normals(depth, inverse, camera), _reliable(inverse, jump))


def _reliable(inverse: NDArray[np.float32], jump: float) -> NDArray[np.bool_]:
    """Readings that do not float between a nearer and a farther surface.

    A flying pixel is a mixture over an edge: one neighbour is clearly nearer, the opposite one
    clearly farther, and beyond these neighbours the depth is flat again. On a slanted surface,
    where inverse depth is affine, the slope goes on instead.
    """
    padded = np.pad(inverse, 2, mode="reflect", reflect_type="odd")
    flying = np.zeros(inverse.shape, dtype=bool)
    for step in _STEPS:
        before2, before, after, after2 = (_shifted(padded, step, n) for n in (-2, -1, 1, 2))
        step_in, step_out = before - inverse, inverse - after
        least = np.where(step_in * step_out > 0, np.minimum(abs(step_in), abs(step_out)), 0.0)
        outside = np.maximum(abs(before2 - before), abs(after - after2))
        across = 0.5 * abs(before - after)
        known = (before > 0) & (after > 0)
        flying |= known & (least > jump * inverse) & (across > 2.0 * outside)
    return (inverse > 0) & ~flying


def _shifted(padded: NDArray[np.float32], step: tuple[int, int], count: int) -> NDArray[np.float32]:
    """The image, padded by 2, as seen `count` steps further."""
    height, width = padded.shape[0] - 4, padded.shape[1] - 4
    row, column = 2 + count * step[0], 2 + count * step[1]
    return padded[row : row + height, column : column + width]


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
    # Smoothing over an edge would tilt both sides: keep the raw value where they disagree. In gaps
    # the smooth value stays, so that the rim of a hole is not taken for a cliff.
    uneven = (inverse > 0) & (np.abs(smooth - inverse) > 0.03 * inverse)
    smooth = np.where(uneven, inverse, smooth)
    nx = _rim_from_inside(_gradient(smooth, 1, 0)) * camera.fx
    ny = _rim_from_inside(_gradient(smooth, 0, 1)) * camera.fy
    rays = camera.rays()
    nz = inverse - nx * rays[..., 0] - ny * rays[..., 1]
    normals = -np.stack([nx, ny, nz], axis=-1)
    length = np.linalg.norm(normals, axis=-1)
    usable = (depth > 0) & (length > 1e-9)
    return np.where(usable[..., None], normals / np.maximum(length, 1e-9)[..., None], 0.0).astype(
        np.float32
    )


def _gradient(image: NDArray[np.float32], along_x: int, along_y: int) -> NDArray[np.float32]:
    """Smoothed central difference per pixel (Sobel)."""
    filtered = cv2.Sobel(image, cv2.CV_32F, along_x, along_y, ksize=3, scale=0.125)
    return np.asarray(filtered, np.float32)


def _rim_from_inside(image: NDArray[np.float32], rim: int = 3) -> NDArray[np.float32]:
    """Replace the outermost pixels, whose filters left the image, by their inner neighbours."""
    height, width = image.shape
    if min(height, width) <= 2 * rim:
        return image
    return np.pad(image[rim:-rim, rim:-rim], rim, mode="edge")
