"""The global map: sub-maps appended, then refined from their keyframes.

Paper, "Global Map Construction": a coarse stage that appends, and a fine stage that optimises with
the mapping losses and removes what turned transparent.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from magic_core.errors import InvalidInput
from magic_core.gaussians import GaussianCloud
from magic_core.render import GaussianOptimiser, LossWeights
from magic_server.globalmap.config import MergeConfig
from magic_server.globalmap.placement import PlacedSubmap, View, coarse_merge, views_of
from magic_server.globalmap.quality import mean_psnr
from magic_server.globalmap.refine import FineResult, FineStage, rates

Progress = Callable[[float, str], None]

_JUDGED_VIEWS = 24  # keyframes on which the merge reports its own quality


@dataclass(frozen=True, slots=True)
class GlobalMap:
    """One merged map in the world frame of its component, and what the merge did."""

    cloud: GaussianCloud
    iterations: int
    """Optimisation steps of the fine stage."""
    seconds: float
    converged: bool
    """Whether the fine stage stopped because it had settled, not because of its budget."""
    psnr_coarse_db: float
    """Mean PSNR on a spread of keyframes after the coarse stage."""
    psnr_fine_db: float
    """The same after the fine stage."""
    coarse_gaussians: int
    filled: int
    """Gaussians seeded where keyframes saw surface that no sub-map showed."""
    pruned: int


def build_global_map(
    submaps: Sequence[PlacedSubmap], config: MergeConfig, *, progress: Progress
) -> GlobalMap:
    """Merge placed sub-maps of one component; deterministic for a seed.

    `progress` hears a share from 0 to 1 and what is being done. Raises InvalidInput when there is
    nothing to merge.
    """
    config.validate()
    if not submaps:
        raise InvalidInput.field("submaps", "none given; a map needs at least one sub-map")
    started = time.perf_counter()
    progress(0.0, "appending sub-maps")
    coarse, views = coarse_merge(submaps), views_of(submaps)
    optimiser = _optimiser(coarse, config)
    judged = _spread(views, _JUDGED_VIEWS)
    coarse_psnr = mean_psnr(optimiser, judged)
    fine = FineResult(iterations=0, converged=False, filled=0, pruned=0)
    if config.refine and views:
        fine = FineStage(optimiser, views, config, progress=progress).run()
    fine_psnr = mean_psnr(optimiser, judged)
    cloud = optimiser.gaussians() if config.refine else coarse
    progress(1.0, f"merged {len(cloud)} Gaussians")
    return GlobalMap(
        cloud=cloud,
        iterations=fine.iterations,
        seconds=time.perf_counter() - started,
        converged=fine.converged,
        psnr_coarse_db=coarse_psnr,
        psnr_fine_db=fine_psnr,
        coarse_gaussians=len(coarse),
        filled=fine.filled,
        pruned=fine.pruned,
    )


def _optimiser(cloud: GaussianCloud, config: MergeConfig) -> GaussianOptimiser:
    return GaussianOptimiser(
        cloud,
        weights=LossWeights(
            ssim=config.ssim_weight,
            depth=config.depth_weight,
            scale=config.regularisation_weight,
        ),
        learning_rates=rates(config, 0.0),
        threads=config.threads or None,
    )


def _spread(views: Sequence[View], count: int) -> list[View]:
    """At most `count` views, evenly spread."""
    chosen = np.linspace(0, len(views) - 1, min(count, len(views)))
    return [views[round(i)] for i in chosen]
