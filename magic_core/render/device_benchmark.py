"""What `magic bench render --device` measures: torch with gsplat on CUDA, or the CPU kernels.

Forward and backward of `render`, and a whole mapping iteration, on whole frames of 1200 x 680.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from statistics import median
from typing import Any, Literal

import numpy as np
import torch

from magic_core.render.api import GaussianTensors, render
from magic_core.render.backend import new_optimiser, require_cuda
from magic_core.render.benchmark_scene import benchmark_scene
from magic_core.render.rasteriser import Rasteriser

Cell = tuple[int, int, int]
CELLS: tuple[Cell, ...] = ((1200, 680, 100_000), (1200, 680, 500_000))
_WARM_UPS = 3


def run(
    device: Literal["cpu", "cuda"],
    *,
    cells: Sequence[Cell] = CELLS,
    repeats: int = 15,
    progress: Callable[[str], None] = lambda text: None,
) -> dict[str, Any]:
    """Medians per cell (width, height, Gaussians), ms.

    Raises NotSupported when cuda is asked for on a machine without it.
    """
    if device == "cuda":
        require_cuda("--device cuda", instead="--device cpu")
    name = torch.cuda.get_device_name() if device == "cuda" else "cpu"
    rows = []
    for cell in cells:
        progress(f"{cell[0]}x{cell[1]}, {cell[2]:,} Gaussians")
        rows.append(_measure(cell, device, repeats))
    return {"device": name, "cells": rows}


def _measure(cell: Cell, device: Literal["cpu", "cuda"], repeats: int) -> dict[str, Any]:
    cloud, camera = benchmark_scene(*cell)
    gaussians = GaussianTensors.from_cloud(cloud, device=device).requires_grad_()
    shape = (camera.height, camera.width, 3)
    upstream = torch.tensor(np.random.default_rng(1).normal(size=shape), device=device).float()
    view = Rasteriser().render(cloud, camera, np.eye(4))
    colour, depth = (np.clip(view.colour, 0, 1) * 255).astype(np.uint8), view.expected_depth
    optimiser = new_optimiser(cloud, device=device)

    def forward_backward() -> None:
        out = render(gaussians, camera, np.eye(4))
        torch.autograd.grad(
            (out.colour * upstream).sum() + out.depth.sum(), list(gaussians.tensors())
        )

    def iteration() -> None:
        optimiser.step(camera, np.eye(4), colour, depth)

    return {
        "size": f"{cell[0]}x{cell[1]}",
        "gaussians": cell[2],
        "forward_backward_ms": _median_ms(forward_backward, device, repeats),
        "iteration_ms": _median_ms(iteration, device, repeats),
    }


def _median_ms(work: Callable[[], None], device: str, repeats: int) -> float:
    times = []
    for _ in range(_WARM_UPS + repeats):
        start = time.perf_counter()
        work()
        if device == "cuda":
            torch.cuda.synchronize()
        times.append((time.perf_counter() - start) * 1e3)
    return median(times[_WARM_UPS:])
