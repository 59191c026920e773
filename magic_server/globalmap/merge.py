"""The global map: sub-maps appended, then refined from their keyframes, block by block.

Paper, "Global Map Construction": a coarse stage that appends, and a fine stage that optimises with
the mapping losses and removes what turned transparent. Memory holds one block at a time.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magic_core.errors import InvalidInput
from magic_core.gaussians import GaussianCloud
from magic_core.gaussians.morton import in_morton_order
from magic_core.render import LossWeights
from magic_core.render.backend import Optimiser, new_optimiser
from magic_server.globalmap.blocks import Block, places_of, plan_blocks
from magic_server.globalmap.config import MergeConfig
from magic_server.globalmap.parts import Parts, fingerprint_of
from magic_server.globalmap.placement import (
    PlacedSource,
    View,
    placed_gaussians,
    view_of,
)
from magic_server.globalmap.quality import mean_psnr
from magic_server.globalmap.refine import FineResult, FineStage, rates

Progress = Callable[[float, str], None]

_JUDGED_VIEWS = 24  # keyframes of a block on which the merge reports its own quality


@dataclass(frozen=True, slots=True)
class MergeSummary:
    """What a merge did."""

    gaussians: int
    blocks: int
    iterations: int
    """Optimisation steps of the fine stage, all blocks together."""
    seconds: float
    converged: bool
    """Whether every block stopped because it had settled, not because of its budget."""
    psnr_coarse_db: float
    """Mean PSNR on a spread of keyframes after the coarse stage."""
    psnr_fine_db: float
    """The same after the fine stage."""
    coarse_gaussians: int
    filled: int
    """Gaussians seeded where keyframes saw surface that no sub-map showed."""
    pruned: int


@dataclass(frozen=True, slots=True)
class GlobalMap:
    """One merged map in the world frame of its component, and what the merge did."""

    cloud: GaussianCloud
    summary: MergeSummary


def build_global_map(
    sources: Sequence[PlacedSource], config: MergeConfig, *, progress: Progress
) -> GlobalMap:
    """Merge placed sub-maps of one component into memory; deterministic for a seed.

    `progress` hears a share from 0 to 1 and what is being done. Raises InvalidInput when there is
    nothing to merge.
    """
    with tempfile.TemporaryDirectory(prefix="magic-merge-") as folder:
        parts, summary = merge_into(Path(folder), sources, config, progress=progress)
        cloud = GaussianCloud.concatenate(list(parts.clouds(summary.blocks)))
    return GlobalMap(cloud, summary)


def merge_into(
    folder: Path, sources: Sequence[PlacedSource], config: MergeConfig, *, progress: Progress
) -> tuple[Parts, MergeSummary]:
    """Merge into block files in a folder; goes on where an earlier call with it was cut off."""
    config.validate()
    if not sources:
        raise InvalidInput.field("submaps", "none given; a map needs at least one sub-map")
    started = time.perf_counter()
    parts = Parts(folder, fingerprint_of(sources, config))
    if config.refine:
        progress(0.0, "dividing space into blocks")
        blocks = plan_blocks(places_of(sources), most_views=config.block_views)
        figures = [
            parts.finished(number)
            or _refine_block(number, blocks, parts, sources, config, progress)
            for number in range(len(blocks))
        ]
    else:
        figures = _append(parts, sources, progress)
    progress(1.0, f"merged {sum(item['gaussians'] for item in figures)} Gaussians")
    return parts, _summary(figures, time.perf_counter() - started)


def _append(
    parts: Parts, sources: Sequence[PlacedSource], progress: Progress
) -> list[dict[str, Any]]:
    """The coarse stage alone: every sub-map is a block."""
    figures = []
    for number, source in enumerate(sources):
        progress(number / len(sources), f"appending sub-map {number + 1} of {len(sources)}")
        cloud = placed_gaussians(source)
        nothing = FineResult(iterations=0, converged=False, filled=0, pruned=0)
        figures.append(_figures(cloud, nothing, coarse=len(cloud), psnr=(None, None), views=0))
        parts.finish(number, cloud, figures[-1])
    return figures


def _refine_block(
    number: int,
    blocks: Sequence[Block],
    parts: Parts,
    sources: Sequence[PlacedSource],
    config: MergeConfig,
    progress: Progress,
) -> dict[str, Any]:
    block = blocks[number]

    def within(share: float, text: str) -> None:
        named = f"block {number + 1} of {len(blocks)}: {text}" if len(blocks) > 1 else text
        progress((number + share) / len(blocks), named)

    within(0.0, "appending sub-maps")
    views = [view_of(sources[place.source], place.keyframe) for place in block.views]
    judged = _spread(views, _JUDGED_VIEWS)
    coarse, own = _coarse_of(block, blocks[:number], parts, sources)
    before = mean_psnr(optimiser_of(coarse, config), judged)
    taken_up = parts.resumed(number)
    cloud, done = (coarse, 0) if taken_up is None else (taken_up[0], int(taken_up[1]["done"]))
    optimiser = optimiser_of(cloud, config)
    del coarse, cloud
    stage = FineStage(
        optimiser,
        views,
        config,
        progress=within,
        checkpoint=lambda cloud, done: parts.checkpoint(number, cloud, {"done": done}),
        done=done,
    )
    result = stage.run()
    after = mean_psnr(optimiser, judged)
    refined = optimiser.gaussians()
    refined = refined.select(block.holds(refined.means))
    figures = _figures(refined, result, coarse=own, psnr=(before, after), views=len(views))
    parts.finish(number, refined, figures)
    return figures


def _coarse_of(
    block: Block, done: Sequence[Block], parts: Parts, sources: Sequence[PlacedSource]
) -> tuple[GaussianCloud, int]:
    """The Gaussians that a block's keyframes may show, and how many of them are its own.

    Neighbours that are done are taken as refined, the others as their agents sent them.
    """
    low, high = block.surroundings()
    chosen: list[GaussianCloud] = []
    own = 0
    for source in sources:
        cloud = placed_gaussians(source)
        inside = block.holds(cloud.means)
        near = _between(cloud.means, low, high)
        for earlier in done:
            near &= ~earlier.holds(cloud.means)
        own += int(inside.sum())
        chosen.append(cloud.select(inside | near))
    for number in range(len(done)):
        cloud = parts.cloud(number)
        chosen.append(cloud.select(_between(cloud.means, low, high)))
    return in_morton_order(GaussianCloud.concatenate(chosen)), own


def _between(points: NDArray, low: NDArray, high: NDArray) -> NDArray[np.bool_]:
    """(n,) which points (n, 3) lie in a box."""
    return np.asarray(((points >= low) & (points <= high)).all(axis=1))


def optimiser_of(cloud: GaussianCloud, config: MergeConfig) -> Optimiser:
    """An optimiser with a merge's losses and first learning rates."""
    return new_optimiser(
        cloud,
        weights=LossWeights(
            ssim=config.ssim_weight,
            depth=config.depth_weight,
            scale=config.regularisation_weight,
        ),
        learning_rates=rates(config, 0.0),
        threads=config.threads or None,
        device=config.device,
    )


def _figures(
    cloud: GaussianCloud,
    result: FineResult,
    *,
    coarse: int,
    psnr: tuple[float | None, float | None],
    views: int,
) -> dict[str, Any]:
    return {
        "gaussians": len(cloud),
        "coarse": coarse,
        "iterations": result.iterations,
        "converged": result.converged,
        "filled": result.filled,
        "pruned": result.pruned,
        "psnr_coarse_db": psnr[0],
        "psnr_fine_db": psnr[1],
        "views": views,
    }


def _summary(figures: Sequence[dict[str, Any]], seconds: float) -> MergeSummary:
    def total(name: str) -> int:
        return sum(int(item[name]) for item in figures)

    def mean(name: str) -> float:
        known = [(item[name], item["views"]) for item in figures if item[name] is not None]
        weights = [weight for _, weight in known]
        return float(np.average([v for v, _ in known], weights=weights)) if known else float("nan")

    return MergeSummary(
        gaussians=total("gaussians"),
        blocks=len(figures),
        iterations=total("iterations"),
        seconds=seconds,
        converged=all(item["converged"] for item in figures),
        psnr_coarse_db=mean("psnr_coarse_db"),
        psnr_fine_db=mean("psnr_fine_db"),
        coarse_gaussians=total("coarse"),
        filled=total("filled"),
        pruned=total("pruned"),
    )


def _spread(views: Sequence[View], count: int) -> list[View]:
    """At most `count` views, evenly spread."""
    chosen = np.linspace(0, len(views) - 1, min(count, len(views)))
    return [views[round(i)] for i in chosen]
