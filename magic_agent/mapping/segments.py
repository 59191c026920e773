"""A recording cut into sub-maps with given poses: what mapping is compared on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from magic_agent.odometry import ActiveSubmap
from magic_agent.slam import LocalSlam
from magic_agent.slam_config import SlamConfig, SubmapConfig
from magic_core.data import Frame, FrameSource
from magic_core.errors import ConfigError
from magic_core.geometry import se3
from magic_core.submap import Descriptor

Poses = Literal["truth", "tracked"]
Pose = NDArray[np.float64]

_NO_DESCRIPTOR = Descriptor("none", np.ones(1, np.float32))


@dataclass(frozen=True, slots=True)
class Segment:
    """The frames of one sub-map; the first is the anchor."""

    frames: tuple[Frame, ...]
    anchor_from_camera: tuple[Pose, ...]
    anchor_from_next: Pose | None
    """The next sub-map's anchor in this one; None at the end of a chain."""


def segments_of(source: FrameSource, config: SlamConfig, poses: Poses) -> list[Segment]:
    """Cut a recording into sub-maps as an agent would, with true or with tracked poses."""
    if poses == "truth":
        return _true_segments(source, config.submap)
    return _tracked_segments(source, config)


def _true_segments(source: FrameSource, config: SubmapConfig) -> list[Segment]:
    segments: list[Segment] = []
    frames: list[Frame] = []
    inside: list[Pose] = []
    active = _new_submap()
    for frame in source:
        if frame.world_from_camera is None:
            raise ConfigError.field(
                "poses", f"truth: {source.name} has no ground truth; use --poses tracked"
            )
        anchor = frames[0].world_from_camera if frames else frame.world_from_camera
        assert anchor is not None
        pose = se3.inverse(anchor) @ frame.world_from_camera
        if frames and active.is_due(pose, config):
            segments.append(Segment(tuple(frames), tuple(inside), pose))
            frames, inside, active = [], [], _new_submap()
            pose = se3.identity()
        active.append(frame, pose, lost=False)
        frames.append(frame)
        inside.append(pose)
    return [*segments, Segment(tuple(frames), tuple(inside), None)]


def _new_submap() -> ActiveSubmap:
    return ActiveSubmap(index=0, odometry=None, descriptor=_NO_DESCRIPTOR, prior=None)


def _tracked_segments(source: FrameSource, config: SlamConfig) -> list[Segment]:
    """The sub-maps of one run of local SLAM; lost frames are left out."""
    slam = LocalSlam(
        source.camera, config, session="bench", agent=source.name, describe=lambda _: _NO_DESCRIPTOR
    )
    frames = {frame.index: frame for frame in source}
    finished = [slam.process(frame).finished for frame in frames.values()]
    submaps = [submap for submap in (*finished, slam.finish()) if submap is not None]
    segments = []
    for submap, after in zip(submaps, [*submaps[1:], None], strict=True):
        known = [tracked for tracked in submap.trajectory if not tracked.lost]
        edge = after.odometry if after is not None else None
        segments.append(
            Segment(
                tuple(frames[tracked.frame_index] for tracked in known),
                tuple(tracked.anchor_from_camera for tracked in known),
                edge.previous_from_anchor if edge is not None else None,
            )
        )
    return segments
