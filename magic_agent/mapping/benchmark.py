"""`magic bench map`: mapping schedules compared on the same frames, poses and sub-maps.

Every fifth frame is withheld from mapping. At the end of each sub-map the withheld frames, and
separately each schedule's own keyframes, are rendered and compared with the images. Poses are
given, so that nothing but mapping differs: the ground truth's, or those of one tracking run.

The two schedules differ in what they spend, so each is also run with the other's budget: the
same number of optimisation steps per sub-map, and the same time, spread evenly over the keyframes
that the schedule chose with its own budget. Ours spends what goes beyond its own on closing the
sub-map (`closing_iterations`). Time is that of one thread's CPU, which other work on
the machine does not lengthen.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from magic_agent.mapping.config import MappingConfig
from magic_agent.mapping.mapper import Mapper, MappingBudget
from magic_agent.mapping.quality import Quality, Scores
from magic_agent.mapping.segments import Pose, Poses, Segment, segments_of
from magic_agent.slam_config import SlamConfig
from magic_core.data import Frame, open_dataset
from magic_core.gaussians import GaussianCloud
from magic_core.geometry import Camera

Schedule = Literal["paper", "ours"]
Unit = Literal["iterations", "seconds"]
Progress = Callable[[str], None]

SCHEDULES: tuple[Schedule, Schedule] = ("paper", "ours")
WITHHELD_EVERY = 5
_ENDLESS = 1_000_000
_WITHHELD = 3
"""Frames with this remainder by WITHHELD_EVERY are never mapped; the paper's keyframes have 0."""


@dataclass(frozen=True, slots=True)
class Allowance:
    """What a whole sub-map may cost: the amount that another schedule spent on the same one."""

    unit: Unit
    amount: float
    keyframes: tuple[int, ...]
    """Indices of the frames to map, in order; each gets the same share."""
    most_iterations: int = _ENDLESS
    """Steps per keyframe at most; what they leave is for closing the sub-map."""

    def budget(self, *, spent: float, number: int) -> MappingBudget:
        """The budget of keyframe `number`, counted from 0, after `spent` on those before: its own
        share, and what they left. The number after the last means the closing steps."""
        closing = number == len(self.keyframes)
        share = 1.0 if closing else (number + 1) / len(self.keyframes)
        left = max(0.0, share * self.amount - spent)
        most = _ENDLESS if closing else self.most_iterations
        if self.unit == "iterations":
            return MappingBudget(iterations=min(round(left), most))
        return MappingBudget(iterations=most, seconds=left)


_UNITS: tuple[tuple[Unit, str], ...] = (("iterations", "iterations"), ("seconds", "time"))


@dataclass(frozen=True, slots=True)
class Cost:
    """What one sub-map took."""

    iterations: int
    seconds: float
    keyframes: tuple[int, ...]
    """Indices of the frames that were mapped, in order."""


def run(
    dataset: Path | str,
    *,
    scale: float = 0.5,
    frames: int | None = None,
    poses: Poses = "tracked",
    config: SlamConfig | None = None,
    seeds: Sequence[int] = (0, 1, 2),
    progress: Progress = lambda text: None,
) -> dict:
    """Compare the schedules on a dataset; the result is ready for JSON.

    `variants` maps "schedule / budget" to its figures, `gains` a budget to ours minus the paper's.
    """
    config = config or SlamConfig()
    runs: dict[str, Quality] = {}
    for source in open_dataset(dataset, scale=scale, max_frames=frames):
        segments = segments_of(source, config, poses)
        for seed in seeds:
            bench = _Bench(source.camera, config.mapping, seed=seed)
            for name, scores in bench.all_variants(segments):
                runs.setdefault(name, Quality()).add(seed, scores)
                progress(f"{source.name} seed {seed}, {name}: {scores.line()}")
    return {
        "dataset": str(dataset),
        "scale": scale,
        "frames": frames,
        "poses": poses,
        "seeds": list(seeds),
        "variants": {name: quality.summary() for name, quality in runs.items()},
        "gains": {
            budget: runs[variant("ours", budget)].gain_over(runs[variant("paper", budget)])
            for budget in BUDGETS
        },
    }


BUDGETS = ("iterations of ours", "time of ours", "iterations of paper", "time of paper")


def variant(schedule: Schedule, budget: str) -> str:
    """The name of a schedule under a budget; its own budget is the unit of both comparisons."""
    return schedule if budget.endswith(f" of {schedule}") else f"{schedule} / {budget}"


class _Bench:
    """All variants on one agent's sub-maps with one seed."""

    def __init__(self, camera: Camera, config: MappingConfig, *, seed: int) -> None:
        self._camera, self._seed = camera, seed
        self._configs: dict[Schedule, MappingConfig] = {
            "paper": replace(config, schedule="paper"),
            "ours": replace(config, schedule="fast"),
        }

    def all_variants(self, segments: Sequence[Segment]) -> Iterator[tuple[str, Scores]]:
        """(name, scores) of each schedule with its own budget, then with the other's."""
        costs: dict[Schedule, list[Cost]] = {}
        for schedule in SCHEDULES:
            scores = self._map(segments, self._configs[schedule], [None] * len(segments))
            costs[schedule] = scores.costs
            yield schedule, scores
        for schedule, other in (SCHEDULES, SCHEDULES[::-1]):
            for unit, word in _UNITS:
                # Settling early would leave a part of the other's budget unused.
                config = replace(self._configs[schedule], settle=0.0)
                most = config.iterations if schedule == "ours" else _ENDLESS
                allowances = [
                    Allowance(unit, getattr(theirs, unit), own.keyframes, most)
                    for own, theirs in zip(costs[schedule], costs[other], strict=True)
                ]
                yield f"{schedule} / {word} of {other}", self._map(segments, config, allowances)

    def _map(
        self,
        segments: Sequence[Segment],
        config: MappingConfig,
        allowances: Sequence[Allowance | None],
    ) -> Scores:
        """Map all sub-maps in turn, handing visible Gaussians over, as an agent does."""
        mapper = Mapper(self._camera, config, threads=1, seed=self._seed, clock=time.thread_time)
        scores, carried = Scores(), None
        for segment, allowance in zip(segments, allowances, strict=True):
            sub_map = _SubmapRun(mapper, segment, allowance)
            keyframes = sub_map.map(carried)
            scores.add(mapper, segment, keyframes=keyframes, withheld=withheld, cost=sub_map.cost)
            if segment.anchor_from_next is not None:
                carried = mapper.split(segment.anchor_from_next)[1]
            else:
                carried = None
        return scores


def withheld(frame: Frame) -> bool:
    """Whether a frame is kept from mapping, so that it can show how new views look."""
    return frame.index % WITHHELD_EVERY == _WITHHELD


class _SubmapRun:
    """One sub-map mapped under an allowance."""

    def __init__(self, mapper: Mapper, segment: Segment, allowance: Allowance | None) -> None:
        self._mapper, self._segment, self._allowance = mapper, segment, allowance
        self._iterations = 0
        self._keyframes: list[Frame] = []
        self._started = time.thread_time()

    @property
    def cost(self) -> Cost:
        mapped = tuple(frame.index for frame in self._keyframes)
        return Cost(self._iterations, time.thread_time() - self._started, mapped)

    def map(self, carried: GaussianCloud | None) -> list[Frame]:
        """Map the segment; returns its keyframes."""
        for frame, pose in zip(self._segment.frames, self._segment.anchor_from_camera, strict=True):
            if not self._keyframes:
                report = self._mapper.begin(frame, carried=carried, budget=self._budget())
            elif self._wants(frame, pose):
                report = self._mapper.insert(frame, pose, budget=self._budget())
            else:
                continue
            self._iterations += report.iterations
            self._keyframes.append(frame)
        self._iterations += self._mapper.close(budget=self._budget()).iterations
        return self._keyframes

    def _wants(self, frame: Frame, pose: Pose) -> bool:
        if self._allowance is not None:
            return frame.index in self._allowance.keyframes
        return not withheld(frame) and self._mapper.wants(frame, pose)

    def _budget(self) -> MappingBudget:
        if self._allowance is None:
            return MappingBudget()
        spent = getattr(self.cost, self._allowance.unit)
        return self._allowance.budget(spent=spent, number=len(self._keyframes))
