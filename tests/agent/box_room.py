"""A room for tracking tests: the inside of a textured box, ray-cast exactly at any pose."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from magic_core.data import Frame
from magic_core.geometry import Camera, se3

CAMERA = Camera(width=160, height=120, fx=130.0, fy=130.0, cx=79.5, cy=59.5)
HALF_SIZE = np.array([1.1, 0.9, 2.0])  # metres; the camera is near the centre
_WAVES = np.random.default_rng(7).normal(0.0, 3.0, (3, 3))
_PHASES = np.random.default_rng(8).uniform(0.0, 6.28, 3)
_TILE_COLOURS = np.random.default_rng(9).uniform(0.0, 1.0, (4096, 3))


def room_frame(
    world_from_camera: np.ndarray,
    index: int = 0,
    *,
    camera: Camera = CAMERA,
    noise_seed: int | None = None,
) -> Frame:
    """The frame at a pose; with a seed, colour and depth carry noise like a Kinect's."""
    colour, depth = _clean(camera, world_from_camera.tobytes())
    if noise_seed is not None:
        rng = np.random.default_rng(noise_seed)
        colour = colour + rng.normal(0.0, 0.01, colour.shape)
        depth = depth + rng.normal(0.0, 1.0, depth.shape) * (0.0015 + 0.002 * depth**2)
    return Frame(
        index,
        index / 30.0,
        np.clip(255.0 * colour, 0.0, 255.0).astype(np.uint8),
        depth.astype(np.float32),
        world_from_camera,
    )


@lru_cache(maxsize=64)
def _clean(camera: Camera, pose: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Colour (h, w, 3) and depth (h, w) without noise."""
    world_from_camera = np.frombuffer(pose).reshape(4, 4)
    depth, _ = _cast(camera, world_from_camera)
    # Tiles have sharp edges: point samples would snap to pixels, so pixels average 4 x 4 samples.
    fine = texture(_cast(camera.scaled(4.0), world_from_camera)[1])
    return fine.reshape(camera.height, 4, camera.width, 4, 3).mean(axis=(1, 3)), depth


def _cast(camera: Camera, world_from_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depth (h, w) along z and the points (h, w, 3) where rays leave the box."""
    rays = camera.rays().astype(np.float64) @ world_from_camera[:3, :3].T
    origin = world_from_camera[:3, 3]
    with np.errstate(divide="ignore"):
        exits = (np.sign(rays) * HALF_SIZE - origin) / rays
    depth = np.min(np.where(rays == 0.0, np.inf, exits), axis=-1)  # z of the ray is 1
    return depth, origin + rays * depth[..., None]


def texture(points: np.ndarray) -> np.ndarray:
    """(..., 3) colour of points on the walls: tiles of random colour under slow waves."""
    waves = np.sin(points @ _WAVES.T + _PHASES)  # (..., 3)
    tiles = np.floor(points / 0.17 + 0.31).astype(np.int64) @ (73_856_093, 19_349_663, 83_492_791)
    return 0.5 + 0.12 * waves + 0.5 * (_TILE_COLOURS[tiles % len(_TILE_COLOURS)] - 0.5)


def walk(count: int, *, speed: float = 1.0) -> list[np.ndarray]:
    """Poses of a hand-held walk through the room: 2 cm and 1 degree per frame at speed 1."""
    step = np.array([0.012, 0.004, 0.015, 0.006, 0.015, -0.004]) * speed
    poses = [se3.exp([-0.3, 0.05, -0.4, 0.02, -0.2, 0.01])]
    for number in range(1, count):
        wobble = 0.4 * np.sin(0.7 * number) * step[[1, 2, 0, 4, 3, 5]]
        poses.append(poses[-1] @ se3.exp(step + wobble))
    return poses
