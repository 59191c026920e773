"""`magic tracking RUN`: how tracking went, per frame: cost, inliers, conditioning, lost frames.

Reads the agents/AGENT/frames.csv that every agent writes while it runs, also of a run that is
still going or was cut short.

Examples:
  magic tracking runs/office
  magic tracking runs/office --agent agent_1 --frames --state lost
  magic tracking runs/office --json
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from tyro.conf import Positional

from magic_cli.options import parse
from magic_cli.output import console, print_json, table
from magic_core.errors import NotFound
from magic_core.evaluation import RunFolder
from magic_core.evaluation.frame_records import (
    FILE_NAME,
    FrameRecord,
    lost_stretches,
    read_frame_records,
)


@dataclass(frozen=True, slots=True)
class TrackingCommand:
    """Options of `magic tracking`."""

    run: Positional[Path]
    """Run folder."""
    agent: str | None = None
    """Only this agent."""
    frames: bool = False
    """List the frames, not only the summary."""
    state: Literal["all", "ok", "degenerate", "lost", "recovered", "first"] = "all"
    """List only frames in this state."""
    json: bool = False
    """Print one JSON object as the last line."""


def main(arguments: list[str]) -> int:
    """Print the report; 0 also where frames were lost."""
    config = parse(TrackingCommand, arguments, prog="magic tracking", description=__doc__ or "")
    reports = _reports(config)
    rows = [_summary(agent, records) for agent, records in reports.items()]
    console.print(table(f"Tracking of {config.run}", SUMMARY, rows))
    for agent, records in reports.items():
        _print_stretches(agent, records)
        if config.frames:
            console.print(table(agent, FRAMES, [_line(r) for r in _chosen(records, config)]))
    if config.json:
        print_json({agent: figures(records) for agent, records in reports.items()})
    return 0


def figures(records: Sequence[FrameRecord]) -> dict:
    """The summary of one agent's frames."""
    states = Counter(record.state for record in records)
    names = ("cost", "inlier_share", "visible_share", "condition_number", "tracking_ms")
    return {
        "frames": len(records),
        "states": dict(states),
        "keyframes": sum(record.keyframe for record in records),
        **{name: _spread([getattr(record, name) for record in records]) for name in names},
        "lost": [
            {"first": first.frame, "last": last.frame, "reason": first.reason, "then": after}
            for first, last, after in lost_stretches(records)
        ],
    }


SUMMARY = ["agent", "frames", "lost", "recovered", "degenerate", "cost", "inliers", "visible",
           "condition", "ms per frame"]  # fmt: skip
FRAMES = ["frame", "time", "sub-map", "state", "cost", "inliers", "visible", "condition", "ms",
          "keyframe", "reason"]  # fmt: skip


def _reports(config: TrackingCommand) -> dict[str, list[FrameRecord]]:
    folder = RunFolder(config.run).agents_folder
    paths = {path.parent.name: path for path in sorted(folder.glob(f"*/{FILE_NAME}"))}
    if config.agent is not None:
        paths = {name: path for name, path in paths.items() if name == config.agent}
    if not paths:
        wanted = f"agent {config.agent}" if config.agent else "agent"
        raise NotFound(
            f"{config.run}: no {wanted} with a {FILE_NAME} under agents/; give the folder of "
            "`magic run`, or the --out of `magic agent`"
        )
    return {name: read_frame_records(path) for name, path in paths.items()}


def _chosen(records: Sequence[FrameRecord], config: TrackingCommand) -> list[FrameRecord]:
    return [record for record in records if config.state in ("all", record.state)]


def _summary(agent: str, records: Sequence[FrameRecord]) -> list[str]:
    found = figures(records)
    states = found["states"]
    return [
        agent, str(found["frames"]),
        *(str(states.get(state, 0)) for state in ("lost", "recovered", "degenerate")),
        _pair(found["cost"], "{:.3g}"), _pair(found["inlier_share"], "{:.0%}"),
        _pair(found["visible_share"], "{:.0%}"), _pair(found["condition_number"], "{:.0f}"),
        _pair(found["tracking_ms"], "{:.0f}"),
    ]  # fmt: skip


def _print_stretches(agent: str, records: Sequence[FrameRecord]) -> None:
    for first, last, after in lost_stretches(records):
        console.print(
            f"{agent}: lost from frame {first.frame} to {last.frame} "
            f"({first.reason or 'no reason given'}), then {after}",
            markup=False,
        )


def _line(record: FrameRecord) -> list[str]:
    return [
        str(record.frame), f"{record.timestamp_s:.3f}", str(record.submap), record.state,
        f"{record.cost:.3g}", f"{record.inlier_share:.0%}", f"{record.visible_share:.0%}",
        f"{record.condition_number:.0f}", f"{record.tracking_ms:.0f}",
        "yes" if record.keyframe else "", record.reason,
    ]  # fmt: skip


def _spread(values: Sequence[float]) -> dict[str, float]:
    """Median and the worse end that matters, over what is finite."""
    known = np.array([value for value in values if np.isfinite(value)])
    if not len(known):
        return {"median": float("nan"), "p5": float("nan"), "p95": float("nan")}
    p5, median, p95 = (float(value) for value in np.percentile(known, (5, 50, 95)))
    return {"median": median, "p5": p5, "p95": p95}


def _pair(spread: dict[str, float], form: str) -> str:
    if not np.isfinite(spread["median"]):
        return "-"
    middle, low, high = (form.format(spread[name]) for name in ("median", "p5", "p95"))
    return f"{middle} ({low} to {high})"
