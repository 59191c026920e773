"""The global map: sub-maps appended, then refined from their keyframes.

Paper, "Global Map Construction": a coarse stage that appends, and a fine stage that optimises with
the mapping losses and removes what turned transparent.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from magic_core.errors import InvalidInput
from magic_core.gaussians import GaussianCloud
from magic_core.render import GaussianOptimiser, LearningRates, LossWeights, Rasteriser
from magic_server.globalmap.config import MergeConfig
from magic_server.globalmap.contribution import best_contribution
from magic_server.globalmap.fill import fill_measured, fill_unmeasured
from magic_server.globalmap.placement import PlacedSubmap, View, coarse_merge, views_of
from magic_server.globalmap.quality import mean_psnr
from magic_server.globalmap.sampling import VisitOrder, region_weights

Progress = Callable[[float, str], None]

_PSNR_VIEWS = 24  # keyframes on which the merge reports its own quality


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
    """Mean PSNR on a spread of keyframes after the coarse stage; NaN without keyframes."""
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
    return _Merge(submaps, config, progress).run()


class _Merge:
    """One run of the merge; holds what its stages share."""

    def __init__(
        self, submaps: Sequence[PlacedSubmap], config: MergeConfig, progress: Progress
    ) -> None:
        self._config = config
        self._progress = progress
        self._views = views_of(submaps)
        self._cloud = coarse_merge(submaps)
        self._rng = np.random.default_rng(config.seed)
        spread = np.linspace(0, len(self._views) - 1, min(_PSNR_VIEWS, len(self._views)))
        self._judged = [self._views[round(i)] for i in spread]

    def run(self) -> GlobalMap:
        started = time.perf_counter()
        self._progress(0.0, "appending sub-maps")
        optimiser = self._optimiser()
        coarse_psnr = mean_psnr(optimiser, self._judged)
        filled = pruned = iterations = 0
        converged = False
        if self._config.refine:
            pruned += self._prune_hidden(optimiser, 0.01)
            filled = self._fill(optimiser)
            iterations, faded, converged = self._refine(optimiser)
            pruned += faded + self._prune_hidden(optimiser, 0.98)
        cloud = optimiser.gaussians()
        fine_psnr = mean_psnr(optimiser, self._judged)
        self._progress(1.0, f"merged {len(cloud)} Gaussians")
        return GlobalMap(
            cloud=cloud,
            iterations=iterations,
            seconds=time.perf_counter() - started,
            converged=converged,
            psnr_coarse_db=coarse_psnr,
            psnr_fine_db=fine_psnr,
            coarse_gaussians=len(self._cloud),
            filled=filled,
            pruned=pruned,
        )

    def _optimiser(self) -> GaussianOptimiser:
        return GaussianOptimiser(
            self._cloud,
            weights=LossWeights(
                ssim=self._config.ssim_weight,
                depth=self._config.depth_weight,
                scale=self._config.regularisation_weight,
            ),
            learning_rates=self._rates(0.0),
            threads=self._config.threads or None,
        )

    def _rates(self, progress: float) -> LearningRates:
        """The learning rates after a share of the budget: they fall exponentially."""
        share = self._config.final_rate**progress
        base = LearningRates(means=self._config.means_rate_m)
        return LearningRates(
            *(share * getattr(base, field.name) for field in dataclasses.fields(base))
        )

    def _fill(self, optimiser: GaussianOptimiser) -> int:
        filled = 0
        if self._config.fill:
            self._progress(0.02, "filling holes")
            filled += fill_measured(
                optimiser,
                self._views,
                alpha_threshold=self._config.alpha_threshold,
                limit=self._config.max_gaussians,
            )
        if self._config.fill_unmeasured:
            self._progress(0.06, "filling what has no depth")
            filled += fill_unmeasured(
                optimiser,
                self._views,
                alpha_threshold=self._config.alpha_threshold,
                limit=self._config.max_gaussians,
            )
        return filled

    def _refine(self, optimiser: GaussianOptimiser) -> tuple[int, int, bool]:
        """(iterations, pruned, converged): passes over the keyframes until the loss settles."""
        order = VisitOrder(region_weights(self._views), self._rng)
        done, pruned, previous = 0, 0, float("inf")
        while done < self._config.iterations:
            optimiser.learning_rates = self._rates(done / self._config.iterations)
            steps = min(max(len(self._views), 50), self._config.iterations - done)
            loss = float(np.mean([self._step(optimiser, order.next()) for _ in range(steps)]))
            done += steps
            pruned += self._prune(optimiser)
            self._report(done, loss)
            if previous - loss < self._config.converged * loss and done > 2 * steps:
                return done, pruned, True
            previous = loss
        return done, pruned, False

    def _step(self, optimiser: GaussianOptimiser, index: int) -> float:
        view: View = self._views[index]
        return optimiser.step(view.camera, view.world_from_camera, view.colour, view.depth).loss

    def _prune(self, optimiser: GaussianOptimiser) -> int:
        keep = optimiser.gaussians().opacities >= self._config.prune_opacity
        if not keep.all():
            optimiser.prune(keep)
        return int((~keep).sum())

    def _prune_hidden(self, optimiser: GaussianOptimiser, share: float) -> int:
        """Remove what no keyframe shows: duplicates of overlapping sub-maps, hidden leftovers."""
        if self._config.min_contribution <= 0.0 or not self._views:
            return 0
        self._progress(share, "removing what no keyframe shows")
        rasteriser = Rasteriser(self._config.threads or None)
        shown = best_contribution(optimiser.gaussians(), self._views, rasteriser=rasteriser)
        keep = shown >= self._config.min_contribution
        if not keep.all():
            optimiser.prune(keep)
        return int((~keep).sum())

    def _report(self, done: int, loss: float) -> None:
        share = 0.1 + 0.88 * done / max(self._config.iterations, 1)
        self._progress(
            share, f"refining, step {done} of at most {self._config.iterations}: {loss:.4f}"
        )
