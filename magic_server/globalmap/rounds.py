"""The rounds in which a merge's blocks are refined: first each by itself, then beside the others.

In the first, a block sees its surroundings as they were sent. In each that follows it sees them as
all blocks agreed on them (consensus.py), and hands over what it made of them. Within a round no
block waits for another, and their order changes nothing. A map of one block takes one round.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magic_core.gaussians import GaussianCloud
from magic_core.gaussians.morton import in_morton_order, morton_order
from magic_core.render import LossWeights
from magic_core.render.backend import Optimiser, new_optimiser
from magic_server.globalmap.blocks import Block
from magic_server.globalmap.config import MergeConfig
from magic_server.globalmap.consensus import Guests, agreed, guests_of
from magic_server.globalmap.parts import Parts
from magic_server.globalmap.placement import PlacedSource, View, placed_gaussians, view_of
from magic_server.globalmap.quality import mean_psnr
from magic_server.globalmap.refine import FineResult, FineStage, budget_of, rates

Progress = Callable[[float, str], None]
Figures = dict[str, Any]

_JUDGED_VIEWS = 24  # keyframes of a block on which the merge reports its own quality


def refine_alone(
    block: Block,
    parts: Parts,
    sources: Sequence[PlacedSource],
    config: MergeConfig,
    *,
    number: int = 0,
    until: float = 1.0,
    progress: Progress,
) -> Figures:
    """Refine one block by itself and keep it in `parts`; its figures, at once where it is there.

    `until`: the share of the schedule at which it ends.
    """
    if (finished := parts.finished(number)) is not None:
        return finished
    progress(0.0, "appending sub-maps")
    views = _views_of(block, sources)
    judged = _spread(views, _JUDGED_VIEWS)
    coarse, own = _coarse_of(block, sources)
    before = mean_psnr(optimiser_of(coarse, config), judged)
    cloud, done = _taken_up(parts, number) or (coarse, 0)
    optimiser = optimiser_of(cloud, config)
    del coarse, cloud
    stage = FineStage(
        optimiser, views, config, progress=progress, checkpoint=_checkpoint(parts, number),
        done=done, until=until,
    )  # fmt: skip
    result = stage.run()
    refined = optimiser.gaussians()
    refined = refined.select(block.holds(refined.means))  # its neighbours keep the rest
    psnr = (before, mean_psnr(optimiser, judged))
    figures = figures_of(refined, result, coarse=own, psnr=psnr, views=len(views))
    parts.finish(number, refined, figures)
    return figures


def refine_beside(
    block: Block,
    around: Iterable[tuple[int, GaussianCloud]],
    parts: Parts,
    sources: Sequence[PlacedSource],
    config: MergeConfig,
    *,
    number: int,
    span: tuple[float, float],
    progress: Progress,
) -> Figures:
    """Refine a block beside others through a span of the schedule, and keep what it made.

    `around` gives the agreed Gaussians of this block, by its number, and of those near it; they are
    taken one block after the other, so that memory holds what is wanted of each.
    """
    if (finished := parts.finished(number)) is not None:
        return finished
    progress(0.0, "refining beside its neighbours")
    views = _views_of(block, sources)
    places: dict[int, NDArray[np.intp]] = {}
    before: dict[int, GaussianCloud] = {}
    for owner, cloud in around:
        chosen = np.arange(len(cloud)) if owner == number else _wanted(block, cloud)
        places[owner], before[owner] = chosen, cloud.select(chosen)
    begin = GaussianCloud.concatenate(list(before.values()))
    order = morton_order(begin)
    begun = round(span[0] * budget_of(views, config))
    cloud, done = _taken_up(parts, number) or (begin.select(order), begun)
    optimiser = optimiser_of(cloud, config)
    del begin, cloud
    stage = FineStage(
        optimiser, views, config, progress=progress, checkpoint=_checkpoint(parts, number),
        done=done, until=span[1], remove=False,
    )  # fmt: skip
    result = stage.run()
    result = dataclasses.replace(result, iterations=result.iterations - begun)
    after = _apart(optimiser.gaussians().select(np.argsort(order)), places)
    guests = [
        guests_of(block, before[owner], after[owner], owner=owner, places=chosen)
        for owner, chosen in places.items()
        if owner != number and len(chosen)
    ]
    psnr = (None, mean_psnr(optimiser, _spread(views, _JUDGED_VIEWS)))
    own = after[number]
    figures = figures_of(own, result, coarse=len(own), psnr=psnr, views=len(views))
    parts.finish(number, own, figures, guests=guests)
    return figures


def agreed_blocks(
    numbers: Sequence[int],
    own: Callable[[int], GaussianCloud],
    handed: Iterable[Guests],
) -> Iterator[tuple[int, GaussianCloud]]:
    """Blocks as all agree on them after a round, one at a time.

    `own` gives what a block made of its own Gaussians, `handed` what others made of them.
    """
    guests: dict[int, list[Guests]] = {number: [] for number in numbers}
    for guest in handed:
        guests[guest.owner].append(guest)
    for number in numbers:
        yield number, agreed(own(number), guests[number])


def visible(cloud: GaussianCloud, config: MergeConfig) -> GaussianCloud:
    """Without those that faded, which stay to the end of the rounds so that indices hold."""
    return cloud.select(cloud.opacities >= config.prune_opacity)


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


def figures_of(
    cloud: GaussianCloud,
    result: FineResult,
    *,
    coarse: int,
    psnr: tuple[float | None, float | None],
    views: int,
) -> Figures:
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


def _views_of(block: Block, sources: Sequence[PlacedSource]) -> list[View]:
    views = []
    for chosen in block.views:
        view = view_of(sources[chosen.source], chosen.keyframe)
        views.append(view if chosen.window is None else view.part(chosen.window))
    return views


def _wanted(block: Block, cloud: GaussianCloud) -> NDArray[np.intp]:
    return np.flatnonzero(block.wants(cloud.means))


def _apart(cloud: GaussianCloud, places: Mapping[int, NDArray]) -> dict[int, GaussianCloud]:
    """Gaussians by the block that they belong to; they come in the order of `places`."""
    ends = np.cumsum([len(chosen) for chosen in places.values()])
    pieces = np.split(np.arange(len(cloud)), ends[:-1])
    return {owner: cloud.select(piece) for owner, piece in zip(places, pieces, strict=True)}


def _taken_up(parts: Parts, number: int) -> tuple[GaussianCloud, int] | None:
    """The last checkpoint of a block and the steps done there, where there is one."""
    resumed = parts.resumed(number)
    return None if resumed is None else (resumed[0], int(resumed[1]["done"]))


def _checkpoint(parts: Parts, number: int) -> Callable[[GaussianCloud, int], None]:
    return lambda cloud, done: parts.checkpoint(number, cloud, {"done": done})


def _spread(views: Sequence[View], count: int) -> list[View]:
    """At most `count` views, evenly spread."""
    chosen = np.linspace(0, len(views) - 1, min(count, len(views)))
    return [views[round(i)] for i in chosen]
