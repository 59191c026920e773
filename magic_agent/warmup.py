"""Load what an agent computes with before its first frame: a live camera does not wait for it."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from magic_agent.slam import Describe, LocalSlam
from magic_agent.slam_config import SlamConfig
from magic_core.data import Frame
from magic_core.geometry import Camera
from magic_core.render import WarmUpReport, warm_up
from magic_core.submap import Descriptor

_CAMERA = Camera(width=160, height=120, fx=140.0, fy=140.0, cx=79.5, cy=59.5)


def warm_up_slam(
    config: SlamConfig | None = None,
    *,
    describe: Describe | None = None,
    progress: Callable[[str], None] | None = None,
) -> WarmUpReport:
    """Take a throwaway engine through an anchor, a tracked frame and a lost one.

    Compiles or loads the kernels of rendering, mapping, tracking and relocalisation, the libraries
    behind them, and the descriptor model if `describe` asks one. progress: as for `warm_up`.
    """
    report = warm_up(progress=progress)
    started = time.perf_counter()
    slam = LocalSlam(
        _CAMERA,
        config or SlamConfig(),
        session="warm-up",
        agent="warm-up",
        describe=describe or _no_descriptor,
    )
    for frame in _frames():
        slam.process(frame)
    seconds = {**report.seconds, "local SLAM": time.perf_counter() - started}
    return replace(report, seconds=seconds)


def _no_descriptor(colour: NDArray[np.uint8]) -> Descriptor:
    return Descriptor("none", np.ones(1, np.float32))


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
