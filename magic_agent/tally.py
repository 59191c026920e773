"""What one agent counted while it ran, and the tracked trajectory that its sub-maps add up to."""

from __future__ import annotations

import resource
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magic_agent.slam import FrameResult
from magic_core.evaluation import AgentReport, Trajectory, WireBytes
from magic_core.geometry import Camera, se3
from magic_core.submap import Submap


@dataclass(slots=True)
class Tally:
    """Counters of one agent; `report` turns them into the record that evaluation reads."""

    agent: str
    frames: int = 0
    lost_frames: int = 0
    dropped_frames: int = 0
    """Frames skipped because the source ran in real time and the agent could not keep up."""
    skipped_keyframes: int = 0
    """Keyframes that were left out for the same reason."""
    mapping_steps: int = 0
    """Optimisation steps taken."""
    cut_mapping_steps: int = 0
    """Optimisation steps of the schedule that keyframes did not get for the same reason."""
    late_ms: list[float] = field(default_factory=list)
    """Per frame of a live source, the time from when it was due to its tracking."""
    acknowledged: int = 0
    """Sub-maps that the server has said are durable."""
    revisions_seen: int = 0
    """Revisions of the pose graph that reached the agent while it ran."""
    completed: bool = False
    """True when every sub-map was acknowledged and the server knows that no more will come."""
    wall_s: float = 0.0
    keyframes: list[int] = field(default_factory=list)
    tracking_ms: list[float] = field(default_factory=list)
    mapping_ms: list[float] = field(default_factory=list)
    wire_bytes: list[WireBytes] = field(default_factory=list)
    first_frames: list[int] = field(default_factory=list)
    _odometry_from_anchor: NDArray[np.float64] = field(default_factory=se3.identity)
    _tracked: list[tuple[float, NDArray[np.float64]]] = field(default_factory=list)

    def add_frame(self, result: FrameResult) -> None:
        """Count one processed frame."""
        self.frames += 1
        self.lost_frames += int(result.lost)
        self.tracking_ms.append(round(result.tracking_ms, 3))
        self.mapping_ms.append(round(result.mapping_ms, 3))
        self.skipped_keyframes += int(result.skipped_keyframe)
        if result.mapped is not None:
            self.keyframes.append(result.frame_index)
            self.mapping_steps += result.mapped.iterations
            self.cut_mapping_steps += result.mapped.cut_iterations

    def add_submap(self, submap: Submap) -> None:
        """Append a finished sub-map's frames to the trajectory in the agent's odometry frame.

        Lost frames are left out: the pose that is held for them was never seen.
        """
        if submap.odometry is not None:
            self._odometry_from_anchor = (
                self._odometry_from_anchor @ submap.odometry.previous_from_anchor
            )
        elif self._tracked:  # a new odometry chain: nothing better is known than the last pose
            self._odometry_from_anchor = self._tracked[-1][1]
        self.first_frames.append(submap.trajectory[0].frame_index)
        self._tracked += [
            (frame.timestamp_s, self._odometry_from_anchor @ frame.anchor_from_camera)
            for frame in submap.trajectory
            if not frame.lost
        ]

    def to_json(self) -> dict[str, Any]:
        """Everything, as JSON takes it; `from_json` gives it again."""
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        values["wire_bytes"] = [[size.compact, size.lossless] for size in self.wire_bytes]
        values["_odometry_from_anchor"] = self._odometry_from_anchor.tolist()
        values["_tracked"] = [[time_s, pose.tolist()] for time_s, pose in self._tracked]
        return {name: list(v) if isinstance(v, list) else v for name, v in values.items()}

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Tally:
        """The tally of `to_json`'s values."""
        known = {each.name for each in fields(cls)}
        tally = cls(**{name: value for name, value in values.items() if name in known})
        tally.wire_bytes = [WireBytes(*sizes) for sizes in values["wire_bytes"]]
        tally._odometry_from_anchor = np.array(values["_odometry_from_anchor"])
        tally._tracked = [(time_s, np.array(pose)) for time_s, pose in values["_tracked"]]
        return tally

    def trajectory(self) -> Trajectory:
        """The tracked trajectory: odometry alone, no correction."""
        return Trajectory.from_poses(self._tracked)

    def report(self, *, camera: Camera, dataset: str, scale: float) -> AgentReport:
        """The record for `agents/{agent}/report.json`."""
        return AgentReport(
            agent=self.agent,
            frames=self.frames,
            lost_frames=self.lost_frames,
            submaps=len(self.first_frames),
            keyframes=tuple(self.keyframes),
            camera=camera,
            dataset=dataset,
            scale=scale,
            tracking_ms=tuple(self.tracking_ms),
            mapping_ms=tuple(self.mapping_ms),
            wire_bytes=tuple(self.wire_bytes),
            peak_rss_bytes=peak_rss_bytes(),
            wall_s=round(self.wall_s, 3),
            submap_first_frames=tuple(self.first_frames),
            dropped_frames=self.dropped_frames,
            skipped_keyframes=self.skipped_keyframes,
            mapping_steps=self.mapping_steps,
            cut_mapping_steps=self.cut_mapping_steps,
            late_ms=tuple(self.late_ms),
        )


def peak_rss_bytes() -> int:
    """Largest resident memory of this process so far.

    Linux carries `ru_maxrss` of the starting process over to the started one, so the kernel's
    high-water mark of this process's own memory is read where there is one.
    """
    status = Path("/proc/self/status")
    if status.exists():
        for line in status.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    unit = 1 if sys.platform == "darwin" else 1024  # macOS counts bytes, others kilobytes
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
