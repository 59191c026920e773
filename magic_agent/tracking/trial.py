"""One configuration over one agent's frames, without loop closure: what a benchmark compares."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from magic_agent.slam import FrameResult, LocalSlam
from magic_agent.slam_config import SlamConfig
from magic_core.data import Frame
from magic_core.errors import ConfigError
from magic_core.evaluation.ate import ate_rmse
from magic_core.evaluation.trajectory import Trajectory
from magic_core.geometry import Camera
from magic_core.submap import Descriptor, Submap


@dataclass(slots=True)
class AgentRun:
    """What one configuration did on one agent's frames."""

    ate_rmse_m: float = float("nan")
    """Over all frames with a pose; each part between breaks is aligned on its own."""
    frames: int = 0
    lost_frames: int = 0
    """Frames without a pose."""
    breaks: int = 0
    """Sub-maps that began without odometry, beyond the first."""
    frames_ms: list[float] = field(default_factory=list)
    """Wall time of tracking, frame by frame; the first of a chain is not tracked."""
    stages_ms: dict[str, list[float]] = field(default_factory=dict)
    mapping_ms: list[float] = field(default_factory=list)

    def add(self, result: FrameResult) -> None:
        """Note one frame."""
        self.frames += 1
        self.lost_frames += result.lost
        self.mapping_ms.append(result.mapping_ms)
        if result.tracked is None:
            return
        self.frames_ms.append(result.tracking_ms)
        for stage, elapsed_ms in result.tracked.stages_ms.items():
            self.stages_ms.setdefault(stage, []).append(elapsed_ms)


class Trial:
    """Local SLAM of one agent, frame by frame, beside the true poses of its frames."""

    def __init__(self, name: str, camera: Camera, config: SlamConfig) -> None:
        self._name = name
        self._slam = LocalSlam(camera, config, session="bench", agent=name, describe=_no_descriptor)
        self._truth: list[tuple[float, NDArray[np.float64]]] = []
        self._run = AgentRun()
        self.chain = Chain()
        """The trajectory so far, of finished sub-maps."""

    @property
    def truth(self) -> Trajectory:
        """True poses of the frames so far."""
        return Trajectory.from_poses(self._truth)

    def process(self, frame: Frame) -> FrameResult:
        """Take in the next frame; raises ConfigError if its true pose is unknown."""
        if frame.world_from_camera is None:
            raise ConfigError.field("dataset", f"{self._name} has no ground truth to compare with")
        self._truth.append((frame.timestamp_s, frame.world_from_camera))
        result = self._slam.process(frame)
        self._run.add(result)
        self.chain.add(result.finished)
        return result

    def finish(self) -> AgentRun:
        """Close the last sub-map and report."""
        self.chain.add(self._slam.finish())
        self._run.ate_rmse_m = self.chain.ate_rmse_m(self.truth)
        self._run.breaks = self.chain.breaks
        return self._run


class Chain:
    """Finished sub-maps joined by their odometry; a sub-map without odometry begins a new part."""

    def __init__(self) -> None:
        self._parts: list[list[tuple[float, NDArray[np.float64]]]] = []
        self._world_from_anchor = np.eye(4)

    @property
    def breaks(self) -> int:
        """Parts beyond the first."""
        return max(len(self._parts) - 1, 0)

    @property
    def parts(self) -> list[Trajectory]:
        """One trajectory per part, each in the frame of its own first anchor; lost frames are
        not in it."""
        return [Trajectory.from_poses(part) for part in self._parts if part]

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
        """RMSE over all parts, each aligned on its own: where one ends, nothing was claimed.

        NaN where no frame has a pose.
        """
        squares, count = 0.0, 0
        for part in self.parts:
            squares += len(part) * ate_rmse(part, truth)[0] ** 2
            count += len(part)
        return float(np.sqrt(squares / count)) if count else float("nan")


def _no_descriptor(colour: NDArray[np.uint8]) -> Descriptor:
    """Loops are off: nobody will look at it."""
    return Descriptor("none", np.ones(1, np.float32))
