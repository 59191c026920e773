"""One agent's local SLAM: track every frame, map keyframes, hand sub-maps over.

A synchronous engine without network: frames go in, results and finished sub-maps come out. The
first frame of a sub-map is its anchor. At a hand-over the current frame, refined against the old,
becomes the next anchor, and its pose in the old sub-map is the odometry edge: no drift is born at
the seam. Gaussians that the next anchor sees move over to the new sub-map, so that tracking goes on
against a full map; the others are sent. Every Gaussian is thus sent exactly once.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magic_agent.mapping.mapper import Mapper
from magic_agent.odometry import ActiveSubmap, hand_over_edge
from magic_agent.slam_config import SlamConfig
from magic_agent.tracking import Tracker, TrackingResult
from magic_agent.tracking.refinement import CloudView, ReferenceView
from magic_core.data import Frame
from magic_core.gaussians import GaussianCloud
from magic_core.geometry import Camera, se3
from magic_core.submap import Descriptor, OdometryEdge, Submap

log = logging.getLogger(__name__)

Pose = NDArray[np.float64]
Describe = Callable[[NDArray[np.uint8]], Descriptor]


@dataclass(frozen=True, slots=True)
class FrameResult:
    """What became of one frame."""

    frame_index: int
    timestamp_s: float
    submap_index: int
    """The sub-map that the frame belongs to (the new one where the frame is its anchor)."""
    anchor_from_camera: Pose
    """In that sub-map; where `lost`, the last pose that was known."""
    tracking_ms: float
    mapping_ms: float
    lost: bool
    is_keyframe: bool
    finished: Submap | None
    """The sub-map that this frame closed."""
    tracked: TrackingResult | None = None
    """What the tracker said; None for the first frame of a chain."""


@dataclass(frozen=True, slots=True)
class _Tracked:
    """A frame with a pose."""

    frame: Frame
    anchor_from_camera: Pose


class LocalSlam:
    """Tracking, mapping and sub-map hand-over of one agent."""

    def __init__(
        self,
        camera: Camera,
        config: SlamConfig,
        *,
        session: str,
        agent: str,
        describe: Describe,
        first_submap_index: int = 0,
        world_from_anchor_prior: Pose | None = None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        config.submap.validate()
        self._camera, self._config, self._clock = camera, config, clock
        self._session, self._agent, self._describe = session, agent, describe
        threads = config.threads or None
        self._mapper = Mapper(camera, config.mapping, threads=threads, seed=config.seed)
        self._tracker = Tracker(camera, config.tracking)
        self._next_index = first_submap_index
        self._prior = world_from_anchor_prior
        self._active: ActiveSubmap | None = None
        self._last: _Tracked | None = None
        self._before_last: Pose | None = None
        self._lost_in_a_row = 0

    @property
    def mapper(self) -> Mapper:
        """The mapper, for viewers and evaluation; read only."""
        return self._mapper

    def process(self, frame: Frame, *, mapping: bool = True) -> FrameResult:
        """Take in the next frame. With `mapping=False` it is tracked but never becomes a keyframe,
        unless a sub-map ends with it: the way to catch up with a live camera."""
        if self._active is None:
            return self._first(frame)
        started = self._clock()
        tracked = self._track(frame, self._active)
        if tracked.lost:
            tracked = self._relocalised(frame) or tracked
        tracking_ms = 1e3 * (self._clock() - started)
        if tracked.lost:
            return self._on_lost(frame, self._active, tracked, tracking_ms)
        return self._on_tracked(frame, self._active, tracked, tracking_ms, mapping)

    def finish(self) -> Submap | None:
        """Close the last sub-map, all its Gaussians included; None where there is none."""
        if self._active is None:
            return None
        finished = self._submap(self._active, self._mapper.gaussians())
        self._active = None
        return finished

    def _first(self, frame: Frame) -> FrameResult:
        """The first frame of all, or the first after a lost stretch: the anchor of a new chain."""
        if not self._usable(frame):
            return self._result(frame, self._next_index, se3.identity(), lost=True)
        started = self._clock()
        self._begin(frame, odometry=None)
        return self._result(
            frame,
            self._next_index - 1,
            se3.identity(),
            mapping_ms=1e3 * (self._clock() - started),
            is_keyframe=True,
        )

    def _track(self, frame: Frame, active: ActiveSubmap) -> TrackingResult:
        """Track against the last frame that has a pose, which may lie a few lost frames back."""
        assert self._last is not None
        return self._tracker.track(
            frame,
            self._last.frame,
            anchor_from_previous=self._last.anchor_from_camera,
            anchor_from_before_previous=None if self._lost_in_a_row else self._before_last,
            reference=self._reference(),
        )

    def _reference(self) -> ReferenceView:
        """The active sub-map as the tracker sees it; first-order solvers need gradients of it."""
        if self._config.tracking.solver == "adam":
            threads = self._config.threads or None
            return CloudView(self._mapper.gaussians(), self._camera, threads=threads)
        return self._mapper.render

    def _relocalised(self, frame: Frame) -> TrackingResult | None:
        """The pose of a lost frame found from the active sub-map's keyframes, if it is there."""
        if not self._usable(frame):
            return None
        found = self._tracker.relocalise(frame, self._mapper.keyframes, reference=self._reference())
        if found is not None:
            log.info("agent %s: frame %d found again in its sub-map", self._agent, frame.index)
            self._tracker.reset()
        return found

    def _remember(self, frame: Frame, anchor_from_camera: Pose) -> None:
        """Note a frame that has a pose: the next one is tracked from here."""
        # Over a lost stretch the step between the two poses is no frame-to-frame motion.
        steady = self._last is not None and self._lost_in_a_row == 0
        self._before_last = self._last.anchor_from_camera if self._last and steady else None
        self._last = _Tracked(frame, anchor_from_camera)
        self._lost_in_a_row = 0

    def _on_tracked(
        self,
        frame: Frame,
        active: ActiveSubmap,
        tracked: TrackingResult,
        tracking_ms: float,
        mapping: bool,
    ) -> FrameResult:
        pose = tracked.anchor_from_camera
        self._remember(frame, pose)
        started = self._clock()
        if active.is_due(pose, self._config.submap) and self._usable(frame):
            edge = hand_over_edge(active.index, pose, tracked.information, self._config.submap)
            finished = self._hand_over(frame, active, edge)
            pose, is_keyframe = se3.identity(), True
        else:
            finished = None
            active.append(frame, pose, lost=False)
            is_keyframe = mapping and self._usable(frame) and self._mapper.wants(frame, pose)
            if is_keyframe:
                self._mapper.insert(frame, pose)
        return self._result(
            frame,
            self._next_index - 1,
            pose,
            tracking_ms=tracking_ms,
            mapping_ms=1e3 * (self._clock() - started),
            is_keyframe=is_keyframe,
            finished=finished,
            tracked=tracked,
        )

    def _on_lost(
        self, frame: Frame, active: ActiveSubmap, tracked: TrackingResult, tracking_ms: float
    ) -> FrameResult:
        """Hold the last pose for a while; then close the sub-map and start one without odometry."""
        self._lost_in_a_row += 1
        usable = self._usable(frame)
        if not usable or self._lost_in_a_row < self._config.submap.max_lost_frames:
            active.append(frame, active.last_pose, lost=True)
            return self._result(
                frame,
                active.index,
                active.last_pose,
                tracking_ms=tracking_ms,
                lost=True,
                tracked=tracked,
            )
        log.warning(
            "agent %s lost for %d frames: frame %d starts sub-map %d without odometry",
            self._agent, self._lost_in_a_row, frame.index, self._next_index,
        )  # fmt: skip
        started = self._clock()
        finished = self._submap(active, self._mapper.gaussians())
        self._tracker.reset()
        self._begin(frame, odometry=None)
        return self._result(
            frame,
            self._next_index - 1,
            se3.identity(),
            tracking_ms=tracking_ms,
            mapping_ms=1e3 * (self._clock() - started),
            is_keyframe=True,
            finished=finished,
            tracked=tracked,
        )

    def _hand_over(self, frame: Frame, active: ActiveSubmap, edge: OdometryEdge) -> Submap:
        sent, kept = self._mapper.split(edge.previous_from_anchor)
        finished = self._submap(active, sent)
        before = self._before_last
        self._begin(frame, odometry=edge, carried=kept)
        if before is not None:  # the motion goes on across the seam
            self._before_last = se3.inverse(edge.previous_from_anchor) @ before
        return finished

    def _begin(
        self,
        frame: Frame,
        *,
        odometry: OdometryEdge | None,
        carried: GaussianCloud | None = None,
    ) -> None:
        """Start the next sub-map with this frame as anchor."""
        self._active = ActiveSubmap(
            index=self._next_index,
            odometry=odometry,
            descriptor=self._describe(frame.colour),
            prior=self._prior,
        )
        self._active.append(frame, se3.identity(), lost=False)
        self._last, self._before_last = _Tracked(frame, se3.identity()), None
        self._lost_in_a_row = 0
        self._next_index += 1
        self._prior = None  # It places the first anchor alone; the rest follows from odometry.
        self._mapper.begin(frame, carried=carried)

    def _submap(self, active: ActiveSubmap, gaussians: GaussianCloud) -> Submap:
        return Submap(
            session=self._session,
            agent=self._agent,
            index=active.index,
            camera=self._camera,
            gaussians=gaussians,
            keyframes=self._mapper.keyframes,
            trajectory=tuple(active.trajectory),
            descriptor=active.descriptor,
            odometry=active.odometry,
            world_from_anchor_prior=active.prior,
        )

    def _usable(self, frame: Frame) -> bool:
        """Whether a frame can be mapped: enough depth readings, and not a black image."""
        lost = self._config.tracking.lost
        return (
            float((frame.depth > 0).mean()) >= self._config.submap.min_depth_share
            and float(frame.colour.std()) / 255.0 >= lost.min_contrast
        )

    def _result(
        self,
        frame: Frame,
        submap_index: int,
        pose: Pose,
        *,
        tracking_ms: float = 0.0,
        mapping_ms: float = 0.0,
        lost: bool = False,
        is_keyframe: bool = False,
        finished: Submap | None = None,
        tracked: TrackingResult | None = None,
    ) -> FrameResult:
        return FrameResult(
            frame_index=frame.index,
            timestamp_s=frame.timestamp_s,
            submap_index=submap_index,
            anchor_from_camera=pose,
            tracking_ms=tracking_ms,
            mapping_ms=mapping_ms,
            lost=lost,
            is_keyframe=is_keyframe,
            finished=finished,
            tracked=tracked,
        )
