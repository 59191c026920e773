"""The global map: sub-maps appended, then refined from their keyframes, block by block.

Paper, "Global Map Construction": a coarse stage that appends, and a fine stage that optimises with
the mapping losses and removes what turned transparent. Memory holds one block at a time.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from magic_core.errors import InvalidInput
from magic_core.gaussians import GaussianCloud
from magic_server.globalmap import rounds
from magic_server.globalmap.blocks import (
    ROUNDS,
    Block,
    Neighbours,
    places_of,
    plan_blocks,
)
from magic_server.globalmap.config import MergeConfig
from magic_server.globalmap.parts import Parts, fingerprint_of
from magic_server.globalmap.placement import PlacedSource, placed_gaussians
from magic_server.globalmap.refine import FineResult

Progress = Callable[[float, str], None]


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
    folder: Path,
    sources: Sequence[PlacedSource],
    config: MergeConfig,
    *,
    progress: Progress,
    saved: Callable[[], None] = lambda: None,
) -> tuple[Parts, MergeSummary]:
    """Merge into block files in a folder; goes on where an earlier call with it was cut off.

    `saved` hears of every checkpoint.
    """
    config.validate()
    if not sources:
        raise InvalidInput.field("submaps", "none given; a map needs at least one sub-map")
    started = time.perf_counter()
    parts = Parts(folder, fingerprint_of(sources, config), saved=saved)
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
        figures.append(
            rounds.figures_of(cloud, nothing, coarse=len(cloud), psnr=(None, None), views=0)
        )
        parts.finish(number, cloud, figures[-1])
    return figures


def _in_blocks(
    blocks: Sequence[Block],
    parts: Parts,
    sources: Sequence[PlacedSource],
    config: MergeConfig,
    progress: Progress,
) -> tuple[Parts, list[dict[str, Any]]]:
    """Each block refined by itself, then, where there are several, beside the others."""
    if len(blocks) == 1:
        return parts, [rounds.refine_alone(blocks[0], parts, sources, config, progress=progress)]

    def part(number: int, span: tuple[float, float], name: str) -> Progress:
        def within(share: float, text: str) -> None:
            done = span[0] + (span[1] - span[0]) * (number + share) / len(blocks)
            progress(done, f"{name} {number + 1} of {len(blocks)}: {text}")

        return within

    numbers = range(len(blocks))
    first, *others = ROUNDS
    figures = [
        rounds.refine_alone(
            blocks[number], parts, sources, config, number=number, until=first[1],
            progress=part(number, first, "block"),
        )
        for number in numbers
    ]  # fmt: skip
    neighbours = Neighbours(blocks)
    for count, span in enumerate(others, start=1):
        made = parts.beside(f"round-{count}")
        for number in numbers:
            around = _agreed(neighbours, parts, [number, *neighbours.near(number)])
            found = rounds.refine_beside(
                blocks[number], around, made, sources, config, number=number, span=span,
                progress=part(number, span, "border of block"),
            )  # fmt: skip
            figures[number] = _both(figures[number], found)
        parts = made
    joined = parts.beside("joined")
    for number in numbers:
        ((_, cloud),) = _agreed(neighbours, parts, [number])
        shown = rounds.visible(cloud, config)
        faded = figures[number]["pruned"] + len(cloud) - len(shown)
        figures[number] |= {"gaussians": len(shown), "pruned": faded}
        joined.finish(number, shown, figures[number])
    return joined, figures


def _agreed(
    neighbours: Neighbours, parts: Parts, numbers: Sequence[int]
) -> Iterator[tuple[int, GaussianCloud]]:
    """Blocks as all agreed on them after the round that `parts` holds."""
    others = neighbours.showing(numbers)
    handed = (guest for other in others for guest in parts.guests(other, owners=numbers))
    return rounds.agreed_blocks(numbers, parts.cloud, handed)


def _both(before: dict[str, Any], further: dict[str, Any]) -> dict[str, Any]:
    """The figures of a block over its rounds so far and a further one."""
    sums = {name: before[name] + further[name] for name in ("iterations", "pruned")}
    last = {name: further[name] for name in ("gaussians", "psnr_fine_db", "converged")}
    return {**before, **sums, **last}


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
