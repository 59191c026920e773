"""Levels of detail: what a map shows in half, a quarter and less of its Gaussians.

Judged on keyframes spread over a finished run: neighbours merged, as `GetGlobalMap` does it,
against the Gaussians that show most, as they are and widened, and against a random choice widened
to cover as much as all.

  python benchmarks/globalmap/detail.py RUN [--shares 2 4 8 16] [--views 16]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from magic_cli.benchmarks.stored import stored_sources
from magic_core.evaluation import RunFolder
from magic_core.gaussians import GaussianCloud
from magic_core.gaussians.reduction import reduced
from magic_core.render import Rasteriser
from magic_server.globalmap.placement import View, view_of

Choice = Callable[[GaussianCloud, int], GaussianCloud]


def strongest(cloud: GaussianCloud, count: int) -> GaussianCloud:
    """The Gaussians of the largest opacity times area."""
    areas = np.sort(cloud.scales.astype(np.float64), axis=1)[:, 1:].prod(axis=1)
    order = np.argsort(-cloud.opacities * areas, kind="stable")
    return cloud.select(np.sort(order[:count]))


def at_random(cloud: GaussianCloud, count: int) -> GaussianCloud:
    """A random choice."""
    return cloud.select(np.sort(np.random.default_rng(0).permutation(len(cloud))[:count]))


def wider(cloud: GaussianCloud, factor: float) -> GaussianCloud:
    """The same, larger."""
    scales = cloud.scales * np.float32(factor)
    return GaussianCloud(cloud.means, cloud.quaternions, scales, cloud.opacities, cloud.colours)


CHOICES: dict[str, Choice] = {
    "neighbours merged": reduced,
    "strongest": strongest,
    "strongest, 1.3 times as wide": lambda cloud, count: wider(strongest(cloud, count), 1.3),
    "random, widened": lambda cloud, count: wider(
        at_random(cloud, count), (len(cloud) / count) ** 0.5
    ),
}


def psnr_of(cloud: GaussianCloud, views: Sequence[View]) -> float:
    """Mean PSNR on views, dB."""
    rasteriser, found = Rasteriser(1), []
    for view in views:
        shown = rasteriser.render(cloud, view.camera, view.world_from_camera).colour
        error = np.clip(shown, 0.0, 1.0) - view.colour.astype(np.float32) / 255.0
        found.append(-10.0 * np.log10(max(float(np.mean(error**2)), 1e-10)))
    return float(np.mean(found))


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--shares", type=int, nargs="+", default=[2, 4, 8, 16])
    parser.add_argument("--views", type=int, default=16)
    given = parser.parse_args()
    folder = RunFolder(given.run)
    cloud, sources = folder.read_map(), stored_sources(folder)
    frames = [(s, k) for s in sources for k in range(len(s.keyframe_poses()))]
    chosen = np.linspace(0, len(frames) - 1, min(given.views, len(frames))).astype(int)
    views = [view_of(*frames[i]) for i in chosen]
    print(f"all {len(cloud)} Gaussians: {psnr_of(cloud, views):.2f} dB", flush=True)
    for share in given.shares:
        for name, choice in CHOICES.items():
            began = time.process_time()
            some = choice(cloud, len(cloud) // share)
            seconds = time.process_time() - began
            found = psnr_of(some, views)
            print(f"1/{share} {name}: {found:.2f} dB, {seconds:.1f} s", flush=True)


if __name__ == "__main__":
    main()
