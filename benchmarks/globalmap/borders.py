"""Whether borders of blocks show: a finished run merged in one piece and in blocks.

PSNR of the keyframes near the blocks' borders (within ten pixels of where a keyframe's surface goes
from one block to another) and everywhere else.

  python benchmarks/globalmap/borders.py RUN [--block-views 48] [--passes 3]
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from magic_cli.benchmarks.stored import stored_sources
from magic_core.evaluation import RunFolder
from magic_core.gaussians import GaussianCloud
from magic_core.geometry import se3
from magic_core.render import Rasteriser
from magic_server.globalmap import MergeConfig, build_global_map
from magic_server.globalmap.blocks import Block, places_of, plan_blocks
from magic_server.globalmap.placement import PlacedSource, View, views_of

NEAR_PIXELS = 10
LEAST_PIXELS = 200


def near_border(view: View, blocks: Sequence[Block]) -> NDArray[np.bool_]:
    """(h, w) which pixels are near a border."""
    points = view.camera.back_project(view.depth).reshape(-1, 3)
    world = se3.transform_points(view.world_from_camera, points)
    known = view.depth > 0
    owner = np.argmax(np.stack([block.holds(world) for block in blocks]), axis=0)
    owner = owner.reshape(known.shape)
    near = np.zeros_like(known)
    for number in range(len(blocks)):
        mine = (owner == number) & known
        near |= binary_dilation(mine, iterations=NEAR_PIXELS) & known & ~mine
    return near


def judged(cloud: GaussianCloud, views: Sequence[View], blocks: Sequence[Block]) -> str:
    """Mean PSNR near borders and elsewhere."""
    rasteriser, near, elsewhere = Rasteriser(1), [], []
    for view in views:
        shown = rasteriser.render(cloud, view.camera, view.world_from_camera).colour
        error = ((np.clip(shown, 0.0, 1.0) - view.colour / 255.0) ** 2).mean(axis=2)
        border = near_border(view, blocks)
        if border.sum() > LEAST_PIXELS:
            near.append(-10.0 * np.log10(error[border].mean()))
        elsewhere.append(-10.0 * np.log10(error[~border].mean()))
    return (
        f"{np.mean(near):.2f} dB near borders ({len(near)} keyframes), "
        f"{np.mean(elsewhere):.2f} dB elsewhere"
    )


def merged(sources: Sequence[PlacedSource], config: MergeConfig) -> tuple[GaussianCloud, str]:
    """A map and what it took."""
    began = time.process_time()
    made = build_global_map(sources, config, progress=lambda share, text: None)
    seconds, summary = time.process_time() - began, made.summary
    return made.cloud, f"{summary.blocks} blocks, {summary.iterations} steps, {seconds:.0f} s"


def main() -> None:
    """Print both."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--block-views", type=int, default=48)
    parser.add_argument("--passes", type=int, default=3)
    given = parser.parse_args()
    sources = stored_sources(RunFolder(given.run))
    views = views_of(sources)
    blocks = plan_blocks(places_of(sources), most_views=given.block_views)
    config = MergeConfig(passes=given.passes, threads=1)
    for most in (given.block_views, len(views)):
        cloud, took = merged(sources, dataclasses.replace(config, block_views=most))
        print(f"{took}: {judged(cloud, views, blocks)}", flush=True)


if __name__ == "__main__":
    main()
