"""What `magic bench render` measures: the rasteriser, a mapping iteration, both beside others.

Times on a shared machine drift, so everything that is compared runs in turns within one process
(or, for the 8-lane path, two processes in lock-step), and ratios are medians of the ratios of
neighbouring runs.
"""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from magic_core.errors import DataError
from magic_core.gaussians import GaussianCloud
from magic_core.geometry import Camera
from magic_core.render.benchmark_scene import benchmark_scene
from magic_core.render.lanes import LANES
from magic_core.render.optimiser import GaussianOptimiser
from magic_core.render.peak import multiply_add_rate
from magic_core.render.rasteriser import Rasteriser

_Figures = TypeVar("_Figures")
Cell = tuple[int, int, int]
CELLS: tuple[Cell, ...] = (
    (320, 240, 20_000), (320, 240, 60_000), (640, 480, 60_000), (640, 480, 150_000),
)  # fmt: skip
_WARM_UPS = 2
_PAUSE_S = 0.01

# Vector instructions of the inner loops per (Gaussian, block), counted in the compiled code.
_FORWARD_INSTRUCTIONS, _BACKWARD_INSTRUCTIONS = 22, 40

_AVX2_TARGET = {
    "MAGIC_LANES": "8",
    "NUMBA_CPU_NAME": "haswell",
    "NUMBA_CPU_FEATURES": "+64bit,+avx,+avx2,+bmi,+bmi2,+cmov,+f16c,+fma,+lzcnt,+mmx,+movbe,"
    "+popcnt,+sse,+sse2,+sse3,+sse4.1,+sse4.2,+ssse3",
}


@dataclass(frozen=True, slots=True)
class Subject:
    """One cell's input, and our rasteriser ready to run on it."""

    camera: Camera
    cloud: GaussianCloud
    gradient: NDArray[np.float32]  # (5, h, w)
    rasteriser: Rasteriser

    @classmethod
    def of(cls, cell: Cell, threads: int) -> Subject:
        """Build the scene of a cell."""
        cloud, camera = benchmark_scene(*cell)
        shape = (5, camera.height, camera.width)
        gradient = np.random.default_rng(1).normal(size=shape).astype(np.float32)
        return cls(camera, cloud, gradient, Rasteriser(threads))

    def run(self) -> tuple[float, float]:
        """(forward, forward + backward) of one run, ms."""
        flat = tuple(array.reshape(-1) for array in self.cloud.arrays())
        start = time.perf_counter()
        self.rasteriser.forward(flat, self.camera, np.eye(4))
        middle = time.perf_counter()
        self.rasteriser.accumulate(self.gradient)
        return (middle - start) * 1e3, (time.perf_counter() - start) * 1e3


def run(
    against: Path | None = None,
    *,
    repeats: int = 15,
    cells: Sequence[Cell] = CELLS,
    threads: Sequence[int] = (1, 2),
    extras: bool = True,
    progress: Callable[[str], None] | None = None,
) -> dict[str, Any]:
    """Measure all cells, and with `extras` also the other four figures.

    Args:
        against: folder of the prototype (ngs.py) that is timed in the same run, or None.
        repeats: interleaved runs per cell.
        cells: (width, height, Gaussians).
        threads: each cell is measured with each of these.
        extras: also measure the mapping iteration, the 8-lane path, the torch reference and the
            share of the machine's peak.
        progress: called with one line per figure.
    """
    say = progress or (lambda text: None)
    prototype = _load_prototype(against) if against is not None else None
    result: dict[str, Any] = {"lanes": LANES, "cells": []}
    for cell in cells:
        for count in threads:
            row = _measure_cell(cell, count, prototype, repeats)
            result["cells"].append(row)
            say(_line(row))
    for name, measure in (
        ("mapping_iteration_ratio", lambda: _mapping_ratio(cells[0], repeats)),
        ("lanes8_ratio", lambda: _lanes8_ratio(cells[0], repeats)),
        ("reference_ratio", _reference_ratio),
        ("peak_share", lambda: _peak_share(cells[0], repeats)),
    ):
        result[name] = measure() if extras else None
        if extras:
            say(f"{name} {result[name]}")
    return result


def _line(row: dict[str, Any]) -> str:
    text = (
        f"{row['size']} {row['gaussians'] // 1000}k, {row['threads']} threads: forward "
        f"{row['forward_ms']:.2f} ms, forward+backward {row['forward_backward_ms']:.2f} ms"
    )
    return text if row["ratio"] is None else f"{text}, ratio {row['ratio']:.3f}"


def _measure_cell(cell: Cell, threads: int, prototype: Any | None, repeats: int) -> dict[str, Any]:
    subject = Subject.of(cell, threads)
    other = _prototype_runner(prototype, subject, threads) if prototype is not None else None
    ours, theirs = [], []
    for _ in range(_WARM_UPS + repeats):
        ours.append(_settled(subject.run))
        theirs.append(_settled(other) if other is not None else None)
    ours, theirs = ours[_WARM_UPS:], theirs[_WARM_UPS:]
    row: dict[str, Any] = {
        "size": f"{cell[0]}x{cell[1]}", "gaussians": cell[2], "threads": threads,
        "forward_ms": median(f for f, _ in ours),
        "forward_backward_ms": median(b for _, b in ours),
        "against_forward_backward_ms": None, "ratio": None,
    }  # fmt: skip
    if other is not None:
        row["against_forward_backward_ms"] = median(theirs)
        row["ratio"] = median(a[1] / b for a, b in zip(ours, theirs, strict=True))
    return row


def _settled(run: Callable[[], _Figures]) -> _Figures:
    """A run's figures after a pause and one more run of its own.

    The prototype's OpenMP threads keep a core busy for milliseconds after their work is done, and
    each leaves the caches full of its own data: neither may be charged to the other.
    """
    time.sleep(_PAUSE_S)
    run()
    return run()


def _load_prototype(folder: Path) -> Any:
    """The prototype's module `ngs`."""
    if not (folder / "ngs.py").is_file():
        raise DataError(f"{folder}: no ngs.py there; --against names the prototype's folder")
    sys.path.insert(0, str(folder.resolve()))
    try:
        return importlib.import_module("ngs")
    finally:
        sys.path.pop(0)


def _prototype_runner(module: Any, subject: Subject, threads: int) -> Callable[[], float]:
    """A function that runs the prototype's forward and backward once and returns ms."""
    cloud, camera = subject.cloud, subject.camera
    gaussians = {
        "means": cloud.means, "quats": cloud.quaternions, "logs": np.log(cloud.scales),
        "opa": np.log(cloud.opacities / (1 - cloud.opacities)), "rgb": cloud.colours,
    }  # fmt: skip
    camera_from_world = np.concatenate([np.eye(3).ravel(), np.zeros(3)]).astype(np.float32)
    intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy)
    rasteriser = module.NGS()

    def once() -> float:
        start = time.perf_counter()
        rasteriser.fwd(
            gaussians, camera_from_world, intrinsics, camera.width, camera.height,
            "nb_mask_simd", threads,
        )  # fmt: skip
        rasteriser.bwd(gaussians, subject.gradient, nth=threads)
        return (time.perf_counter() - start) * 1e3

    return once


def _mapping_ratio(cell: Cell, repeats: int) -> float:
    """A full mapping iteration over forward + backward alone, one thread, in turns."""
    subject = Subject.of(cell, 1)
    optimiser = GaussianOptimiser(subject.cloud, threads=1)
    view = subject.rasteriser.render(subject.cloud, subject.camera, np.eye(4))
    colour = (np.clip(view.colour, 0, 1) * 255).astype(np.uint8)
    depth = view.expected_depth
    ratios = []
    for _ in range(_WARM_UPS + repeats):
        alone = subject.run()[1]
        start = time.perf_counter()
        optimiser.step(subject.camera, np.eye(4), colour, depth)
        ratios.append((time.perf_counter() - start) * 1e3 / alone)
    return median(ratios[_WARM_UPS:])


def _lanes8_ratio(cell: Cell, repeats: int) -> float | None:
    """Forward + backward of the 8-lane path (compiled for AVX2 alone) over the 16-lane path."""
    if LANES != 16:
        return None
    subject = Subject.of(cell, 1)
    command = [sys.executable, "-m", "magic_core.render.benchmark", *map(str, cell)]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        env={**os.environ, **_AVX2_TARGET},
    ) as other:  # fmt: skip
        assert other.stdin is not None
        assert other.stdout is not None
        ratios = []
        for _ in range(_WARM_UPS + repeats):
            own = subject.run()[1]
            other.stdin.write("run\n")
            other.stdin.flush()
            ratios.append(json.loads(other.stdout.readline()) / own)
        other.stdin.close()
    return median(ratios[_WARM_UPS:])


def _answer_runs(cell: Cell) -> None:
    """The other side of `_lanes8_ratio`: one run per line read, its time in ms as the answer."""
    subject = Subject.of(cell, 1)
    for _ in sys.stdin:
        print(json.dumps(subject.run()[1]), flush=True)


def _reference_ratio() -> float:
    """The torch reference's forward + backward over ours, on a scene small enough for it."""
    import torch

    from magic_core.render.api import GaussianTensors, render

    subject = Subject.of((96, 72, 1000), 1)
    gaussians = GaussianTensors.from_cloud(subject.cloud).requires_grad_()
    start = time.perf_counter()
    out = render(gaussians, subject.camera, np.eye(4), "reference")
    upstream = torch.from_numpy(subject.gradient)
    loss = (out.colour * upstream[:3].permute(1, 2, 0)).sum() + (out.depth * upstream[3]).sum()
    loss.backward()
    reference_ms = (time.perf_counter() - start) * 1e3
    return reference_ms / median(subject.run()[1] for _ in range(7))


def _peak_share(cell: Cell, repeats: int) -> float:
    """Issued vector instructions of both blend loops over what the machine could issue.

    The machine's limit is the measured rate of independent multiply-adds, in turns with the runs;
    the best of both counts, as other processes only ever slow them.
    """
    subject = Subject.of(cell, 1)
    subject.run()
    r = subject.rasteriser
    kept = np.concatenate(
        [r.masks[begin : begin + n] for begin, n in zip(r.starts[:-1], r.kept, strict=True)]
    )
    pairs = int(np.bitwise_count(kept).sum())
    instructions = pairs * (_FORWARD_INSTRUCTIONS + _BACKWARD_INSTRUCTIONS)
    rates, blends = [], []
    for _ in range(max(repeats, 15)):
        rates.append(multiply_add_rate())
        subject.run()
        blends.append(1e-3 * (r.stage_ms["blend"] + r.stage_ms["blend_backward"]))
    return instructions / min(blends) / max(rates)


if __name__ == "__main__":
    width, height, gaussians = (int(argument) for argument in sys.argv[1:4])
    _answer_runs((width, height, gaussians))
