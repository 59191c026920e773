"""A textured room with boxes, seen once: the scene of the render benchmark.

Gaussians are seeded on random pixels, about as large as the distance to their neighbours, so that
some forty of them are blended per pixel, as in a map under optimisation.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magic_core.gaussians import GaussianCloud
from magic_core.geometry import Camera

Array = NDArray[np.float64]

_ROOM = ((-2.4, -1.4, -1.2), (2.4, 1.4, 4.6))  # corners, metres; the camera is inside
_BOXES = (
    ((-1.7, 0.3, 2.6), (-0.7, 1.4, 3.4)),
    ((0.5, -0.1, 2.2), (1.3, 1.4, 2.9)),
    ((-0.4, 0.8, 1.6), (0.2, 1.4, 2.2)),
    ((1.5, -1.4, 3.4), (2.4, 0.2, 4.6)),
)
_SIZE_OVER_SPACING = 1.5


def benchmark_scene(width: int, height: int, count: int) -> tuple[GaussianCloud, Camera]:
    """`count` Gaussians on the surfaces that a camera at the origin sees, and that camera."""
    from scipy.spatial import KDTree

    focal = 0.9 * width
    camera = Camera(width, height, focal, focal, width / 2 - 0.5, height / 2 - 0.5)
    rng = np.random.default_rng(0)
    pixel = rng.integers(0, width * height, count)
    jitter = rng.uniform(-0.5, 0.5, (count, 2))
    rays = np.column_stack([
        (pixel % width + jitter[:, 0] - camera.cx) / focal,
        (pixel // width + jitter[:, 1] - camera.cy) / focal,
        np.ones(count),
    ])  # fmt: skip
    points = rays * _distance(rays)[:, None]
    spacing = np.asarray(KDTree(points).query(points, k=2)[0])[:, 1].clip(1e-4)
    log_scales = np.log(_SIZE_OVER_SPACING * spacing)[:, None] + rng.uniform(
        -0.25, 0.25, (count, 3)
    )
    quaternions = rng.normal(size=(count, 4))
    cloud = GaussianCloud.from_arrays(
        points,
        quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True),
        scales=np.exp(log_scales),
        opacities=rng.uniform(0.5, 0.99, count),
        colours=0.5 + 0.4 * np.sin(3.0 * points + 2.0 * np.sin(5.0 * points[:, ::-1])),
    )
    return cloud, camera


def _distance(rays: Array) -> Array:
    """How far along each ray (n, 3) from the origin the first surface lies."""
    inverse = 1.0 / np.where(np.abs(rays) < 1e-12, 1e-12, rays)
    low, high = (np.array(corner) * inverse for corner in _ROOM)
    nearest = np.maximum(low, high).min(axis=1)
    for box in _BOXES:
        low, high = (np.array(corner) * inverse for corner in box)
        entry = np.minimum(low, high).max(axis=1)
        leave = np.maximum(low, high).min(axis=1)
        hit = (entry < leave) & (entry > 1e-3)
        nearest = np.where(hit, np.minimum(nearest, entry), nearest)
    return nearest
