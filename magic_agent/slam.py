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
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magic_agent.mapping.mapper import Closing, Mapper, MappingBudget, MappingReport
from magic_agent.memory import SubmapMemory
from magic_agent.odometry import ActiveSubmap, Opening, anchor_overlap, hand_over_edge
from magic_agent.resume import ResumePoint
from magic_agent.slam_config import SlamConfig
from magic_agent.tracking import Tracker, TrackingResult
from magic_agent.tracking.refinement import CloudView, ReferenceView
from magic_core.data import Frame
from magic_core.gaussians import GaussianCloud
from magic_core.geometry import Camera, se3
from magic_core.render import RenderedView
from magic_core.submap import Descriptor, OdometryEdge, Submap

log = logging.getLogger(__name__)

Pose = NDArray[np.float64]
Describe = Callable[[NDArray[np.uint8]], Descriptor]

_EVEN_STEPS = 1e-3  # relative difference of two steps in time that is the clock's
_LONGEST_STEPS = 5.0  # a motion is believed to go on this many steps at most


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
    opening: Opening | None = None
    """How the sub-map begins that this frame opened."""
    tracked: TrackingResult | None = None
    """What the tracker said; None for the first frame of a chain."""
    mapped: MappingReport | None = None
    """What mapping did; None where the frame is no keyframe."""
    skipped_keyframe: bool = False
    """The frame should have become a keyframe, and there was no time."""


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
        resume: ResumePoint | None = None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        config.submap.validate()
        self._camera, self._config, self._clock = camera, config, clock
        self._session, self._agent, self._describe = session, agent, describe
        threads = config.threads or None
        self._mapper = Mapper(
            camera, config.mapping, threads=threads, seed=config.seed, clock=clock
        )
        self._tracker = Tracker(camera, config.tracking)
        self._next_index = first_submap_index
        self._prior = world_from_anchor_prior
        self._active: ActiveSubmap | None = None
        self._last: _Tracked | None = None
        self._before_last: Pose | None = None
        self._last_step_s = 0.0
        self._seen: RenderedView | None = None
        self._lost_in_a_row = 0
        self._opening: Opening | None = None
        self._memory: SubmapMemory | None = None
        if resume is not None:
            self._resume(resume)

    @property
    def mapper(self) -> Mapper:
        """The mapper, for viewers and evaluation; read only."""
        return self._mapper

    def process(self, frame: Frame, *, mapping_s: float | None = None) -> FrameResult:
        """Take in the next frame.

        mapping_s: the time that mapping may take, None for as long as the schedule asks. Where it
        is too short, the frame becomes a keyframe only if the sub-map no longer explains it, or
        ends with it: the way to keep up with a live camera.
        """
        if self._active is None:
            return self._first(frame, mapping_s)
        self._seen = None
        started = self._clock()
        tracked = self._track(frame, self._active)
        if tracked.lost:
            tracked = self._relocalised(frame) or tracked
        tracking_ms = 1e3 * (self._clock() - started)
        if tracked.lost:
            return self._on_lost(frame, self._active, tracked, tracking_ms, mapping_s)
        return self._on_tracked(frame, self._active, tracked, tracking_ms, mapping_s)

    def _resume(self, point: ResumePoint) -> None:
        """Go on where an earlier process was: its last hand-over, or only the sub-map before."""
        self._next_index = point.next_index
        if point.memory is not None:
            self._memory = SubmapMemory(point.memory, self._config)
        if point.opening is not None:
            opening = point.opening
            self._begin(
                opening.frame, odometry=opening.odometry, carried=opening.carried, mapping_s=None
            )

    def finish(self) -> Submap | None:
        """Close the last sub-map, all its Gaussians included; None where there is none."""
        if self._active is None:
            return None
        self._mapper.close()
        finished = self._submap(self._active, self._mapper.gaussians())
        self._active = None
        return finished

    def _first(self, frame: Frame, mapping_s: float | None) -> FrameResult:
        """The first frame of all, or the first after a lost stretch: the anchor of a new chain."""
        if not self._usable(frame):
            return self._result(frame, self._next_index, se3.identity(), lost=True)
        started = self._clock()
        mapped = self._begin(frame, odometry=self._remembered_edge(frame), mapping_s=mapping_s)
        return self._result(
            frame,
            self._next_index - 1,
            se3.identity(),
            mapping_ms=1e3 * (self._clock() - started),
            mapped=mapped,
        )

    def _track(self, frame: Frame, active: ActiveSubmap) -> TrackingResult:
        """Track against the last frame that has a pose, which may lie a few lost frames back."""
        assert self._last is not None
        return self._tracker.track(
            frame,
            self._last.frame,
            anchor_from_previous=self._last.anchor_from_camera,
            anchor_from_before_previous=self._pose_one_step_back(frame),
            reference=self._reference(),
        )

    def _reference(self) -> ReferenceView:
        """The active sub-map as the tracker sees it; first-order solvers need gradients of it."""
        if self._config.tracking.backend == "cuda":
            from magic_agent.tracking.torch_view import TorchView  # loads torch only when asked for

            return TorchView(self._mapper.gaussians(), self._camera)
        if self._config.tracking.solver == "adam":
            threads = self._config.threads or None
            return CloudView(self._mapper.gaussians(), self._camera, threads=threads)
        return self._look

    def _look(self, anchor_from_camera: Pose) -> RenderedView:
        """The active sub-map from a pose; mapping looks at the last such view again."""
        self._seen = self._mapper.render(anchor_from_camera)
        return self._seen

    def _pose_one_step_back(self, frame: Frame) -> Pose | None:
        """The pose before the last, put where a steady motion would have had it as long before the
        last frame as this one comes after: frames may be missing between them."""
        if self._before_last is None or self._last is None or self._lost_in_a_row:
            return None
        steps = (frame.timestamp_s - self._last.frame.timestamp_s) / self._last_step_s
        if abs(steps - 1.0) < _EVEN_STEPS:
            return self._before_last
        last = self._last.anchor_from_camera
        motion = se3.log(se3.inverse(self._before_last) @ last)
        return last @ se3.exp(-min(steps, _LONGEST_STEPS) * motion)

    def _relocalised(self, frame: Frame) -> TrackingResult | None:
        """The pose of a lost frame found from the active sub-map's keyframes, if it is there."""
        if not self._usable(frame):
            return None
        found = self._tracker.relocalise(frame, self._mapper.keyframes, reference=self._reference())
        self._seen = None  # The last view that was tried need not be the right one.
        found = found or self._found_in_memory(frame)
        if found is not None:
            log.info("agent %s: frame %d found again in its sub-map", self._agent, frame.index)
            self._tracker.reset()
        return found

    def _found_in_memory(self, frame: Frame) -> TrackingResult | None:
        """The pose, in the active sub-map, of a frame found in the one before the restart."""
        active, memory = self._active, self._memory
        if active is None or memory is None or active.odometry is None:
            return None
        if active.odometry.previous_index != memory.submap.index:
            return None
        found = memory.find(frame, self._tracker)
        if found is None:
            return None
        anchor_from_memory = se3.inverse(active.odometry.previous_from_anchor)
        return replace(found, anchor_from_camera=anchor_from_memory @ found.anchor_from_camera)

    def _remembered_edge(self, frame: Frame) -> OdometryEdge | None:
        """The edge from the sub-map before the restart to a frame that is found in it."""
        memory, self._memory = self._memory, None
        found = None if memory is None else memory.find(frame, self._tracker)
        if memory is None or found is None:
            return None
        self._tracker.reset()
        index = memory.submap.index
        log.info("agent %s: frame %d found in sub-map %d", self._agent, frame.index, index)
        return hand_over_edge(
            index, found.anchor_from_camera, found.information, self._config.submap
        )

    def _remember(self, frame: Frame, anchor_from_camera: Pose) -> None:
        """Note a frame that has a pose: the next one is tracked from here."""
        # Over a lost stretch the step between the two poses is no frame-to-frame motion.
        steady = self._last is not None and self._lost_in_a_row == 0
        self._before_last = self._last.anchor_from_camera if self._last and steady else None
        if self._last is not None:
            self._last_step_s = frame.timestamp_s - self._last.frame.timestamp_s
        self._last = _Tracked(frame, anchor_from_camera)
        self._lost_in_a_row = 0

    def _on_tracked(
        self,
        frame: Frame,
        active: ActiveSubmap,
        tracked: TrackingResult,
        tracking_ms: float,
        mapping_s: float | None,
    ) -> FrameResult:
        pose = tracked.anchor_from_camera
        self._remember(frame, pose)
        started = self._clock()
        due = active.is_due(
            pose, self._config.submap, overlap=lambda: self._overlap_with_anchor(frame, pose)
        )
        if due and self._usable(frame):
            edge = hand_over_edge(
                active.index,
                pose,
                tracked.information,
                self._config.submap,
                unseen=active.unseen,
            )
            finished, mapped = self._hand_over(frame, active, edge, mapping_s)
            pose, skipped = se3.identity(), False
        else:
            finished = None
            active.append(frame, pose, lost=False, unseen=tracked.unseen_covariance)
            mapped, skipped = self._map(frame, pose, mapping_s)
        return self._result(
            frame,
            self._next_index - 1,
            pose,
            tracking_ms=tracking_ms,
            mapping_ms=1e3 * (self._clock() - started),
            finished=finished,
            tracked=tracked,
            mapped=mapped,
            skipped_keyframe=skipped,
        )

    def _overlap_with_anchor(self, frame: Frame, anchor_from_camera: Pose) -> float:
        anchor = self._mapper.keyframes[0]
        return anchor_overlap(
            anchor.depth, frame.depth, camera=self._camera, anchor_from_camera=anchor_from_camera
        )

    def _map(
        self, frame: Frame, anchor_from_camera: Pose, mapping_s: float | None
    ) -> tuple[MappingReport | None, bool]:
        """(what mapping did with a tracked frame, whether it left out a keyframe)."""
        mapper, view = self._mapper, self._seen
        if not self._usable(frame) or not mapper.wants(frame, anchor_from_camera, view=view):
            return None, False
        late = mapping_s is not None and mapping_s < mapper.least_s
        if late and not mapper.lacks(frame, anchor_from_camera, view=view):
            return None, True
        budget = MappingBudget.within(mapping_s, mapper.config)
        return mapper.insert(frame, anchor_from_camera, budget=budget), False

    def _on_lost(
        self,
        frame: Frame,
        active: ActiveSubmap,
        tracked: TrackingResult,
        tracking_ms: float,
        mapping_s: float | None,
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
        closing, mapping_s = self._close(mapping_s)
        finished, self._memory = self._submap(active, self._mapper.gaussians()), None
        self._tracker.begin_chain()
        mapped = closing.added_to(self._begin(frame, odometry=None, mapping_s=mapping_s))
        return self._result(
            frame,
            self._next_index - 1,
            se3.identity(),
            tracking_ms=tracking_ms,
            mapping_ms=1e3 * (self._clock() - started),
            finished=finished,
            tracked=tracked,
            mapped=mapped,
        )

    def _hand_over(
        self, frame: Frame, active: ActiveSubmap, edge: OdometryEdge, mapping_s: float | None
    ) -> tuple[Submap, MappingReport]:
        closing, mapping_s = self._close(mapping_s)
        sent, kept = self._mapper.split(edge.previous_from_anchor)
        if self._config.submap.send_all:
            sent = self._mapper.gaussians()
        finished = self._submap(active, sent)
        before, self._memory = self._before_last, None
        mapped = self._begin(frame, odometry=edge, carried=kept, mapping_s=mapping_s)
        if mapped.reexposed:
            self._tracker.submap_reexposed()
        if before is not None:  # the motion goes on across the seam
            self._before_last = se3.inverse(edge.previous_from_anchor) @ before
        return finished, closing.added_to(mapped)

    def _close(self, mapping_s: float | None) -> tuple[Closing, float | None]:
        """Close the active sub-map's optimisation; returns also the time that is left for the next
        one's anchor, which comes first where time is short."""
        if mapping_s is None:
            return self._mapper.close(), None
        spare = MappingBudget(seconds=mapping_s - self._mapper.least_s)
        closing = self._mapper.close(budget=spare)
        return closing, mapping_s - closing.seconds

    def _begin(
        self,
        frame: Frame,
        *,
        odometry: OdometryEdge | None,
        carried: GaussianCloud | None = None,
        mapping_s: float | None,
    ) -> MappingReport:
        """Start the next sub-map with this frame as anchor."""
        self._opening = Opening(frame, odometry, carried)
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
        budget = MappingBudget.within(mapping_s, self._mapper.config)
        return self._mapper.begin(frame, carried=carried, budget=budget)

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
        finished: Submap | None = None,
        tracked: TrackingResult | None = None,
        mapped: MappingReport | None = None,
        skipped_keyframe: bool = False,
    ) -> FrameResult:
        return FrameResult(
            frame_index=frame.index,
            timestamp_s=frame.timestamp_s,
            submap_index=submap_index,
            anchor_from_camera=pose,
            tracking_ms=tracking_ms,
            mapping_ms=mapping_ms,
            lost=lost,
            is_keyframe=mapped is not None,
            finished=finished,
            opening=self._opening if finished is not None else None,
            tracked=tracked,
            mapped=mapped,
            skipped_keyframe=skipped_keyframe,
        )
