"""`magic bench track`: trackers compared on the same frames, with the same mapper and seed.

Every variant runs the whole local SLAM of every agent without loop closure. What differs is the
tracking configuration alone. All variants take each frame in turn before the next one is read, so
that whatever else the machine does falls on all of them alike. Accuracy is the ATE of each agent
on its own; time is that of tracking, frame by frame and stage by stage.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from magic_agent.slam_config import SlamConfig
from magic_agent.tracking.benchmark_report import summary
from magic_agent.tracking.config import TrackingConfig
from magic_agent.tracking.trial import AgentRun, Trial
from magic_core.data import FrameSource, open_dataset
from magic_core.errors import ConfigError

Progress = Callable[[str], None]

SOLVERS = ("gn", "adam")


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
        **_conditions(dataset, scale=scale, frames=frames, stride=stride, seeds=seeds),
        "solvers": report,
        "speedup": medians["adam"] / medians["gn"] if both else None,
    }


def run_ablations(
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
        variants = {
            name: tracking for name, tracking in variants.items() if tracking.solver != "adam"
        }
    report = compare(
        dataset,
        {name: replace(config, tracking=tracking) for name, tracking in variants.items()},
        scale=scale,
        frames=frames,
        stride=stride,
        seeds=seeds,
        progress=progress,
    )
    return {
        **_conditions(dataset, scale=scale, frames=frames, stride=stride, seeds=seeds),
        "variants": report,
    }


def ablations(tracking: TrackingConfig) -> dict[str, TrackingConfig]:
    """The variants of `run_ablations` by name."""
    newton = tracking.gauss_newton
    variants = {
        "default": tracking,
        "without pose initialisation": replace(
            tracking, initialisation="constant_velocity", rotation_prealignment=False
        ),
    }
    for name in ("constant_velocity", "dense", "rgbd_odometry", "point_to_plane", "coloured_icp"):
        variants[f"initialisation={name}"] = replace(tracking, initialisation=name)
    for levels in (1, 2, 3, 4):
        fewer = replace(newton, levels=levels)
        variants[f"levels={levels}"] = replace(tracking, gauss_newton=fewer)
    alone = replace(tracking, window=replace(tracking.window, images=0))
    variants["sub-map alone"] = alone
    # Earlier images hide what the refinement starts from: without them it shows.
    variants["sub-map alone, without pose initialisation"] = replace(
        alone, initialisation="constant_velocity", rotation_prealignment=False
    )
    variants["one render"] = replace(tracking, gauss_newton=replace(newton, renders=1))
    papers = replace(tracking, solver="adam", initialisation="coloured_icp")
    variants["adam"] = papers
    variants["adam, without pose initialisation"] = replace(
        papers, initialisation="constant_velocity", rotation_prealignment=False
    )
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
    runs: dict[str, list[dict[str, AgentRun]]] = {name: [] for name in variants}
    for seed in seeds:
        seeded = {name: replace(config, seed=seed) for name, config in variants.items()}
        for name in variants:
            runs[name].append({})
        for source in open_dataset(dataset, scale=scale, max_frames=frames, stride=stride):
            for name, found in run_agent(source, seeded).items():
                runs[name][-1][source.name] = found
                if progress is not None:
                    progress(_line(name, source.name, seed, found))
    return {name: summary(by_seed) for name, by_seed in runs.items()}


def run_agent(source: FrameSource, variants: dict[str, SlamConfig]) -> dict[str, AgentRun]:
    """Local SLAM of every variant over one source, side by side; it must have ground truth."""
    trials = {name: Trial(source.name, source.camera, config) for name, config in variants.items()}
    for frame in source:
        for trial in trials.values():
            trial.process(frame)
    return {name: trial.finish() for name, trial in trials.items()}


def _conditions(
    dataset: Path | str,
    *,
    scale: float,
    frames: int | None,
    stride: int,
    seeds: Sequence[int],
) -> dict:
    return {
        "dataset": str(dataset),
        "scale": scale,
        "frames_per_agent": frames,
        "stride": stride,
        "seeds": list(seeds),
    }


def _line(variant: str, agent: str, seed: int, run: AgentRun) -> str:
    median_ms = float(np.median(run.frames_ms)) if run.frames_ms else 0.0
    return (
        f"{variant} {agent} seed {seed}: ATE {100 * run.ate_rmse_m:.2f} cm, "
        f"{run.lost_frames} lost, {run.breaks} breaks, {median_ms:.1f} ms per frame"
    )


def _with_solver(config: SlamConfig, name: str) -> SlamConfig:
    if name not in (*SOLVERS, "gauss_newton"):
        raise ConfigError.field("solvers", f"{name!r}: expected one of {', '.join(SOLVERS)}")
    return replace(config, tracking=replace(config.tracking, solver=name))
