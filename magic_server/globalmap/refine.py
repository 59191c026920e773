"""The fine stage: drop duplicates, fill what is missing, optimise from the keyframes.

Paper, "Global Map Construction": the mapping losses again, over all sub-maps' keyframes, and
pruning. The paper takes 3,000 steps on keyframes at random; here duplicates of overlapping sub-maps
go first, keyframes take turns by the space they see, learning rates begin high and fall, and it
ends once the keyframes' losses fall no further.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from magic_core.gaussians import GaussianCloud
from magic_core.render import LearningRates, Rasteriser
from magic_core.render.backend import Optimiser
from magic_server.globalmap.config import MergeConfig
from magic_server.globalmap.contribution import Survey, survey
from magic_server.globalmap.exposure import ExposureModel
from magic_server.globalmap.fill import FillRule, fill_holes
from magic_server.globalmap.placement import View
from magic_server.globalmap.sampling import VisitOrder, region_weights

Progress = Callable[[float, str], None]
Checkpoint = Callable[[GaussianCloud, int], None]

_MIN_STEPS_PER_PASS = 60
_SETTLED_PASSES = 2  # so many passes in a row must gain little
_CHECKPOINT_S = 20.0
_AGAIN_AT = 0.15  # share of the budget after which duplicates go once more
_PREPARED = 0.1  # share of the progress that preparing takes
# Several times those of 3DGS, which are made for tens of thousands of steps: here there are few,
# each on a whole image of a map that is nearly right.
_START = LearningRates(quaternions=1.2e-2, scales=3e-2, opacities=5e-2, colours=2e-2)


@dataclass(frozen=True, slots=True)
class FineResult:
    """What the fine stage did."""

    iterations: int
    converged: bool
    """Whether it stopped because the losses had settled."""
    filled: int
    pruned: int


class FineStage:
    """Refines the cloud that an optimiser holds."""

    def __init__(
        self,
        optimiser: Optimiser,
        views: Sequence[View],
        config: MergeConfig,
        *,
        progress: Progress,
        checkpoint: Checkpoint | None = None,
        done: int = 0,
        until: float = 1.0,
        remove: bool = True,
        after_pass: Callable[[int], bool] | None = None,
    ) -> None:
        """`checkpoint` is given the cloud and the steps done every 20 s or so; a stage that begins
        at `done` steps takes such a cloud up. `until`: share of the schedule at which it ends.
        Without `remove` the Gaussians stay the same ones in their order. `after_pass` hears the
        steps done and may end it."""
        self._optimiser, self._views, self._config = optimiser, views, config
        self._progress, self._checkpoint, self._done = progress, checkpoint, done
        self._remove, self._after_pass = remove, after_pass
        self._order = VisitOrder(region_weights(views), np.random.default_rng(config.seed))
        self._last_loss = np.full(len(views), np.nan)
        self._exposure = ExposureModel(len(views)) if config.exposure else None
        self._steps_per_pass = max(len(views), _MIN_STEPS_PER_PASS)
        self._budget = budget_of(views, config)
        self._first, self._last = done, round(until * self._budget)

    def run(self) -> FineResult:
        """Prune, fill and optimise until the losses settle or the budget is spent."""
        pruned = filled = 0
        if not self._done and self._remove:
            pruned, filled = self._prepare()
        settled, saved = 0, time.monotonic()
        once_more = self._remove and self._done < _AGAIN_AT * self._budget
        while self._done < self._last and settled < _SETTLED_PASSES:
            loss, gain = self._pass(min(self._steps_per_pass, self._last - self._done))
            pruned += self._prune_faded()
            spent = (self._done - self._first) / (self._last - self._first)
            share = _PREPARED + (0.98 - _PREPARED) * spent
            self._progress(share, f"refined {self._done} of {self._budget} steps: {loss:.4f}")
            settled = settled + 1 if gain < self._config.converged else 0
            if self._checkpoint is not None and time.monotonic() - saved > _CHECKPOINT_S:
                self._checkpoint(self._optimiser.gaussians(), self._done)
                saved = time.monotonic()
            if once_more and self._done >= _AGAIN_AT * self._budget:
                pruned, once_more = pruned + self._prune_unseen(share), False
                self._last_loss[:] = np.nan  # the losses rise for a moment and have to settle anew
            if self._after_pass is not None and self._after_pass(self._done):
                break
        return FineResult(self._done, settled >= _SETTLED_PASSES, filled, pruned)

    def _pass(self, steps: int) -> tuple[float, float]:
        """Mean loss of `steps` steps, and the mean share by which a view's loss fell since its
        last visit (infinite while most views have not been visited twice). Views differ more
        than passes do, so only a view's own loss tells whether the map still gets better."""
        losses, gains = [], []
        for _ in range(steps):
            self._optimiser.learning_rates = rates(self._config, self._done / self._budget)
            index = self._order.next()
            loss = self._step(index)
            if np.isfinite(self._last_loss[index]):
                gains.append(1.0 - loss / max(self._last_loss[index], 1e-12))
            self._last_loss[index] = loss
            losses.append(loss)
            self._done += 1
        if self._exposure is not None:
            self._exposure.centre()
        known = len(gains) >= 0.5 * steps
        return float(np.mean(losses)), float(np.mean(gains)) if known else float("inf")

    def _step(self, index: int) -> float:
        view, colour = self._views[index], self._views[index].colour
        if self._exposure is not None:
            shown = self._optimiser.render(view.camera, view.world_from_camera)
            self._exposure.fit(index, view, shown.colour, shown.alpha)
            colour = self._exposure.undone(index, colour)
        return self._optimiser.step(view.camera, view.world_from_camera, colour, view.depth).loss

    def _prepare(self) -> tuple[int, int]:
        """Remove what no keyframe shows, then fill what the keyframes lack; how many each.

        Removing comes first, since all that follows takes time in proportion to the Gaussians.
        """
        rule = FillRule(
            measured=self._config.fill,
            unmeasured=self._config.fill_unmeasured,
            alpha_threshold=self._config.alpha_threshold,
            limit=self._config.max_gaussians,
        )
        found = self._survey(0.01, rule)
        pruned = self._keep(self._shown(found))
        self._progress(0.06, "filling holes")
        return pruned, fill_holes(self._optimiser, self._views, found.lacking, rule=rule)

    def _survey(self, share: float, rule: FillRule | None = None) -> Survey:
        self._progress(share, "looking for what no keyframe shows")
        return survey(
            self._optimiser.gaussians(),
            self._views,
            rasteriser=Rasteriser(self._config.threads or None),
            lacks=None if rule is None else rule.lacks,
        )

    def _prune_faded(self) -> int:
        if not self._remove:
            return 0
        return self._keep(self._optimiser.gaussians().opacities >= self._config.prune_opacity)

    def _prune_unseen(self, share: float) -> int:
        """Remove once more what no keyframe shows, after layers of equal rank have sorted out
        which of them does."""
        if self._config.min_contribution <= 0.0:
            return 0
        return self._keep(self._shown(self._survey(share)))

    def _shown(self, found: Survey) -> np.ndarray:
        """(n,) which Gaussians show in any keyframe; all where none is to be removed."""
        least = self._config.min_contribution
        return found.best > least if least > 0.0 else np.ones(len(found.best), dtype=bool)

    def _keep(self, mask: np.ndarray) -> int:
        if not mask.all():
            self._optimiser.prune(mask)
        return int((~mask).sum())


def budget_of(views: Sequence[View], config: MergeConfig) -> int:
    """Most optimisation steps on these keyframes; steps on parts of them count as parts."""
    share = float(np.mean([view.share for view in views])) if views else 1.0
    most = config.passes * max(len(views), _MIN_STEPS_PER_PASS)
    return min(round(config.iterations / share), most)


def rates(config: MergeConfig, progress: float) -> LearningRates:
    """The learning rates after a share of the budget: they fall in a straight line."""
    share = 1.0 + (config.final_rate - 1.0) * progress
    start = dataclasses.replace(_START, means=config.means_rate_m)
    return LearningRates(*(share * getattr(start, f.name) for f in dataclasses.fields(start)))
