"""What a benchmark reports of many runs: one value per figure, and its band over seeds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from magic_agent.tracking.trial import AgentRun


def summary(by_seed: Sequence[dict[str, AgentRun]]) -> dict:
    """One variant's figures, ready for JSON.

    by_seed: for each seed, the run of each agent by name. Accuracy is the median over seeds, lost
    frames and breaks are the worst seed's; `bands` holds [least, median, largest] of each figure.
    """
    seeds = [_of_one_seed(runs) for runs in by_seed]
    bands = {name: _band([seed[name] for seed in seeds]) for name in seeds[0]}
    agents = list(by_seed[0])
    ate = {name: _band([runs[name].ate_rmse_m for runs in by_seed]) for name in agents}
    every = [run for runs in by_seed for run in runs.values()]
    return {
        "ate_rmse_m": {name: band[1] for name, band in ate.items()},
        "mean_ate_m": bands["mean_ate_m"][1],
        "frames": sum(run.frames for run in by_seed[0].values()),
        "lost_frames": int(bands["lost_frames"][2]),
        "breaks": int(bands["breaks"][2]),
        "ms_per_frame": {
            "median": _over_frames([run.frames_ms for run in every], 50),
            "p95": _over_frames([run.frames_ms for run in every], 95),
        },
        "stages_ms": _stages(every),
        "mapping_ms_per_frame": bands["mapping_ms_per_frame"][1],
        "bands": {**bands, "ate_rmse_m": ate},
    }


def _of_one_seed(runs: dict[str, AgentRun]) -> dict[str, float]:
    """The figures that have a band, over all agents of one seed."""
    frames_ms = [run.frames_ms for run in runs.values()]
    return {
        "mean_ate_m": float(np.mean([run.ate_rmse_m for run in runs.values()])),
        "lost_frames": sum(run.lost_frames for run in runs.values()),
        "breaks": sum(run.breaks for run in runs.values()),
        "ms_per_frame_median": _over_frames(frames_ms, 50),
        "ms_per_frame_p95": _over_frames(frames_ms, 95),
        "mapping_ms_per_frame": float(
            np.mean([value for run in runs.values() for value in run.mapping_ms] or [0.0])
        ),
    }


def _stages(runs: Sequence[AgentRun]) -> dict[str, float]:
    """Median time of each stage; a stage that only some frames pass counts 0 in the others."""
    names = dict.fromkeys(stage for run in runs for stage in run.stages_ms)
    frames = sum(len(run.frames_ms) for run in runs)
    found = {}
    for name in names:
        values = [value for run in runs for value in run.stages_ms.get(name, [])]
        found[name] = float(np.median([*values, *[0.0] * (frames - len(values))]))
    return found


def _over_frames(frames_ms: Sequence[Sequence[float]], percentile: float) -> float:
    values = [value for frames in frames_ms for value in frames]
    return float(np.percentile(values, percentile)) if values else float("nan")


def _band(values: Sequence[float]) -> list[float]:
    """[least, median, largest]."""
    return [float(np.min(values)), float(np.median(values)), float(np.max(values))]
