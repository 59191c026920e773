"""The fine stage: fill what is missing, optimise from the keyframes, drop what is superfluous.

Paper, "Global Map Construction": the mapping losses again, over all sub-maps' keyframes, and
pruning. The paper takes 3,000 steps on keyframes at random; here keyframes take turns by the space
they see, duplicates of overlapping sub-maps go half way, and it can end once the loss settles.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from magic_core.render import GaussianOptimiser, LearningRates, Rasteriser
from magic_server.globalmap.config import MergeConfig
from magic_server.globalmap.contribution import best_contribution
from magic_server.globalmap.fill import fill_measured, fill_unmeasured
from magic_server.globalmap.placement import View
from magic_server.globalmap.sampling import VisitOrder, region_weights

Progress = Callable[[float, str], None]

_MIN_STEPS_PER_PASS = 60
_DEDUPLICATE_AT = 0.5  # share of the budget after which duplicates go, unless the loss settled
_HIDDEN_SHARE = 0.1  # of min_contribution: what appended sub-maps lose before any optimisation


@dataclass(frozen=True, slots=True)
class FineResult:
    """What the fine stage did."""

    iterations: int
    converged: bool
    """Whether it stopped because the loss had settled."""
    filled: int
    pruned: int


class FineStage:
    """Refines the cloud that an optimiser holds."""

    def __init__(
        self,
        optimiser: GaussianOptimiser,
        views: Sequence[View],
        config: MergeConfig,
        *,
        progress: Progress,
    ) -> None:
        self._optimiser, self._views, self._config = optimiser, views, config
        self._progress = progress
        self._order = VisitOrder(region_weights(views), np.random.default_rng(config.seed))
        self._last_loss = np.full(len(views), np.nan)
        self._steps_per_pass = max(len(views), _MIN_STEPS_PER_PASS)
        self._budget = min(config.iterations, config.passes * self._steps_per_pass)

    def run(self) -> FineResult:
        """Fill, optimise and prune until the loss settles or the budget is spent."""
        pruned = self._prune_unseen(_HIDDEN_SHARE * self._config.min_contribution, share=0.01)
        filled = self._fill()
        done, deduplicated, converged = 0, False, False
        while done < self._budget and not converged:
            steps = min(self._steps_per_pass, self._budget - done)
            loss, gain = self._pass(steps, done)
            done += steps
            pruned += self._prune_faded()
            self._progress(self._share(done), f"refined {done} of {self._budget} steps: {loss:.4f}")
            settled = self._config.converged > 0.0 and gain < self._config.converged
            converged = settled and deduplicated
            if not deduplicated and (settled or done >= _DEDUPLICATE_AT * self._budget):
                pruned += self._prune_unseen(self._config.min_contribution, share=self._share(done))
                # The loss rises for a moment: it has to settle anew.
                deduplicated = True
                self._last_loss[:] = np.nan
        return FineResult(done, converged, filled, pruned)

    def _share(self, done: int) -> float:
        return 0.1 + 0.88 * done / max(self._budget, 1)

    def _pass(self, steps: int, done: int) -> tuple[float, float]:
        """Mean loss of `steps` steps, and the mean share by which a view's loss fell since its
        last visit (infinite while most views have not been visited twice). Views differ more
        than passes do, so only a view's own loss tells whether the map still gets better."""
        self._optimiser.learning_rates = rates(self._config, done / max(self._budget, 1))
        losses, gains = [], []
        for _ in range(steps):
            index = self._order.next()
            view = self._views[index]
            loss = self._optimiser.step(
                view.camera, view.world_from_camera, view.colour, view.depth
            ).loss
            if np.isfinite(self._last_loss[index]):
                gains.append(1.0 - loss / max(self._last_loss[index], 1e-12))
            self._last_loss[index] = loss
            losses.append(loss)
        known = len(gains) >= 0.5 * steps
        return float(np.mean(losses)), float(np.mean(gains)) if known else float("inf")

    def _fill(self) -> int:
        limits = {
            "alpha_threshold": self._config.alpha_threshold,
            "limit": self._config.max_gaussians,
        }
        filled = 0
        if self._config.fill:
            self._progress(0.03, "filling holes")
            filled += fill_measured(self._optimiser, self._views, **limits)
        if self._config.fill_unmeasured:
            self._progress(0.06, "filling what has no depth")
            filled += fill_unmeasured(self._optimiser, self._views, **limits)
        return filled

    def _prune_faded(self) -> int:
        return self._keep(self._optimiser.gaussians().opacities >= self._config.prune_opacity)

    def _prune_unseen(self, least: float, *, share: float) -> int:
        """Remove what no keyframe shows: duplicates of overlapping sub-maps, hidden leftovers."""
        if self._config.min_contribution <= 0.0:
            return 0
        self._progress(share, "removing what no keyframe shows")
        rasteriser = Rasteriser(self._config.threads or None)
        cloud = self._optimiser.gaussians()
        return self._keep(best_contribution(cloud, self._views, rasteriser=rasteriser) > least)

    def _keep(self, mask: np.ndarray) -> int:
        if not mask.all():
            self._optimiser.prune(mask)
        return int((~mask).sum())


def rates(config: MergeConfig, progress: float) -> LearningRates:
    """The learning rates after a share of the budget: they fall exponentially."""
    share = config.final_rate**progress
    base = LearningRates(means=config.means_rate_m)
    return LearningRates(*(share * getattr(base, f.name) for f in dataclasses.fields(base)))
