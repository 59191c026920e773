"""The pinhole camera: OpenCV axes (x right, y down, z forward), pixel centres at integers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magic_core.errors import FieldViolation, InvalidInput

MAX_IMAGE_PIXELS = 64_000_000

# Bounds in image sides (the centre's in focal lengths too, for crops): fields of view from 0.06 to
# 178.9 degrees. Beyond them numbers overflow where clouds are cut into voxels.
_SHORTEST, _LONGEST, _FARTHEST_CENTRE = 0.01, 1000.0, 10.0


@dataclass(frozen=True, slots=True)
class Camera:
    """Intrinsics of a pinhole camera without distortion.

    A point (x, y, z) of the camera frame, metres, is seen at the pixel
    (fx x / z + cx, fy y / z + cy); the top-left pixel's centre is (0, 0).
    """

    width: int
    """Image width in pixels."""
    height: int
    """Image height in pixels."""
    fx: float
    fy: float
    cx: float
    cy: float

    def validate(self, field: str = "camera") -> None:
        """Raise InvalidInput naming each value that no pinhole camera can have."""
        found = []
        if self.width < 1 or self.height < 1 or self.width * self.height > MAX_IMAGE_PIXELS:
            size = f"{self.width}x{self.height}"
            rule = f"expected 1 to {MAX_IMAGE_PIXELS} pixels"
            found.append(FieldViolation(f"{field}.width", f"image size {size}: {rule}"))
        side = max(self.width, self.height, 1)
        for name in ("fx", "fy"):
            value = getattr(self, name)
            if not (np.isfinite(value) and side * _SHORTEST <= value <= side * _LONGEST):
                low, high = side * _SHORTEST, side * _LONGEST
                rule = f"a focal length in pixels is {low:g} to {high:g} for this image size"
                found.append(FieldViolation(f"{field}.{name}", f"{value}: {rule}"))
        for name, focal in (("cx", self.fx), ("cy", self.fy)):
            value, limit = getattr(self, name), max(side, focal) * _FARTHEST_CENTRE
            if not (np.isfinite(value) and abs(value) <= limit):
                rule = f"expected within {limit:g} px of the image's corner"
                found.append(FieldViolation(f"{field}.{name}", f"{value}: {rule}"))
        if found:
            raise InvalidInput(found[0].description, violations=tuple(found))

    def scaled(self, scale: float) -> Camera:
        """The same camera at another image size; sizes are rounded, rays are kept."""
        width, height = max(1, round(self.width * scale)), max(1, round(self.height * scale))
        sx, sy = width / self.width, height / self.height
        return Camera(
            width=width,
            height=height,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=(self.cx + 0.5) * sx - 0.5,
            cy=(self.cy + 0.5) * sy - 0.5,
        )

    @property
    def matrix(self) -> NDArray[np.float64]:
        """The (3, 3) calibration matrix."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def rays(self) -> NDArray[np.float32]:
        """(h, w, 3) directions with z = 1 in the camera frame, one per pixel centre."""
        u = (np.arange(self.width, dtype=np.float32) - self.cx) / self.fx
        v = (np.arange(self.height, dtype=np.float32) - self.cy) / self.fy
        grid_u, grid_v = np.meshgrid(u, v)
        return np.stack([grid_u, grid_v, np.ones_like(grid_u)], axis=-1).astype(np.float32)

    def back_project(self, depth: NDArray[np.float32]) -> NDArray[np.float32]:
        """(h, w, 3) points in the camera frame of an (h, w) depth image in metres."""
        return self.rays() * depth[..., None]

    def project(self, points_camera: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Pixels (n, 2) and depths (n,) in metres of (n, 3) points in the camera frame."""
        points = np.asarray(points_camera, dtype=np.float64)
        z = points[:, 2]
        safe_z = np.where(np.abs(z) < 1e-9, 1e-9, z)
        pixels = np.stack(
            [self.fx * points[:, 0] / safe_z + self.cx, self.fy * points[:, 1] / safe_z + self.cy],
            axis=-1,
        )
        return pixels, z
