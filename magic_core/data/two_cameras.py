"""Colour and depth of two cameras, brought into one.

Phones, ScanNet and raw RealSense recordings store depth in another size, and often from another
place, than colour. Everything after this file sees one pinhole camera. Each image is resampled
once: colour by area, depth never across two surfaces.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core.data.images import Colour, Depth, ImagePreparation, resize_depth
from magic_core.data.intrinsics import Intrinsics
from magic_core.errors import DataError
from magic_core.geometry import Camera, se3

Maps = tuple[NDArray[np.float32], NDArray[np.float32]]

# Neighbouring readings of a coarse depth image that differ by more than this share lie on two
# surfaces. A floor seen at a grazing angle differs by some percent between LiDAR pixels.
_SAME_SURFACE = 0.05


@dataclass(frozen=True, slots=True)
class DepthCamera:
    """The camera that measured depth, where it is not the colour camera."""

    camera: Camera
    """The camera of the depth files as stored."""
    distortion: tuple[float, ...] = ()
    """OpenCV's coefficients; empty = an ideal lens."""
    colour_from_depth: NDArray[np.float64] | None = None
    """(4, 4) into the colour camera's frame; None = both look from the same place."""


class PairPreparation:
    """Turns stored colour and depth into the images of one undistorted pinhole camera."""

    def __init__(
        self,
        colour: Intrinsics,
        depth: DepthCamera,
        *,
        scale: float,
        deliver: Literal["colour", "depth"] = "colour",
    ) -> None:
        if not 0.0 < scale <= 1.0:
            raise DataError(f"scale {scale}: expected a fraction in (0, 1] of the stored size")
        self._colour, self._depth = colour, depth
        if deliver == "depth":
            self.camera = depth.camera.scaled(scale)
        else:
            self.camera = ImagePreparation.plan(colour, scale).camera
        """The camera of the prepared images."""
        self._colour_maps = _maps(self.camera, colour.camera, colour.distortion)
        self._depth_maps = _maps(self.camera, depth.camera, depth.distortion)

    def colour(self, stored: Colour, camera: Camera | None = None) -> Colour:
        """Colour as the delivered camera sees it; `camera` where this frame had its own."""
        if camera is None or camera == self._colour.camera:
            return _resampled(stored, self.camera, self._colour.camera, self._colour_maps)
        maps = _maps(self.camera, camera, self._colour.distortion)
        return _resampled(stored, self.camera, camera, maps)

    def depth(self, stored: Depth, camera: Camera | None = None) -> Depth:
        """Depth in metres as the delivered camera sees it; 0 where nothing was measured."""
        nominal = camera is None or camera == self._depth.camera
        source = self._depth.camera if camera is None else camera
        if self._depth.colour_from_depth is not None:
            return self._moved(stored, source)
        maps = self._depth_maps if nominal else _maps(self.camera, source, self._depth.distortion)
        return resize_depth(sample_depth(stored, maps), self.camera.width, self.camera.height)

    def _moved(self, stored: Depth, source: Camera) -> Depth:
        assert self._depth.colour_from_depth is not None
        if any(self._depth.distortion):
            stored = sample_depth(stored, _lens_maps(source, source, self._depth.distortion))
        return register_depth(stored, source, self.camera, self._depth.colour_from_depth)


def register_depth(
    depth: Depth, source: Camera, target: Camera, target_from_source: NDArray[np.float64]
) -> Depth:
    """(h, w) depth of `source` as `target` sees it from its own place; the nearest surface wins.

    Every reading covers its whole pixel, so that enlarging leaves no gaps between readings.
    """
    points = source.back_project(depth)[depth > 0].astype(np.float64)
    pixels, z = target.project(se3.transform_points(target_from_source, points))
    ahead = z > 1e-3
    pixels, z, size = pixels[ahead], z[ahead], points[ahead, 2] / z[ahead]
    radius_u = np.maximum(0.5 * target.fx / source.fx * size, 0.5)
    radius_v = np.maximum(0.5 * target.fy / source.fy * size, 0.5)
    first_u, last_u = np.ceil(pixels[:, 0] - radius_u), np.floor(pixels[:, 0] + radius_u)
    first_v, last_v = np.ceil(pixels[:, 1] - radius_v), np.floor(pixels[:, 1] + radius_v)
    result = np.full(target.width * target.height, np.inf, np.float32)
    for dv in range(_largest(last_v - first_v) + 1):
        for du in range(_largest(last_u - first_u) + 1):
            u, v = first_u + du, first_v + dv
            inside = (u <= last_u) & (v <= last_v) & (u >= 0) & (v >= 0)
            inside &= (u < target.width) & (v < target.height)
            index = (v[inside] * target.width + u[inside]).astype(np.intp)
            np.minimum.at(result, index, z[inside].astype(np.float32))
    result[~np.isfinite(result)] = 0
    return result.reshape(target.height, target.width)


def sample_depth(depth: Depth, maps: Maps) -> Depth:
    """Depth at real-valued pixels: interpolated within a surface, the nearest reading elsewhere."""
    u, v = maps
    height, width = depth.shape
    left, top = np.floor(u).astype(np.intp), np.floor(v).astype(np.intp)
    columns = [np.clip(left + step, 0, width - 1) for step in (0, 1)]
    rows = [np.clip(top + step, 0, height - 1) for step in (0, 1)]
    corners = np.stack([depth[row, column] for row in rows for column in columns])
    low, high = corners.min(axis=0), corners.max(axis=0)
    one_surface = (low > 0) & (high - low <= _SAME_SURFACE * low)
    share_u, share_v = (u - left).astype(np.float32), (v - top).astype(np.float32)
    upper = corners[0] * (1 - share_u) + corners[1] * share_u
    lower = corners[2] * (1 - share_u) + corners[3] * share_u
    result = upper * (1 - share_v) + lower * share_v
    near_u, near_v = np.rint(u).astype(np.intp), np.rint(v).astype(np.intp)
    nearest = depth[np.clip(near_v, 0, height - 1), np.clip(near_u, 0, width - 1)]
    result = np.where(one_surface, result, nearest)
    inside = (near_u >= 0) & (near_v >= 0) & (near_u < width) & (near_v < height)
    return np.where(inside, result, 0).astype(np.float32)


def _resampled(stored: Colour, target: Camera, source: Camera, maps: Maps) -> Colour:
    """Colour at `target`: sampled finely enough to miss no pixel, then averaged by area."""
    if maps[0].shape == stored.shape[:2] and target == source:
        return stored
    fine = cv2.remap(stored, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    size = (target.width, target.height)
    if fine.shape[1::-1] == size:
        return np.asarray(fine, np.uint8)
    return np.asarray(cv2.resize(fine, size, interpolation=cv2.INTER_AREA), np.uint8)


def _maps(target: Camera, source: Camera, distortion: tuple[float, ...]) -> Maps:
    """Where in `source` every (sub-)pixel of `target` lies; several sub-pixels when shrinking."""
    times = max(1, round(source.fx / target.fx))
    fine = Camera(
        width=target.width * times,
        height=target.height * times,
        fx=target.fx * times,
        fy=target.fy * times,
        cx=(target.cx + 0.5) * times - 0.5,
        cy=(target.cy + 0.5) * times - 0.5,
    )
    return _lens_maps(fine, source, distortion)


def _lens_maps(target: Camera, source: Camera, distortion: tuple[float, ...]) -> Maps:
    coefficients = np.array(distortion) if any(distortion) else np.zeros(5)
    size = (target.width, target.height)
    u, v = cv2.initUndistortRectifyMap(
        source.matrix, coefficients, np.eye(3), target.matrix, size, cv2.CV_32FC1
    )
    return np.asarray(u, np.float32), np.asarray(v, np.float32)


def _largest(values: NDArray[np.float64]) -> int:
    # A reading a few centimetres before the lens would cover the whole image; 16 pixels are enough.
    return int(np.clip(values.max(initial=0), 0, 16))
