"""Small real sub-maps: a room of textured boxes, ray-cast with numpy."""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray

from magic_core.gaussians import GaussianCloud
from magic_core.geometry import Camera, se3
from magic_core.submap import Descriptor, Keyframe, OdometryEdge, Submap, TrackedFrame

MODEL_ID = "thumbnail-8x6"
DIMENSION = 144

SMALL = Camera(width=64, height=48, fx=56.0, fy=56.0, cx=31.5, cy=23.5)
LARGE = Camera(width=256, height=192, fx=224.0, fy=224.0, cx=127.5, cy=95.5)

# Rows: lowest and highest corner, metres. The first is the room itself, seen from inside.
BOXES = np.array(
    [
        [[-3.0, -1.3, -2.5], [3.0, 1.3, 2.5]],
        [[-1.4, 0.4, 1.0], [-0.3, 1.3, 1.9]],
        [[0.5, -0.2, 1.3], [1.1, 1.3, 2.0]],
        [[1.7, 0.2, -0.4], [2.6, 1.3, 0.8]],
        [[-2.7, -0.5, 0.2], [-2.1, 1.3, 0.9]],
        [[-0.2, 0.7, 0.6], [0.4, 1.3, 1.1]],
        [[0.9, -1.3, 1.0], [1.3, -0.8, 1.6]],
    ]
)


def look(x: float, z: float, yaw: float, *, y: float = 0.0) -> NDArray[np.float64]:
    """world_from_camera (4, 4) at (x, y, z) metres, turned by yaw radians about the vertical."""
    return se3.from_rotation_translation(se3.rotation_exp([0.0, yaw, 0.0]), [x, y, z])


def render(
    camera: Camera, world_from_camera: NDArray[np.float64]
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Colour (h, w, 3) and depth (h, w) in metres of the room."""
    rays = camera.rays().reshape(-1, 3).astype(np.float64)
    direction = rays @ world_from_camera[:3, :3].T
    origin = world_from_camera[:3, 3]
    best = np.full(len(rays), np.inf)
    which = np.zeros(len(rays), dtype=int)
    face = np.zeros(len(rays), dtype=int)
    with np.errstate(divide="ignore", invalid="ignore"):
        for number, (low, high) in enumerate(BOXES):
            t = np.stack([(low - origin) / direction, (high - origin) / direction])
            near, far = t.min(axis=0), t.max(axis=0)
            distance = far.min(axis=1) if number == 0 else near.max(axis=1)
            axis = far.argmin(axis=1) if number == 0 else near.argmax(axis=1)
            hit = near.max(axis=1) <= far.min(axis=1)
            closer = hit & (distance > 1e-6) & (distance < best)
            best = np.where(closer, distance, best)
            which = np.where(closer, number, which)
            face = np.where(closer, axis, face)
    points = origin + direction * best[:, None]
    colour = _texture(points, which, face)
    shape = (camera.height, camera.width)
    return colour.reshape(*shape, 3), best.reshape(shape).astype(np.float32)


def _texture(points: NDArray, which: NDArray, face: NDArray) -> NDArray[np.uint8]:
    """Blocks of random brightness at two sizes on a base colour per face, the same everywhere."""
    base = np.random.default_rng(7).uniform(60, 190, (len(BOXES), 3, 3))[which, face]
    value = np.zeros(len(points))
    for size, weight in ((0.31, 45.0), (0.093, 35.0)):
        cell = np.floor(points / size + 0.137).astype(np.int64)
        mixed = cell @ np.array([73856093, 19349663, 83492791]) + 7919 * which + 104729 * face
        value += weight * (((mixed * 2654435761) % 4294967291) / 4294967291.0 - 0.5) * 2.0
    return np.clip(base + value[:, None], 0, 255).astype(np.uint8)


def thumbnail(colour: NDArray[np.uint8]) -> Descriptor:
    """A weak but real image descriptor: the image at 8x6, contrast-normalised."""
    height, width = colour.shape[:2]
    blocks = colour[: height // 6 * 6, : width // 8 * 8].astype(np.float64)
    small = blocks.reshape(6, height // 6, 8, width // 8, 3).mean(axis=(1, 3)).reshape(-1)
    small -= small.mean()
    return Descriptor(MODEL_ID, (small / np.linalg.norm(small)).astype(np.float32))


def path(agent: int, submaps: int) -> list[NDArray[np.float64]]:
    """world_from_anchor of an agent's sub-maps: walks that overlap between agents."""
    return [look(-0.5 + 0.28 * i + 0.07 * agent, -1.2 + 0.06 * agent, 0.1 * i - 0.15)
            for i in range(submaps)]  # fmt: skip


@functools.lru_cache(maxsize=64)
def make_submap(
    session: str = "room",
    agent: int = 0,
    index: int = 0,
    *,
    camera: Camera = SMALL,
    frames: int = 4,
    keyframes: int = 2,
    submaps: int = 4,
    known_start: bool = False,
    described: bool = False,
) -> Submap:
    """A sub-map of an agent that walks through the room, with its exact poses.

    `described`: its keyframes have descriptors too.
    """
    anchors = path(agent, submaps)
    world_from_anchor = anchors[index]
    step = se3.exp([0.02, 0.0, 0.01, 0.0, 0.01, 0.0])
    poses = [np.linalg.matrix_power(step, i) for i in range(frames)]
    kept = np.unique(np.linspace(0, frames - 1, keyframes).astype(int)).tolist()
    images = {i: render(camera, world_from_anchor @ poses[i]) for i in kept}
    vectors = {i: thumbnail(images[i][0]).vector for i in kept[1:] if described}
    start = index * frames
    time_of = {i: 0.1 * (start + i) for i in range(frames)}
    odometry = None
    if index:
        motion = se3.inverse(anchors[index - 1]) @ world_from_anchor
        odometry = OdometryEdge(index - 1, motion, np.diag([1e4] * 3 + [4e4] * 3))
    return Submap(
        session=session,
        agent=f"agent_{agent}",
        index=index,
        camera=camera,
        gaussians=gaussians_of(camera, *images[0]),
        keyframes=tuple(
            Keyframe(start + i, time_of[i], poses[i], *images[i], vectors.get(i)) for i in kept
        ),
        trajectory=tuple(
            TrackedFrame(start + i, time_of[i], poses[i], lost=i == 2) for i in range(frames)
        ),
        descriptor=thumbnail(images[0][0]),
        odometry=odometry,
        world_from_anchor_prior=world_from_anchor if known_start and index == 0 else None,
    )


def gaussians_of(
    camera: Camera, colour: NDArray[np.uint8], depth: NDArray[np.float32]
) -> GaussianCloud:
    """One flat Gaussian per second pixel, facing the camera."""
    points = camera.back_project(depth)[::2, ::2].reshape(-1, 3)
    size = (points[:, 2] / camera.fx).astype(np.float32)
    count = len(points)
    return GaussianCloud.from_arrays(
        points,
        np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        scales=np.stack([size, size, np.full(count, 0.002)], axis=1),
        opacities=np.full(count, 0.9),
        colours=colour[::2, ::2].reshape(-1, 3) / 255.0,
    )
