"""How well sub-maps show their keyframes and frames that mapping never saw."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from magic_agent.mapping.mapper import Mapper
from magic_agent.mapping.segments import Segment
from magic_core.data import Frame
from magic_core.evaluation.image_metrics import depth_l1, psnr, ssim

if TYPE_CHECKING:
    from magic_agent.mapping.benchmark import Cost

KINDS = ("keyframes", "new_views")
METRICS = ("psnr_db", "ssim", "depth_l1_m")


@dataclass(slots=True)
class Scores:
    """One agent's sub-maps, mapped one way with one seed."""

    costs: list[Cost] = field(default_factory=list)
    frames: int = 0
    gaussians: list[int] = field(default_factory=list)
    views: dict[tuple[str, str], list[float]] = field(default_factory=dict)
    """(kind, metric) -> one value per view."""

    def add(
        self,
        mapper: Mapper,
        segment: Segment,
        *,
        keyframes: Sequence[Frame],
        withheld: Callable[[Frame], bool],
        cost: Cost,
    ) -> None:
        """Render the views of a finished sub-map, before anything is handed over."""
        self.costs.append(cost)
        self.frames += len(segment.frames)
        self.gaussians.append(len(mapper))
        mapped = {frame.index for frame in keyframes}
        for frame, pose in zip(segment.frames, segment.anchor_from_camera, strict=True):
            if frame.index in mapped:
                self._add_view("keyframes", mapper, frame, pose)
            elif withheld(frame):
                self._add_view("new_views", mapper, frame, pose)

    def _add_view(self, kind: str, mapper: Mapper, frame: Frame, pose) -> None:
        view = mapper.render(pose)
        image = frame.colour.astype(np.float32) / np.float32(255.0)
        found = {
            "psnr_db": psnr(view.colour, image),
            "ssim": ssim(view.colour, image),
            "depth_l1_m": depth_l1(view.expected_depth, frame.depth, alpha=view.alpha),
        }
        for metric, value in found.items():
            self.views.setdefault((kind, metric), []).append(value)

    def mean(self, kind: str, metric: str) -> float:
        """Mean over the views of a kind; NaN where there is none."""
        return _mean(self.views.get((kind, metric), []))

    def line(self) -> str:
        """One line for a person who waits."""
        seconds = sum(cost.seconds for cost in self.costs)
        iterations = sum(cost.iterations for cost in self.costs)
        return (
            f"PSNR {self.mean('keyframes', 'psnr_db'):.2f} / "
            f"{self.mean('new_views', 'psnr_db'):.2f} dB, {iterations} steps, {seconds:.1f} s"
        )


class Quality:
    """One variant over agents and seeds."""

    def __init__(self) -> None:
        self._by_seed: dict[int, list[Scores]] = {}

    def add(self, seed: int, scores: Scores) -> None:
        """Take in one agent's scores."""
        self._by_seed.setdefault(seed, []).append(scores)

    def summary(self) -> dict:
        """Means, with the lowest and the highest seed beside them."""
        every = [scores for agents in self._by_seed.values() for scores in agents]
        frames = max(sum(scores.frames for scores in every), 1)
        costs = [cost for scores in every for cost in scores.costs]
        result: dict = {
            metric: {kind: _band(self._per_seed(kind, metric)) for kind in KINDS}
            for metric in METRICS
        }
        return {
            **result,
            "iterations_per_frame": sum(cost.iterations for cost in costs) / frames,
            "cpu_ms_per_frame": 1e3 * sum(cost.seconds for cost in costs) / frames,
            "gaussians_per_submap": _mean([float(n) for s in every for n in s.gaussians]),
            "views": {kind: sum(len(s.views.get((kind, "ssim"), [])) for s in every)
                      for kind in KINDS},
        }  # fmt: skip

    def gain_over(self, other: Quality) -> dict:
        """This variant minus another, seed by seed, per metric and kind."""
        return {
            metric: {
                kind: _band(
                    [a - b for a, b in zip(self._per_seed(kind, metric),
                                           other._per_seed(kind, metric), strict=True)]
                )
                for kind in KINDS
            }
            for metric in METRICS
        }  # fmt: skip

    def _per_seed(self, kind: str, metric: str) -> list[float]:
        """The mean over all agents' views, for each seed in order."""
        return [
            _mean(
                [v for scores in self._by_seed[seed] for v in scores.views.get((kind, metric), [])]
            )
            for seed in sorted(self._by_seed)
        ]


def _band(values: Sequence[float]) -> dict[str, float]:
    return {"mean": _mean(values), "low": float(min(values)), "high": float(max(values))}


def _mean(values: Sequence[float]) -> float:
    finite = [value for value in values if np.isfinite(value)]
    return float(np.mean(finite)) if finite else float("nan")
