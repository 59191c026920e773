"""The mapper of one agent: the active sub-map's Gaussians, its keyframes and their optimisation."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magic_agent.mapping.config import MappingConfig
from magic_agent.mapping.exposure import Exposure, exposure_of
from magic_agent.mapping.keyframes import Window, moved_enough
from magic_agent.mapping.seeder import Seeder
from magic_core.data import Frame
from magic_core.errors import WrongState
from magic_core.gaussians import GaussianCloud
from magic_core.gaussians.morton import in_morton_order
from magic_core.geometry import Camera, se3
from magic_core.render import LearningRates, LossWeights, RenderedView
from magic_core.render.backend import Optimiser, new_optimiser
from magic_core.submap import Keyframe

Pose = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class MappingBudget:
    """What mapping may spend on one keyframe; None leaves it to the schedule."""

    iterations: int | None = None
    """Optimisation steps at most, in place of the schedule's number."""
    seconds: float | None = None
    """Time at most, by the mapper's clock. Seeding and pruning always run; steps end with it."""
    least_iterations: int = 0
    """Steps that are taken even when the time is over."""

    @classmethod
    def within(cls, seconds: float | None, config: MappingConfig) -> MappingBudget:
        """The schedule's steps as far as the time allows; None is no limit."""
        if seconds is None:
            return _UNBOUNDED
        return cls(seconds=seconds, least_iterations=config.least_iterations)


@dataclass(frozen=True, slots=True)
class MappingReport:
    """What mapping did with one keyframe."""

    seeded: int
    pruned: int
    iterations: int
    cut_iterations: int
    """Steps of the schedule that the budget's time did not allow."""
    loss: float
    """Loss of the last step on this keyframe."""
    gaussians: int
    """Size of the sub-map afterwards."""
    duration_ms: float
    reexposed: bool = False
    """Whether the Gaussians carried over were brought to the exposure of a new anchor."""


@dataclass(frozen=True, slots=True)
class Closing:
    """What the steps that close a sub-map took."""

    iterations: int = 0
    cut_iterations: int = 0
    """Steps of the schedule that the budget's time did not allow."""
    seconds: float = 0.0

    def added_to(self, report: MappingReport) -> MappingReport:
        """The report of the keyframe that follows, with these steps in it."""
        return replace(
            report,
            iterations=report.iterations + self.iterations,
            cut_iterations=report.cut_iterations + self.cut_iterations,
            duration_ms=report.duration_ms + 1e3 * self.seconds,
        )


_UNBOUNDED = MappingBudget()
_THIN = 8
"""Every so many pixels of a keyframe tell which surface it covers."""


class Mapper:
    """Builds one sub-map at a time in the frame of its anchor (paper, "Mapping")."""

    def __init__(
        self,
        camera: Camera,
        config: MappingConfig | None = None,
        *,
        threads: int | None = None,
        seed: int = 0,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        """`clock` tells seconds; budgets and durations are measured with it."""
        self._camera = camera
        self._clock = clock
        self._config = (config or MappingConfig()).resolved()
        self._threads = threads
        self._rng = np.random.default_rng(seed)
        self._seeder = Seeder(camera, self._config, self._rng)
        self._keyframes: list[Keyframe] = []
        self._targets: list[Frame] = []
        self._median_depths: list[float] = []
        self._window = Window(self._config.newest_share, self._rng)
        self._optimiser: Optimiser | None = None
        self._overhead_s = self._step_s = 0.0

    @property
    def config(self) -> MappingConfig:
        """The settings in force, with the schedule's values put in."""
        return self._config

    @property
    def keyframes(self) -> tuple[Keyframe, ...]:
        """Keyframes of the active sub-map; the first is the anchor."""
        return tuple(self._keyframes)

    def __len__(self) -> int:
        return 0 if self._optimiser is None else len(self._optimiser)

    def gaussians(self) -> GaussianCloud:
        """The active sub-map, anchor frame."""
        return self._active().gaussians()

    def render(self, anchor_from_camera: Pose) -> RenderedView:
        """The active sub-map as seen from a pose."""
        return self._active().render(self._camera, anchor_from_camera)

    def begin(
        self,
        frame: Frame,
        *,
        carried: GaussianCloud | None = None,
        budget: MappingBudget = _UNBOUNDED,
    ) -> MappingReport:
        """Start a sub-map with this frame as anchor; carried Gaussians are in its frame."""
        self._keyframes, self._targets, self._median_depths = [], [], []
        self._window = Window(self._config.newest_share, self._rng)
        self._optimiser = self._new_optimiser(
            in_morton_order(carried) if carried is not None else GaussianCloud.empty()
        )
        reexposed = carried is not None and self._expose_as(frame)
        report = self.insert(frame, se3.identity(), budget=budget)
        return replace(report, reexposed=reexposed)

    @property
    def least_s(self) -> float:
        """Seconds below which a keyframe is not worth beginning: seeding, pruning and the least
        number of steps, as the last keyframe had them. Anchors tell what a step takes, but not
        what seeding does: theirs is of the whole image. 0 before the first anchor."""
        return self._overhead_s + self._config.least_iterations * self._step_s

    def lacks(
        self, frame: Frame, anchor_from_camera: Pose, *, view: RenderedView | None = None
    ) -> bool:
        """Whether the sub-map explains so little of a frame that tracking is at stake.

        view: the sub-map as rendered from about there; None renders it.
        """
        novelty = self._novelty(frame, anchor_from_camera, view)
        return novelty > self._config.keyframes.urgent_novelty

    def wants(
        self, frame: Frame, anchor_from_camera: Pose, *, view: RenderedView | None = None
    ) -> bool:
        """Whether this frame should become a keyframe; `view` as in `lacks`."""
        gap = frame.index - self._keyframes[-1].frame_index
        if self._config.keyframe_every > 0:
            return gap >= self._config.keyframe_every
        rule = self._config.keyframes
        if gap < rule.min_gap:
            return False
        return (
            gap >= rule.max_gap
            or moved_enough(
                self._keyframes[-1].anchor_from_camera,
                anchor_from_camera,
                median_depth=self._median_depths[-1],
                config=rule,
            )
            or self._novelty(frame, anchor_from_camera, view) > rule.novelty
        )

    def insert(
        self, frame: Frame, anchor_from_camera: Pose, *, budget: MappingBudget = _UNBOUNDED
    ) -> MappingReport:
        """Take a frame in as keyframe: seed, optimise, prune."""
        started = self._clock()
        view = self.render(anchor_from_camera) if len(self) else None
        original, frame = frame, self._in_the_maps_exposure(frame, view)
        seeded = self._seed(frame, anchor_from_camera, view)
        self._keyframes.append(
            Keyframe(
                frame.index, frame.timestamp_s, anchor_from_camera, original.colour, frame.depth
            )
        )
        self._targets.append(self._seeder.without_flying_pixels(frame))
        self._median_depths.append(_median_depth(frame))
        surface = self._surface(frame, anchor_from_camera)
        self._window.add(surface, depth_m=self._median_depths[-1])
        forgotten = self._window.make_room(self._config.max_keyframes)
        if forgotten is not None:
            for kept in (self._keyframes, self._targets, self._median_depths):
                del kept[forgotten]
        began = self._clock()
        iterations, cut, loss = self._optimise(budget, started)
        ended = self._clock()
        pruned = self._prune()
        duration_s = self._clock() - started
        if len(self._keyframes) > 1:
            self._overhead_s = duration_s - (ended - began)
        self._step_s = (ended - began) / max(iterations, 1)
        return MappingReport(seeded, pruned, iterations, cut, loss, len(self), 1e3 * duration_s)

    def close(self, *, budget: MappingBudget = _UNBOUNDED) -> Closing:
        """Take the closing steps, over all keyframes, before the sub-map is handed over."""
        wanted = budget.iterations
        if wanted is None:
            wanted = self._config.closing_iterations
        if wanted == 0:
            return Closing()
        started, done = self._clock(), 0
        deadline = math.inf if budget.seconds is None else started + budget.seconds
        while done < wanted and self._clock() < deadline:
            self._step(self._window.choose_any())
            done += 1
        self._prune()
        return Closing(done, wanted - done, self._clock() - started)

    def split(self, anchor_from_next: Pose) -> tuple[GaussianCloud, GaussianCloud]:
        """(sent, kept): what the next anchor cannot see; what it sees, moved to its frame.

        Every Gaussian is in exactly one of the two (paper, "Mapping").
        """
        gaussians = self.gaussians()
        visible = self.render(anchor_from_next).visible
        kept = gaussians.select(visible).transformed(se3.inverse(anchor_from_next))
        return gaussians.select(~visible), kept

    def _new_optimiser(self, gaussians: GaussianCloud) -> Optimiser:
        return new_optimiser(
            gaussians,
            weights=LossWeights(
                ssim=self._config.ssim_weight,
                depth=self._config.depth_weight,
                scale=self._config.regularisation_weight,
            ),
            learning_rates=LearningRates(means=self._config.means_rate_m),
            threads=self._threads,
            device=self._config.device,
        )

    def _exposure(self, frame: Frame, view: RenderedView | None) -> Exposure | None:
        """The exposure of a frame against the sub-map, if it has jumped."""
        if view is None or self._config.exposure_step <= 0.0:
            return None
        found = exposure_of(frame.colour, view.colour, view.alpha)
        jumped = found is not None and found.difference > self._config.exposure_step
        return found if jumped else None

    def _in_the_maps_exposure(self, frame: Frame, view: RenderedView | None) -> Frame:
        exposure = self._exposure(frame, view)
        return frame if exposure is None else replace(frame, colour=exposure.removed(frame.colour))

    def _expose_as(self, frame: Frame) -> bool:
        """Bring the carried Gaussians to the exposure of the new anchor, if that has jumped."""
        exposure = self._exposure(frame, self.render(se3.identity()))
        if exposure is None:
            return False
        gaussians = self.gaussians()
        self._optimiser = self._new_optimiser(
            replace(gaussians, colours=exposure.applied(gaussians.colours))
        )
        return True

    def _seed(self, frame: Frame, anchor_from_camera: Pose, view: RenderedView | None) -> int:
        optimiser = self._active()
        room = self._config.gaussian_bound(self._camera) - len(optimiser)
        if room <= 0:
            return 0
        seeds = self._seeder.seeds(
            frame, view, limit=room, existing=self._means_seen(view, anchor_from_camera)
        )
        if len(seeds):
            optimiser.extend(in_morton_order(seeds.transformed(anchor_from_camera)))
        return len(seeds)

    def _surface(self, frame: Frame, anchor_from_camera: Pose) -> NDArray[np.float64]:
        """(n, 3) points of the frame's surface, a thinned image of them, in the anchor frame."""
        points = self._camera.back_project(frame.depth)[::_THIN, ::_THIN].reshape(-1, 3)
        return se3.transform_points(anchor_from_camera, points[points[:, 2] > 0])

    def _means_seen(
        self, view: RenderedView | None, anchor_from_camera: Pose
    ) -> NDArray[np.float32]:
        """Means of the visible Gaussians in the camera frame (uniform seeding sizes by them)."""
        if view is None or self._config.seeding != "uniform":
            return np.zeros((0, 3), np.float32)
        means = self.gaussians().means[view.visible]
        return se3.transform_points(se3.inverse(anchor_from_camera), means).astype(np.float32)

    def _novelty(self, frame: Frame, pose: Pose, view: RenderedView | None) -> float:
        """Share of the pixels that the sub-map does not explain."""
        return float(self._seeder.need(frame, view or self.render(pose)).mean())

    def _optimise(self, budget: MappingBudget, started: float) -> tuple[int, int, float]:
        """(steps taken, steps cut for lack of time, last loss of the newest keyframe).

        Ends with the schedule's number of steps, when the newest keyframe has settled, or when the
        budget is spent.
        """
        wanted = self._wanted_iterations(budget)
        deadline = math.inf if budget.seconds is None else started + budget.seconds
        newest, losses = len(self._keyframes) - 1, []
        for done in range(wanted):
            if done >= budget.least_iterations and self._clock() >= deadline:
                return done, wanted - done, losses[-1] if losses else math.nan
            index = self._window.choose()
            loss = self._step(index)
            if index == newest:
                losses.append(loss)
            if _settled(losses, self._config.settle):
                return done + 1, 0, losses[-1]
        return wanted, 0, losses[-1] if losses else math.nan

    def _wanted_iterations(self, budget: MappingBudget) -> int:
        if budget.iterations is not None:
            return budget.iterations
        first = len(self._keyframes) == 1
        return self._config.anchor_iterations if first else self._config.iterations

    def _step(self, index: int) -> float:
        """One optimisation step on a keyframe; returns its loss before the step."""
        pose, target = self._keyframes[index].anchor_from_camera, self._targets[index]
        report = self._active().step(self._camera, pose, target.colour, target.depth)
        self._window.report(index, report.loss)
        return report.loss

    def _prune(self) -> int:
        gaussians = self.gaussians()
        largest = self._config.prune_scale * float(np.median(self._median_depths))
        keep = (gaussians.opacities >= self._config.prune_opacity) & (
            gaussians.scales.max(axis=1, initial=0.0) <= largest
        )
        if not keep.all():
            self._active().prune(keep)
        return int((~keep).sum())

    def _active(self) -> Optimiser:
        if self._optimiser is None:
            raise WrongState("the mapper has no sub-map yet: call begin() with the first frame")
        return self._optimiser


def _median_depth(frame: Frame) -> float:
    valid = frame.depth[frame.depth > 0]
    return float(np.median(valid)) if len(valid) else 1.0


def _settled(losses: list[float], share: float, span: int = 4) -> bool:
    """Whether the last `span` losses gained less than `share` of the loss per step."""
    if share <= 0.0 or len(losses) < 2 * span:
        return False
    before, after = np.mean(losses[-2 * span : -span]), np.mean(losses[-span:])
    return bool(before - after < share * span * after)
