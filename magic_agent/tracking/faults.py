"""Faults of a camera, played into a recording, and what local SLAM made of each.

A fault replaces a stretch of frames: a black image, a blind depth sensor, a covered lens, exposure
that jumps, a camera carried elsewhere and back. Afterwards every pose that was claimed is compared
with the truth: a lost frame may be missing, it may never be wrong.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from magic_agent.slam_config import SlamConfig
from magic_agent.tracking.trial import Trial
from magic_core.data import Frame, FrameSource, open_dataset
from magic_core.errors import ConfigError
from magic_core.evaluation.ate import ate_rmse
from magic_core.evaluation.trajectory import Trajectory
from magic_core.geometry import se3

START = 40
"""First frame of every fault: late enough for a sub-map worth losing."""
AFTER = 40
"""Frames that are played after a fault has ended."""
TOLERANCE_M = 0.03
"""A claimed position farther off than the undisturbed run's worst by more than this is wrong."""

Progress = Callable[[str], None]
Delivered = Callable[[int], Frame]
"""The frame that the camera delivers for an index."""


@dataclass(frozen=True, slots=True)
class Fault:
    """What goes wrong with a camera, and for how many frames."""

    frames: int
    damage: Callable[[FrameSource, int], Delivered]
    """(source, first index of the fault) -> the frames that are delivered instead."""


Outcome = Literal["unharmed", "recovered", "declared", "wrong"]


@dataclass(frozen=True, slots=True)
class FaultReport:
    """What became of one run with a fault."""

    outcome: Outcome
    """`recovered`: frames were lost, and the chain goes on. `declared`: it ended, and a sub-map
    without odometry began. `wrong`: a pose was claimed that is not true."""
    lost_frames: int
    lost_after: int | None
    """Frames from the beginning of the fault to the first that was lost; None if none was."""
    breaks: int
    ate_rmse_m: float
    """Of all claimed poses, each part between breaks aligned on its own."""
    worst_m: float
    """Largest position error of a claimed pose within its part."""


def run_faults(
    dataset: Path | str,
    *,
    scale: float = 0.5,
    names: Sequence[str] | None = None,
    config: SlamConfig | None = None,
    agents: Sequence[str] | None = None,
    progress: Progress | None = None,
) -> dict:
    """Play each fault (default: all) to each agent; the result is ready for JSON."""
    names = list(FAULTS if names is None else names)
    if unknown := sorted(set(names) - set(FAULTS)):
        raise ConfigError(f"faults {', '.join(unknown)}: expected some of {', '.join(FAULTS)}")
    found: dict[str, dict[str, dict]] = {}
    for source in open_dataset(dataset, scale=scale):
        if agents is not None and source.name not in agents:
            continue
        reports = play_all(source, config or SlamConfig(), names=names, progress=progress)
        found[source.name] = {name: asdict(report) for name, report in reports.items()}
    if not found:
        raise ConfigError(f"agents {', '.join(agents or [])}: {dataset} has none of these")
    wrong = sum(
        report["outcome"] == "wrong" for reports in found.values() for report in reports.values()
    )
    return {"dataset": str(dataset), "scale": scale, "faults": found, "wrong": wrong}


def play_all(
    source: FrameSource,
    config: SlamConfig,
    *,
    names: Sequence[str],
    start: int = START,
    after: int = AFTER,
    progress: Progress | None = None,
) -> dict[str, FaultReport]:
    """Each fault's report on one source, which must have ground truth."""
    longest = max(FAULTS[name].frames for name in names)
    undisturbed = _played(source, config, source.__getitem__, start, start + longest + after)
    reports = {"none": undisturbed}
    for name in names:
        fault = FAULTS[name]
        delivered = _delivered(source, fault, start)
        report = _played(source, config, delivered, start, start + fault.frames + after)
        if report.worst_m > undisturbed.worst_m + TOLERANCE_M:
            report = replace(report, outcome="wrong")
        reports[name] = report
        if progress is not None:
            progress(
                f"{source.name} {name}: {report.outcome}, {report.lost_frames} lost, "
                f"{report.breaks} breaks, ATE {100 * report.ate_rmse_m:.2f} cm, "
                f"worst {100 * report.worst_m:.2f} cm"
            )
    return reports


def _delivered(source: FrameSource, fault: Fault, start: int) -> Delivered:
    damaged = fault.damage(source, start)
    return lambda index: damaged(index) if start <= index < start + fault.frames else source[index]


def _played(
    source: FrameSource, config: SlamConfig, delivered: Delivered, start: int, end: int
) -> FaultReport:
    trial, lost = Trial(source.name, source.camera, config), []
    for index in range(min(end, len(source))):
        lost.append(trial.process(delivered(index)).lost)
    run = trial.finish()
    during = [index - start for index in range(start, len(lost)) if lost[index]]
    outcome: Outcome = "declared" if run.breaks else "recovered" if run.lost_frames else "unharmed"
    return FaultReport(
        outcome=outcome,
        lost_frames=run.lost_frames,
        lost_after=during[0] if during else None,
        breaks=run.breaks,
        ate_rmse_m=run.ate_rmse_m,
        worst_m=max((_worst_m(part, trial.truth) for part in trial.chain.parts), default=0.0),
    )


def _worst_m(part: Trajectory, truth: Trajectory) -> float:
    """Largest position error of a part after it was aligned with the truth."""
    aligned = part.transformed(ate_rmse(part, truth)[1])
    nearest = np.abs(aligned.timestamps_s[:, None] - truth.timestamps_s).argmin(axis=1)
    return float(np.linalg.norm(aligned.positions - truth.positions[nearest], axis=1).max())


def _black(source: FrameSource, start: int) -> Delivered:
    return lambda i: replace(source[i], colour=np.zeros_like(source[i].colour))


def _blind(source: FrameSource, start: int) -> Delivered:
    return lambda i: replace(source[i], depth=np.zeros_like(source[i].depth))


def _covered(source: FrameSource, start: int) -> Delivered:
    black = _black(source, start)
    return lambda i: replace(black(i), depth=np.zeros_like(source[i].depth))


def _exposed(factor: float) -> Callable[[FrameSource, int], Delivered]:
    def shown(colour: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return np.clip(factor * colour.astype(np.float32), 0.0, 255.0).astype(np.uint8)

    return lambda source, start: lambda i: replace(source[i], colour=shown(source[i].colour))


def _elsewhere(source: FrameSource, start: int) -> Delivered:
    """The frames of the place that looks least like that of frame `start`, at their new time."""
    first = _farthest(source, start)

    def delivered(index: int) -> Frame:
        shown, frame = source[min(first + index - start, len(source) - 1)], source[index]
        return replace(shown, index=frame.index, timestamp_s=frame.timestamp_s)

    return delivered


def _farthest(source: FrameSource, start: int) -> int:
    """Index of the frame whose camera is turned and moved farthest from that of frame `start`."""
    indices = range(0, len(source), 5)
    poses = [source[index].world_from_camera for index in (start, *indices)]
    if any(pose is None for pose in poses):
        raise ConfigError.field("dataset", f"{source.name} has no ground truth to compare with")
    here, *others = [pose for pose in poses if pose is not None]
    off = [se3.inverse(here) @ other for other in others]
    distances = [se3.rotation_angle(each) + np.linalg.norm(each[:3, 3]) / 2.0 for each in off]
    return indices[int(np.argmax(distances))]


FAULTS = {
    "black": Fault(20, _black),
    "no depth": Fault(20, _blind),
    "covered": Fault(20, _covered),
    "darker": Fault(40, _exposed(0.5)),
    "brighter": Fault(40, _exposed(1.5)),
    "kidnap": Fault(30, _elsewhere),
}
"""Faults by name: black colours, no depth, both, exposure halved and half as much again for a
while (two steps each), and a camera carried elsewhere and back."""
