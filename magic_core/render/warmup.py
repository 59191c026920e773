"""Compile every kernel ahead of time, saying what is compiled and how long it takes."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from magic_core.gaussians import GaussianCloud
from magic_core.geometry import Camera
from magic_core.render.jit import drop_stale_kernels, kernel_cache_folder
from magic_core.render.lanes import LANES
from magic_core.render.optimiser import GaussianOptimiser
from magic_core.render.rasteriser import Rasteriser


@dataclass(frozen=True, slots=True)
class WarmUpReport:
    """What `warm_up` did."""

    lanes: int
    """float32 lanes of the SIMD type on this processor."""
    cache_folder: str
    """Where compiled kernels are kept; empty where nothing can be written."""
    seconds: dict[str, float]
    """Time per group of kernels: about zero when they came from the cache."""

    @property
    def total_s(self) -> float:
        """All groups together."""
        return sum(self.seconds.values())


def warm_up(*, progress: Callable[[str], None] | None = None) -> WarmUpReport:
    """Run every kernel once on a tiny scene, so that all are compiled and cached on disk.

    progress is called with one line before and after each group.
    """
    say = progress or (lambda text: None)
    seconds = {}
    say(f"kernels for this processor: {LANES} float32 lanes")
    for name, action in (
        ("render", _render), ("gradients", _gradients), ("mapping iteration", _mapping),
        ("tracking", _tracking),
    ):  # fmt: skip
        say(f"{name}: compiling or loading")
        start = time.perf_counter()
        action()
        seconds[name] = time.perf_counter() - start
        say(f"{name}: {seconds[name]:.1f} s")
    drop_stale_kernels()
    return WarmUpReport(LANES, str(kernel_cache_folder() or ""), seconds)


_CAMERA = Camera(width=40, height=24, fx=30.0, fy=30.0, cx=19.5, cy=11.5)


def _cloud() -> GaussianCloud:
    return GaussianCloud.from_arrays(
        [[0, 0, 1.0], [0.1, 0.1, 1.2]], [[1, 0, 0, 0]] * 2, scales=[[0.2] * 3] * 2,
        opacities=[0.5, 0.6], colours=[[1, 0, 0], [0, 1, 0]],
    )  # fmt: skip


def _render() -> None:
    Rasteriser(1).render(_cloud(), _CAMERA, np.eye(4))


def _gradients() -> None:
    rasteriser = Rasteriser(1)
    view = rasteriser.render(_cloud(), _CAMERA, np.eye(4))
    rasteriser.backward(view.image)


def _mapping() -> None:
    shape = (_CAMERA.height, _CAMERA.width)
    colour, depth = np.zeros((*shape, 3), np.uint8), np.ones(shape, np.float32)
    GaussianOptimiser(_cloud(), threads=1).step(_CAMERA, np.eye(4), colour, depth)


def _tracking() -> None:
    from magic_core.render.linearisation import ResidualModel, linearise

    reference = Rasteriser(1).render(_cloud(), _CAMERA, np.eye(4)).image
    image = np.ascontiguousarray(reference[:4].transpose(1, 2, 0))
    linearise(
        reference, image, camera=_CAMERA, camera_from_reference=np.eye(4), model=ResidualModel(),
        threads=1,
    )  # fmt: skip
