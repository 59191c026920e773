"""A run folder's metrics: accuracy from `magic_core.evaluation`, speed and size from the agents."""

from __future__ import annotations

import statistics
import time
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from magic_cli.output import console
from magic_core.data import FrameSource
from magic_core.errors import NotFound
from magic_core.evaluation import AgentReport, LoopRecord, RunFolder

if TYPE_CHECKING:
    from magic_cli.local_run import Outcome


VIEWS_PER_KIND = 48
TIMED_BY_THE_RUN = ("fps", "agents", "merge_s", "gaussians", "wall_s")


def measure(
    folder: RunFolder,
    sources: list[FrameSource],
    *,
    outcome: Outcome,
    report: bool,
    started: float,
    lpips_weights: Path | None = None,
) -> dict:
    """Evaluate a finished run, write metrics.json and the report, return the metrics."""
    metrics = {
        **_measured(folder, sources, lpips_weights=lpips_weights),
        "fps": _rate(folder, outcome.mapping_s),
        "agents": dict(sorted(outcome.agents.items())),
        "merge_s": round(outcome.merge_s, 2),
        "gaussians": outcome.gaussians,
        "wall_s": round(time.perf_counter() - started, 2),
    }
    folder.write_metrics(metrics)
    if report:
        write_report(folder, sources)
    return metrics


def measure_again(
    folder: RunFolder,
    sources: list[FrameSource],
    *,
    lpips_weights: Path | None = None,
    views_per_kind: int = VIEWS_PER_KIND,
) -> dict:
    """Measure a finished run anew; what only the run itself could time is kept as it was."""
    try:
        before = folder.read_metrics()
    except NotFound:  # the run was cut short before it was measured
        before = {}
    unknown: dict[str, Any] = dict.fromkeys(TIMED_BY_THE_RUN)
    measured = _measured(
        folder, sources, lpips_weights=lpips_weights, views_per_kind=views_per_kind
    )
    metrics = unknown | before | measured
    folder.write_metrics(metrics)
    return metrics


def _measured(
    folder: RunFolder,
    sources: list[FrameSource],
    *,
    lpips_weights: Path | None,
    views_per_kind: int = VIEWS_PER_KIND,
) -> dict:
    from magic_core.evaluation import evaluate_run

    with console.status("measuring the map and the trajectories"):
        accuracy = evaluate_run(
            folder, sources=sources, views_per_kind=views_per_kind, lpips_weights=lpips_weights
        )
    reports = agent_reports(folder)
    return {**accuracy, **agent_metrics(reports), "loops": loop_counts(folder.read_loops())}


def _rate(folder: RunFolder, mapping_s: float) -> float | None:
    """Frames per second of all agents together."""
    frames = sum(report.frames for report in agent_reports(folder))
    return round(frames / mapping_s, 2) if mapping_s else None


def write_report(folder: RunFolder, sources: list[FrameSource]) -> None:
    """Write report.html and overview.png."""
    from magic_core.evaluation import write_report as write

    with console.status("writing the report"):
        write(folder, sources=sources)


def agent_reports(folder: RunFolder) -> list[AgentReport]:
    """The reports that agents left; a killed agent leaves none."""
    reports = []
    for agent in folder.agents():
        try:
            reports.append(folder.read_agent_report(agent))
        except NotFound:
            continue
    return reports


def agent_metrics(reports: list[AgentReport]) -> dict:
    """Counts, times per frame and bytes of all agents together."""
    tracking = [ms for report in reports for ms in report.tracking_ms]
    mapping = [ms for report in reports for ms in report.mapping_ms]
    sizes = [size for report in reports for size in report.wire_bytes]
    return {
        "frames": sum(report.frames for report in reports),
        "lost_frames": sum(report.lost_frames for report in reports),
        "submaps": sum(report.submaps for report in reports),
        "tracking_ms": spread(tracking),
        "mapping_ms": spread(mapping),
        "left_out": {
            "frames": sum(report.dropped_frames for report in reports),
            "keyframes": sum(report.skipped_keyframes for report in reports),
            "mapping_steps": sum(report.cut_mapping_steps for report in reports),
            "of_mapping_steps": sum(
                report.mapping_steps + report.cut_mapping_steps for report in reports
            ),
        },
        "late_ms": spread([ms for report in reports for ms in report.late_ms]),
        "wire_bytes_per_submap": {
            kind: round(statistics.fmean(getattr(size, kind) for size in sizes)) if sizes else None
            for kind in ("compact", "lossless")
        },
        "peak_rss_bytes": max((report.peak_rss_bytes for report in reports), default=0),
    }


def loop_counts(loops: list[LoopRecord]) -> dict:
    """How many candidates there were, and what became of them."""
    rejected = Counter(loop.reason for loop in loops if not loop.accepted)
    return {
        "detected": len(loops),
        "accepted": sum(loop.accepted for loop in loops),
        "rejected": dict(sorted(rejected.items())),
    }


def spread(values: list[float]) -> dict:
    """Median and 95th percentile."""
    if not values:
        return {"median": None, "p95": None}
    median, p95 = np.percentile(values, (50, 95))
    return {"median": round(float(median), 2), "p95": round(float(p95), 2)}
