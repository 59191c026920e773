"""A textured box-shaped room with a cupboard in it, ray-cast exactly, for registration tests."""

from __future__ import annotations

import numpy as np

from magic_core.geometry import Camera, se3
from magic_server.registration import AnchorView

CAMERA = Camera(width=160, height=120, fx=130.0, fy=130.0, cx=79.5, cy=59.5)
ROOM = (np.array([-2.0, -1.5, -2.5]), np.array([2.0, 1.2, 2.5]))
CUPBOARD = (np.array([0.9, -0.2, 1.4]), np.array([1.6, 1.2, 2.1]))
TEXELS_PER_M = 24


class TexturedRoom:
    """Everything about it follows from the seed; the shape is the same for all seeds."""

    def __init__(self, seed: int) -> None:
        self._generator = np.random.default_rng(seed)
        self._textures = [self._texture() for _ in range(12)]

    def view(self, world_from_camera: np.ndarray, camera: Camera = CAMERA) -> AnchorView:
        """The exact RGB-D image from a pose."""
        colour, depth = self.image(world_from_camera, camera)
        return AnchorView(camera, colour, depth)

    def image(
        self, world_from_camera: np.ndarray, camera: Camera = CAMERA
    ) -> tuple[np.ndarray, np.ndarray]:
        rays = camera.rays().reshape(-1, 3).astype(np.float64)
        origin = world_from_camera[:3, 3]
        directions = rays @ world_from_camera[:3, :3].T
        with np.errstate(divide="ignore"):
            walls, wall_face = _crossings(origin, directions, *ROOM, leaving=True)
            cupboard, cupboard_face = _crossings(origin, directions, *CUPBOARD, leaving=False)
        hits_cupboard = cupboard < walls
        depth = np.where(hits_cupboard, cupboard, walls)
        face = np.where(hits_cupboard, 6 + cupboard_face, wall_face)
        points = origin + depth[:, None] * directions
        colour = np.zeros((len(depth), 3))
        for index, texture in enumerate(self._textures):
            chosen = face == index
            across = [axis for axis in range(3) if axis != index % 6 // 2]
            colour[chosen] = _sampled(texture, points[chosen][:, across] * TEXELS_PER_M)
        shape = (camera.height, camera.width)
        return colour.reshape(*shape, 3).astype(np.uint8), depth.reshape(shape).astype(np.float32)

    def _texture(self) -> np.ndarray:
        """Patches of several sizes over a colour of its own."""
        texture = np.tile(self._generator.uniform(60, 200, 3), (128, 128, 1))
        for size, strength in ((2, 25), (4, 30), (16, 30)):
            coarse = self._generator.normal(size=(128 // size, 128 // size, 3)) * strength
            texture += np.kron(coarse, np.ones((size, size, 1)))
        return np.clip(texture, 0, 255)


def pose(x: float, z: float, heading_deg: float, *, y: float = 0.0, pitch_deg: float = 0.0):
    """world_from_camera at a place, looking along z turned by a heading."""
    heading = se3.rotation_exp([0.0, np.radians(heading_deg), 0.0])
    pitch = se3.rotation_exp([np.radians(pitch_deg), 0.0, 0.0])
    return se3.from_rotation_translation(heading @ pitch, [x, y, z])


def _crossings(origin, directions, low, high, *, leaving: bool):
    """Distance and face (2 * axis + side) where rays leave or enter a box."""
    to_low, to_high = (low - origin) / directions, (high - origin) / directions
    near, far = np.minimum(to_low, to_high), np.maximum(to_low, to_high)
    if leaving:
        axis = far.argmin(axis=1)
        distance = far.min(axis=1)
    else:
        axis = near.argmax(axis=1)
        distance = near.max(axis=1)
        missed = (distance > far.min(axis=1)) | (distance <= 0)
        distance = np.where(missed, np.inf, distance)
    chosen = directions[np.arange(len(axis)), axis]
    side = (chosen > 0) == leaving
    return distance, 2 * axis + side


def _sampled(texture: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Bilinear lookup, repeating."""
    whole = np.floor(at).astype(int)
    part = at - whole
    size = len(texture)
    total = np.zeros((len(at), 3))
    for du in (0, 1):
        for dv in (0, 1):
            weight = np.abs(1 - du - part[:, 0]) * np.abs(1 - dv - part[:, 1])
            total += weight[:, None] * texture[(whole[:, 0] + du) % size, (whole[:, 1] + dv) % size]
    return total
