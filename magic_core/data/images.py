"""Reading, undistorting and resizing colour and depth images."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core.data.intrinsics import Intrinsics
from magic_core.errors import DataError
from magic_core.geometry import Camera

Colour = NDArray[np.uint8]
Depth = NDArray[np.float32]

# Readings of one resized pixel that differ by more than this share of their depth lie on two
# surfaces and are never averaged.
_SAME_SURFACE = 0.02


def read_colour(path: Path) -> Colour:
    """(h, w, 3) RGB of a JPEG or PNG file."""
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise _unreadable(path, "an 8-bit colour JPEG or PNG")
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False)


def read_depth(path: Path, depth_scale: float) -> Depth:
    """(h, w) metres of a 16-bit depth PNG with `depth_scale` units per metre; 0 = no reading."""
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None or image.ndim != 2 or image.dtype != np.uint16:
        found = "" if image is None else f", found {image.dtype} {image.shape}"
        raise _unreadable(path, f"a single-channel 16-bit PNG{found}")
    return image.astype(np.float32) / np.float32(depth_scale)


def resize_depth(depth: Depth, width: int, height: int) -> Depth:
    """Depth at another size, never mixing two surfaces and never inventing a reading.

    Each target pixel looks at the source pixels under it, takes their (lower) median reading as
    the surface, and averages the readings of that surface alone: averaging keeps slanted planes
    unbiased at half-pixel offsets, which picking a single pixel does not.
    """
    source_height, source_width = depth.shape
    samples_u = max(1, -(-source_width // width))
    samples_v = max(1, -(-source_height // height))
    columns = _sample_positions(source_width, width, samples_u)
    rows = _sample_positions(source_height, height, samples_v)
    stack = np.stack([depth[np.ix_(row, column)] for row in rows for column in columns])
    if len(stack) == 1:
        return np.ascontiguousarray(stack[0])
    low, high = stack.min(axis=0), stack.max(axis=0)
    result = stack.mean(axis=0, dtype=np.float32)
    mixed = (low <= 0) | (high - low > _SAME_SURFACE * low)
    result[mixed] = _majority_surface(stack[:, mixed])
    return result


def _majority_surface(stack: Depth) -> Depth:
    """Per column of (k, n) readings, the mean of those on the lower-median reading's surface."""
    reference = _lower_median_of_valid(stack)
    same = (stack > 0) & (np.abs(stack - reference) <= _SAME_SURFACE * reference)
    total = np.where(same, stack, 0).sum(axis=0, dtype=np.float32)
    return total / np.maximum(same.sum(axis=0, dtype=np.float32), 1)


def _sample_positions(source: int, target: int, samples: int) -> list[NDArray[np.intp]]:
    """For each of `samples` sub-positions, the source index under every target pixel."""
    offsets = (np.arange(samples) + 0.5) / samples
    return [
        np.minimum(((np.arange(target) + offset) * source / target).astype(np.intp), source - 1)
        for offset in offsets
    ]


def _lower_median_of_valid(stack: Depth) -> Depth:
    ordered = np.sort(stack, axis=0)
    invalid = (ordered <= 0).sum(axis=0)
    index = invalid + np.maximum(len(stack) - invalid - 1, 0) // 2
    index = np.minimum(index, len(stack) - 1)
    return np.take_along_axis(ordered, index[None], axis=0)[0]


@dataclass(frozen=True, slots=True)
class ImagePreparation:
    """Turns stored images into the frames of an undistorted pinhole camera at the wanted size."""

    camera: Camera
    """The camera of the prepared images."""
    undistortion: tuple[NDArray, NDArray] | None
    """cv2.remap tables of the stored size, or None where the lens is ideal."""

    @classmethod
    def plan(cls, intrinsics: Intrinsics, scale: float) -> ImagePreparation:
        """Choose the undistorted camera (no empty borders) and compute the tables once."""
        if not 0.0 < scale <= 1.0:
            raise DataError(f"scale {scale}: expected a fraction in (0, 1] of the stored size")
        camera, tables = intrinsics.camera, None
        if any(intrinsics.distortion):
            camera, tables = _undistortion(intrinsics)
        return cls(camera.scaled(scale), tables)

    def colour(self, stored: Colour) -> Colour:
        """Undistort (bilinear) and resize (area) a colour image."""
        if self.undistortion is not None:
            stored = np.asarray(cv2.remap(stored, *self.undistortion, cv2.INTER_LINEAR), np.uint8)
        size = (self.camera.width, self.camera.height)
        if size == stored.shape[1::-1]:
            return stored
        return np.asarray(cv2.resize(stored, size, interpolation=cv2.INTER_AREA), np.uint8)

    def depth(self, stored: Depth) -> Depth:
        """Undistort (nearest) and resize a depth image in metres."""
        if self.undistortion is not None:
            stored = np.asarray(
                cv2.remap(stored, *self.undistortion, cv2.INTER_NEAREST), np.float32
            )
        if (self.camera.width, self.camera.height) == stored.shape[::-1]:
            return stored
        return resize_depth(stored, self.camera.width, self.camera.height)


def _undistortion(intrinsics: Intrinsics) -> tuple[Camera, tuple[NDArray, NDArray]]:
    stored = intrinsics.camera
    size = (stored.width, stored.height)
    coefficients = np.array(intrinsics.distortion)
    matrix, _ = cv2.getOptimalNewCameraMatrix(stored.matrix, coefficients, size, 0)
    tables = cv2.initUndistortRectifyMap(
        stored.matrix, coefficients, np.eye(3), matrix, size, cv2.CV_32FC1
    )
    camera = Camera(
        width=stored.width,
        height=stored.height,
        fx=float(matrix[0, 0]),
        fy=float(matrix[1, 1]),
        cx=float(matrix[0, 2]),
        cy=float(matrix[1, 2]),
    )
    return camera, (tables[0], tables[1])


def _unreadable(path: Path, expectation: str) -> DataError:
    state = "cannot be decoded" if path.is_file() else "is missing"
    return DataError(f"{path}: {state}; expected {expectation}. Check that the copy is complete.")
