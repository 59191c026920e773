"""Load what an agent computes with before its first frame: a live camera does not wait for it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magic_agent.slam import Describe, LocalSlam
from magic_agent.slam_config import SlamConfig
from magic_core.data import Frame
from magic_core.geometry import Camera
from magic_core.render import warm_up

_CAMERA = Camera(width=160, height=120, fx=140.0, fy=140.0, cx=79.5, cy=59.5)


def warm_up_slam(config: SlamConfig, *, describe: Describe) -> None:
    """Take a throwaway engine through an anchor, a tracked frame and a lost one.

    Compiles or loads the kernels of mapping, tracking and relocalisation, the libraries behind
    them, and the descriptor model.
    """
    warm_up()
    slam = LocalSlam(_CAMERA, config, session="warm-up", agent="warm-up", describe=describe)
    for frame in _frames():
        slam.process(frame)


def _frames() -> list[Frame]:
    """A textured slope, the same seen from a little beside, and another texture: it is lost."""
    rng = np.random.default_rng(0)
    slope = np.tile(np.linspace(1.5, 2.0, _CAMERA.width, dtype=np.float32), (_CAMERA.height, 1))
    here, elsewhere = (_texture(rng) for _ in range(2))
    images = [here, np.roll(here, 1, axis=1), elsewhere]
    depths = [slope, slope, slope[:, ::-1].copy()]
    return [
        Frame(index, index / 30.0, image, depth)
        for index, (image, depth) in enumerate(zip(images, depths, strict=True))
    ]


def _texture(rng: np.random.Generator) -> NDArray[np.uint8]:
    """(h, w, 3) tiles of random colours."""
    tiles = rng.integers(0, 256, (_CAMERA.height // 8, _CAMERA.width // 8, 3), dtype=np.uint8)
    return np.ascontiguousarray(tiles.repeat(8, axis=0).repeat(8, axis=1))
