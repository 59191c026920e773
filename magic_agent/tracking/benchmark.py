"""`magic bench track`: trackers compared on the same frames, with the same mapper and seed.

Every solver runs the whole local SLAM of every agent without loop closure. What differs is the
tracking configuration alone. Accuracy is the ATE of each agent on its own; time is that of
tracking, frame by frame and stage by stage.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magic_agent.slam import FrameResult, LocalSlam
from magic_agent.slam_config import SlamConfig
from magic_agent.tracking.config import TrackingConfig
from magic_core.data import FrameSource, open_dataset
from magic_core.errors import ConfigError
from magic_core.evaluation.ate import ate_rmse
from magic_core.evaluation.trajectory import Trajectory
from magic_core.submap import Descriptor, Submap

Progress = Callable[[str], None]

SOLVERS = ("gn", "adam")


@dataclass(slots=True)
class AgentRun:
    """What one tracker did on one agent's frames."""

    ate_rmse_m: float
    lost_frames: int
    breaks: int
    """Sub-maps that began without odometry; each part is aligned on its own for the ATE."""
    frames_ms: list[float]
    stages_ms: dict[str, list[float]]
    mapping_ms: float
    """Mean mapping time per frame."""


def run(
    dataset: Path | str,
    *,
    scale: float = 0.5,
    frames: int | None = None,
    stride: int = 1,
    solvers: Sequence[str] = SOLVERS,
    config: SlamConfig | None = None,
    seeds: Sequence[int] = (0,),
    progress: Progress | None = None,
) -> dict:
    """Compare solvers (`gn`, `adam`) on a dataset; the result is ready for JSON.

    `speedup` is adam's median time per frame over gn's, None unless both ran.
    """
    config = config or SlamConfig()
    variants = {name: _with_solver(config, name) for name in solvers}
    report = compare(
        dataset, variants, scale=scale, frames=frames, stride=stride, seeds=seeds, progress=progress
    )
    medians = {name: report[name]["ms_per_frame"]["median"] for name in report}
    both = {"gn", "adam"} <= medians.keys()
    return {
        "dataset": str(dataset),
        "scale": scale,
        "stride": stride,
        "seeds": list(seeds),
        "solvers": report,
        "speedup": medians["adam"] / medians["gn"] if both else None,
    }


def run_ablation(
    dataset: Path | str,
    *,
    scale: float = 0.5,
    frames: int | None = None,
    stride: int = 1,
    config: SlamConfig | None = None,
    seeds: Sequence[int] = (0,),
    adam: bool = True,
    progress: Progress | None = None,
) -> dict:
    """Each initialisation, pyramid depth and part of the tracker in turn, as the paper's table."""
    config = config or SlamConfig()
    variants = ablations(config.tracking)
    if not adam:
        del variants["adam"]
    report = compare(
        dataset,
        {name: replace(config, tracking=tracking) for name, tracking in variants.items()},
        scale=scale,
        frames=frames,
        stride=stride,
        seeds=seeds,
        progress=progress,
    )
    return {"dataset": str(dataset), "scale": scale, "stride": stride, "variants": report}


def ablations(tracking: TrackingConfig) -> dict[str, TrackingConfig]:
    """The variants of `run_ablation` by name."""
    newton = tracking.gauss_newton
    variants = {"default": tracking}
    for name in ("constant_velocity", "dense", "rgbd_odometry", "point_to_plane", "coloured_icp"):
        variants[f"initialisation={name}"] = replace(tracking, initialisation=name)
    for levels in (1, 2, 3, 4):
        fewer = replace(newton, levels=levels)
        variants[f"levels={levels}"] = replace(tracking, gauss_newton=fewer)
    no_window = replace(tracking.window, images=0)
    variants["sub-map alone"] = replace(tracking, window=no_window)
    variants["one render"] = replace(tracking, gauss_newton=replace(newton, renders=1))
    variants["adam"] = replace(tracking, solver="adam", initialisation="coloured_icp")
    return variants


def compare(
    dataset: Path | str,
    variants: dict[str, SlamConfig],
    *,
    scale: float,
    frames: int | None,
    stride: int,
    seeds: Sequence[int],
    progress: Progress | None = None,
) -> dict[str, dict]:
    """Each variant's report on the same frames."""
    report = {}
    for name, config in variants.items():
        runs: dict[str, list[AgentRun]] = {}
        for seed in seeds:
            for source in open_dataset(dataset, scale=scale, max_frames=frames, stride=stride):
                agent_run = run_agent(source, replace(config, seed=seed))
                runs.setdefault(source.name, []).append(agent_run)
                if progress is not None:
                    progress(_line(name, source.name, seed, agent_run))
        report[name] = _summary(runs)
    return report


def run_agent(source: FrameSource, config: SlamConfig) -> AgentRun:
    """Local SLAM over one source; its frames must have ground truth."""
    slam = LocalSlam(
        source.camera, config, session="bench", agent=source.name, describe=_no_descriptor
    )
    timing, chain = _Timing(), _Chain()
    mapping_ms, lost, truth = 0.0, 0, []
    for frame in source:
        if frame.world_from_camera is None:
            raise ConfigError.field("dataset", f"{source.name} has no ground truth to compare with")
        truth.append((frame.timestamp_s, frame.world_from_camera))
        result = slam.process(frame)
        mapping_ms += result.mapping_ms
        lost += result.lost
        timing.add(result)
        chain.add(result.finished)
    chain.add(slam.finish())
    return AgentRun(
        ate_rmse_m=chain.ate_rmse_m(Trajectory.from_poses(truth)),
        lost_frames=lost,
        breaks=chain.breaks,
        frames_ms=timing.frames_ms,
        stages_ms=timing.stages_ms,
        mapping_ms=mapping_ms / max(len(source), 1),
    )


class _Timing:
    """Tracking times of one agent."""

    def __init__(self) -> None:
        self.frames_ms: list[float] = []
        self.stages_ms: dict[str, list[float]] = {}

    def add(self, result: FrameResult) -> None:
        """Note one frame; the first of a chain is not tracked."""
        if result.tracked is None:
            return
        self.frames_ms.append(result.tracking_ms)
        for stage, elapsed_ms in result.tracked.stages_ms.items():
            self.stages_ms.setdefault(stage, []).append(elapsed_ms)


class _Chain:
    """Finished sub-maps joined by their odometry; a sub-map without odometry begins a new part."""

    def __init__(self) -> None:
        self._parts: list[list[tuple[float, NDArray[np.float64]]]] = []
        self._world_from_anchor = np.eye(4)

    @property
    def breaks(self) -> int:
        """Parts beyond the first."""
        return max(len(self._parts) - 1, 0)

    def add(self, submap: Submap | None) -> None:
        """Append the frames of the next sub-map, if there is one; lost ones are left out."""
        if submap is None:
            return
        if submap.odometry is None:
            self._parts.append([])
            self._world_from_anchor = np.eye(4)
        else:
            step = submap.odometry.previous_from_anchor
            self._world_from_anchor = self._world_from_anchor @ step
        self._parts[-1].extend(
            (frame.timestamp_s, self._world_from_anchor @ frame.anchor_from_camera)
            for frame in submap.trajectory
            if not frame.lost
        )

    def ate_rmse_m(self, truth: Trajectory) -> float:
        """RMSE over all parts, each aligned on its own: where one ends, nothing was claimed."""
        squares, count = 0.0, 0
        for part in self._parts:
            if part:
                squares += len(part) * ate_rmse(Trajectory.from_poses(part), truth)[0] ** 2
                count += len(part)
        return float(np.sqrt(squares / max(count, 1)))


def _summary(runs: dict[str, list[AgentRun]]) -> dict:
    """One variant's figures; over seeds the mean, with the lowest and highest beside it."""
    every = [each for agent_runs in runs.values() for each in agent_runs]
    by_agent = {
        agent: [each.ate_rmse_m for each in agent_runs] for agent, agent_runs in runs.items()
    }
    means = np.mean(list(by_agent.values()), axis=0)  # per seed, over agents
    frames_ms = [value for each in every for value in each.frames_ms]
    stages: dict[str, list[float]] = {}
    for each in every:
        for stage, values in each.stages_ms.items():
            stages.setdefault(stage, []).extend(values)
    return {
        "ate_rmse_m": {agent: float(np.mean(values)) for agent, values in by_agent.items()},
        "mean_ate_m": float(means.mean()),
        "mean_ate_band_m": [float(means.min()), float(means.max())],
        "lost_frames": sum(each.lost_frames for each in every),
        "breaks": sum(each.breaks for each in every),
        "ms_per_frame": {
            "median": float(np.median(frames_ms)),
            "p95": float(np.percentile(frames_ms, 95)),
        },
        "stages_ms": {stage: float(np.median(values)) for stage, values in stages.items()},
        "mapping_ms_per_frame": float(np.mean([each.mapping_ms for each in every])),
    }


def _line(variant: str, agent: str, seed: int, run: AgentRun) -> str:
    median_ms = float(np.median(run.frames_ms)) if run.frames_ms else 0.0
    return (
        f"{variant} {agent} seed {seed}: ATE {100 * run.ate_rmse_m:.2f} cm, "
        f"{run.lost_frames} lost, {median_ms:.1f} ms per frame"
    )


def _no_descriptor(colour: NDArray[np.uint8]) -> Descriptor:
    """Loops are off: nobody will look at it."""
    return Descriptor("none", np.ones(1, np.float32))


def _with_solver(config: SlamConfig, name: str) -> SlamConfig:
    if name not in (*SOLVERS, "gauss_newton"):
        raise ConfigError.field("solvers", f"{name!r}: expected one of {', '.join(SOLVERS)}")
    return replace(config, tracking=replace(config.tracking, solver=name))
