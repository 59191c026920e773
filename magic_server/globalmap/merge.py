"""The global map: sub-maps appended, then refined from their keyframes, block by block.

Paper, "Global Map Construction": a coarse stage that appends, and a fine stage that optimises with
the mapping losses and removes what turned transparent. Memory holds one block at a time.
"""

from __future__ import annotations

import dataclasses
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from magic_core.errors import InvalidInput
from magic_core.gaussians import GaussianCloud
from magic_core.gaussians.morton import in_morton_order
from magic_core.render import LossWeights
from magic_core.render.backend import Optimiser, new_optimiser
from magic_server.globalmap.blocks import REFINED, Block, blocks_near, places_of, plan_blocks
from magic_server.globalmap.config import MergeConfig
from magic_server.globalmap.parts import Parts, fingerprint_of
from magic_server.globalmap.placement import (
    PlacedSource,
    View,
    placed_gaussians,
    view_of,
)
from magic_server.globalmap.quality import mean_psnr
from magic_server.globalmap.refine import FineResult, FineStage, budget_of, rates

Progress = Callable[[float, str], None]

_TOUCHED = 0.4
"""Share of the schedule, its last, that a block goes through once more beside refined neighbours:
0.2 gains 0.03 dB at the borders, 0.4 0.24 dB (benchmarks/results/global-map.md)."""
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
        parts, figures = _in_blocks(blocks, parts, sources, config, progress)
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


def _in_blocks(
    blocks: Sequence[Block],
    parts: Parts,
    sources: Sequence[PlacedSource],
    config: MergeConfig,
    progress: Progress,
) -> tuple[Parts, list[dict[str, Any]]]:
    """Each block refined by itself, then, where there are several, once more beside the others."""
    numbers = range(len(blocks))
    if len(blocks) == 1:
        return parts, [refine_block(blocks[0], parts, sources, config, progress=progress)]

    def part(number: int, first: float, last: float, name: str) -> Progress:
        def within(share: float, text: str) -> None:
            done = first + (last - first) * (number + share) / len(blocks)
            progress(done, f"{name} {number + 1} of {len(blocks)}: {text}")

        return within

    apart = [
        refine_block(
            blocks[number], parts, sources, config, number=number,
            progress=part(number, 0.0, REFINED, "block"),
        )
        for number in numbers
    ]  # fmt: skip
    touched = parts.beside("touched")
    together = [
        touch_up(
            blocks[number], parts.cloud(number),
            (parts.cloud(other) for other in blocks_near(blocks, number)),
            touched, sources, config, number=number,
            progress=part(number, REFINED, 1.0, "border of block"),
        )
        for number in numbers
    ]  # fmt: skip
    return touched, [_both(*pair) for pair in zip(apart, together, strict=True)]


def _both(apart: dict[str, Any], together: dict[str, Any]) -> dict[str, Any]:
    """The figures of a block over both rounds."""
    sums = {name: apart[name] + together[name] for name in ("iterations", "pruned")}
    last = {name: together[name] for name in ("gaussians", "psnr_fine_db")}
    return {**apart, **sums, **last}


def refine_block(
    block: Block,
    parts: Parts,
    sources: Sequence[PlacedSource],
    config: MergeConfig,
    *,
    number: int = 0,
    progress: Progress,
) -> dict[str, Any]:
    """Refine one block by itself and keep it in `parts`; its figures, at once where it is there."""
    if (finished := parts.finished(number)) is not None:
        return finished
    progress(0.0, "appending sub-maps")
    views = [view_of(sources[view.source], view.keyframe) for view in block.views]
    judged = _spread(views, _JUDGED_VIEWS)
    coarse, own = _coarse_of(block, sources)
    before = mean_psnr(optimiser_of(coarse, config), judged)
    taken_up = parts.resumed(number)
    cloud, done = (coarse, 0) if taken_up is None else (taken_up[0], int(taken_up[1]["done"]))
    optimiser = optimiser_of(cloud, config)
    del coarse, cloud
    stage = FineStage(
        optimiser,
        views,
        config,
        progress=progress,
        checkpoint=lambda cloud, done: parts.checkpoint(number, cloud, {"done": done}),
        done=done,
    )
    result = stage.run()
    psnr = (before, mean_psnr(optimiser, judged))
    refined = _own_of(block, optimiser)
    figures = _figures(refined, result, coarse=own, psnr=psnr, views=len(views))
    parts.finish(number, refined, figures)
    return figures


def touch_up(
    block: Block,
    own: GaussianCloud,
    neighbours: Iterable[GaussianCloud],
    parts: Parts,
    sources: Sequence[PlacedSource],
    config: MergeConfig,
    *,
    number: int = 0,
    progress: Progress,
) -> dict[str, Any]:
    """Run the last part of a refined block's schedule once more, beside refined neighbours.

    Each block was refined beside neighbours as they were sent, which are no longer there. All
    blocks see the others as of the first round, so that the order changes nothing.
    """
    if (finished := parts.finished(number)) is not None:
        return finished
    progress(0.0, "refining beside its neighbours")
    views = [view_of(sources[view.source], view.keyframe) for view in block.views]
    near = [cloud.select(block.wants(cloud.means)) for cloud in neighbours]
    optimiser = optimiser_of(in_morton_order(GaussianCloud.concatenate([own, *near])), config)
    del near
    budget = budget_of(views, config)
    begun = budget - int(_TOUCHED * budget)
    stage = FineStage(optimiser, views, config, progress=progress, done=begun)
    result = stage.run()
    result = dataclasses.replace(result, iterations=result.iterations - begun)
    psnr = (None, mean_psnr(optimiser, _spread(views, _JUDGED_VIEWS)))
    refined = _own_of(block, optimiser)
    figures = _figures(refined, result, coarse=len(own), psnr=psnr, views=len(views))
    parts.finish(number, refined, figures)
    return figures


def _own_of(block: Block, optimiser: Optimiser) -> GaussianCloud:
    """What is kept of a refined block: its neighbours keep the rest."""
    refined = optimiser.gaussians()
    return refined.select(block.holds(refined.means))


def _coarse_of(block: Block, sources: Sequence[PlacedSource]) -> tuple[GaussianCloud, int]:
    """The Gaussians that a block's keyframes may show, and how many of them are its own.

    All as their agents sent them, its neighbours' too: no block waits for another, and the map does
    not depend on the order in which they are refined.
    """
    chosen: list[GaussianCloud] = []
    own = 0
    for source in sources:
        cloud = placed_gaussians(source)
        own += int(block.holds(cloud.means).sum())
        chosen.append(cloud.select(block.wants(cloud.means)))
    return in_morton_order(GaussianCloud.concatenate(chosen)), own


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
