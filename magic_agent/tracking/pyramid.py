"""Image pyramids for coarse-to-fine alignment: RGB-D images and reference views.

Each level halves the size. Depth is averaged only over readings of the nearest surface, so that
no level invents points between a foreground and its background.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from magic_core.geometry import Camera

Float32 = NDArray[np.float32]

_KERNEL = {"fastmath": True, "nogil": True, "cache": True, "error_model": "numpy"}
_SAME_SURFACE = np.float32(1.05)  # depths within 5 % of the nearest belong to one surface
_MIN_ALPHA = np.float32(0.3)  # below, expected depth and colour are noise over a small number
_MIN_SIDE = 16  # pixels; no level is smaller


@dataclass(frozen=True, slots=True)
class Pyramid:
    """Levels from the full image to the coarsest, with the camera of each."""

    levels: tuple[Float32, ...]
    """Images (h, w, 4) R G B depth, or reference views (5, h, w) R G B depth mask."""
    cameras: tuple[Camera, ...]

    def __len__(self) -> int:
        return len(self.levels)


def pyramid_cameras(camera: Camera, levels: int) -> tuple[Camera, ...]:
    """The camera of each level; a level's pixel covers exactly 2 x 2 of the one before."""
    cameras = [camera]
    while len(cameras) < levels and min(cameras[-1].width, cameras[-1].height) >= 2 * _MIN_SIDE:
        last = cameras[-1]
        cameras.append(
            Camera(
                width=last.width // 2,
                height=last.height // 2,
                fx=last.fx / 2.0,
                fy=last.fy / 2.0,
                cx=(last.cx + 0.5) / 2.0 - 0.5,
                cy=(last.cy + 0.5) / 2.0 - 0.5,
            )
        )
    return tuple(cameras)


def image_pyramid(
    colour: NDArray[np.uint8], depth: Float32, *, camera: Camera, levels: int
) -> Pyramid:
    """The pyramid of an RGB-D image: (h, w, 4) R G B in [0, 1] and depth in metres."""
    cameras = pyramid_cameras(camera, levels)
    images = [_packed_image(np.ascontiguousarray(colour), np.ascontiguousarray(depth))]
    for _ in cameras[1:]:
        images.append(_halved_image(images[-1]))
    return Pyramid(tuple(images), cameras)


def view_pyramid(view: Float32, *, camera: Camera, levels: int, alpha_power: int) -> Pyramid:
    """The pyramid of a rendered view: (5, h, w) R G B, *accumulated* depth and alpha.

    Depth becomes expected depth (divided by alpha); colour stays as rendered, for that is what
    mapping fits to the images. Alpha becomes the soft mask alpha^power (paper, "Pose Refinement").
    """
    return reference_pyramid(_expected_view(view, alpha_power), camera=camera, levels=levels)


def keyframe_pyramid(image: Pyramid, *, finest: int = 0) -> Pyramid:
    """The pyramid of an RGB-D image as a reference view: its mask is 1 wherever it has depth.

    Levels below `finest` are not needed and stay empty.
    """
    levels = [
        _as_reference(level) if number >= finest else np.zeros((5, 0, 0), np.float32)
        for number, level in enumerate(image.levels)
    ]
    return Pyramid(tuple(levels), image.cameras)


def reference_pyramid(reference: Float32, *, camera: Camera, levels: int) -> Pyramid:
    """The pyramid of a reference view: (5, h, w) R G B, depth in metres (0 = none), mask."""
    cameras = pyramid_cameras(camera, levels)
    views = [reference]
    for _ in cameras[1:]:
        views.append(_halved_reference(views[-1]))
    return Pyramid(tuple(views), cameras)


@njit(**_KERNEL)
def _packed_image(colour, depth):
    height, width = depth.shape
    image = np.empty((height, width, 4), np.float32)
    scale = np.float32(1.0 / 255.0)
    for y in range(height):
        for x in range(width):
            for c in range(3):
                image[y, x, c] = np.float32(colour[y, x, c]) * scale
            image[y, x, 3] = depth[y, x]
    return image


@njit(**_KERNEL)
def _nearest_surface(a, b, c, d):
    """Mean of the positive depths within 5 % of the least, 0 if there is none."""
    far = np.float32(1e9)
    nearest = min(
        min(a if a > 0 else far, b if b > 0 else far),
        min(c if c > 0 else far, d if d > 0 else far),
    )
    limit = nearest * _SAME_SURFACE
    total = count = np.float32(0.0)
    for value in (a, b, c, d):
        if (value > 0) & (value <= limit):
            total += value
            count += np.float32(1.0)
    return total / max(count, np.float32(1.0))


@njit(**_KERNEL)
def _halved_image(image):
    height, width = image.shape[0] // 2, image.shape[1] // 2
    half = np.empty((height, width, 4), np.float32)
    quarter = np.float32(0.25)
    for y in range(height):
        for x in range(width):
            for c in range(3):
                half[y, x, c] = quarter * (
                    image[2 * y, 2 * x, c]
                    + image[2 * y, 2 * x + 1, c]
                    + image[2 * y + 1, 2 * x, c]
                    + image[2 * y + 1, 2 * x + 1, c]
                )
            half[y, x, 3] = _nearest_surface(
                image[2 * y, 2 * x, 3],
                image[2 * y, 2 * x + 1, 3],
                image[2 * y + 1, 2 * x, 3],
                image[2 * y + 1, 2 * x + 1, 3],
            )
    return half


@njit(**_KERNEL)
def _halved_reference(reference):
    height, width = reference.shape[1] // 2, reference.shape[2] // 2
    half = np.empty((5, height, width), np.float32)
    quarter = np.float32(0.25)
    for plane in (0, 1, 2, 4):
        for y in range(height):
            upper, lower = reference[plane, 2 * y], reference[plane, 2 * y + 1]
            for x in range(width):
                total = upper[2 * x] + upper[2 * x + 1] + lower[2 * x] + lower[2 * x + 1]
                half[plane, y, x] = quarter * total
    for y in range(height):
        upper, lower = reference[3, 2 * y], reference[3, 2 * y + 1]
        for x in range(width):
            half[3, y, x] = _nearest_surface(
                upper[2 * x], upper[2 * x + 1], lower[2 * x], lower[2 * x + 1]
            )
    return half


@njit(**_KERNEL)
def _expected_view(view, alpha_power):
    reference = np.empty(view.shape, np.float32)
    one = np.float32(1.0)
    for y in range(view.shape[1]):
        for x in range(view.shape[2]):
            alpha = view[4, y, x]
            enough = alpha > _MIN_ALPHA
            scale = one / alpha if enough else np.float32(0.0)
            for plane in range(3):
                reference[plane, y, x] = view[plane, y, x]
            reference[3, y, x] = view[3, y, x] * scale
            mask = one
            for _ in range(alpha_power):
                mask *= alpha
            reference[4, y, x] = min(mask, one) if enough else np.float32(0.0)
    return reference


@njit(**_KERNEL)
def _as_reference(image):
    height, width = image.shape[:2]
    reference = np.empty((5, height, width), np.float32)
    for y in range(height):
        for x in range(width):
            for c in range(4):
                reference[c, y, x] = image[y, x, c]
            has_depth = image[y, x, 3] > np.float32(0.0)
            reference[4, y, x] = np.float32(1.0) if has_depth else np.float32(0.0)
    return reference
