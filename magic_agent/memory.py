"""The sub-map before, remembered from its keyframes: where a restarted agent looks for itself.

The Gaussians of a finished sub-map lack what the next one took over, which is just what a camera
sees that goes on from there. So the model to register against is made anew from the keyframes,
whose poses are known.
"""

from __future__ import annotations

from magic_agent.mapping.mapper import Mapper, MappingBudget
from magic_agent.slam_config import SlamConfig
from magic_agent.tracking import Tracker, TrackingResult
from magic_agent.tracking.refinement import CloudView
from magic_core.data import Frame
from magic_core.submap import Keyframe, Submap

_STEPS_PER_KEYFRAME = 8


class SubmapMemory:
    """Finds frames in a finished sub-map."""

    def __init__(self, submap: Submap, config: SlamConfig) -> None:
        self.submap = submap
        self._config = config
        self._mapper: Mapper | None = None

    def find(self, frame: Frame, tracker: Tracker) -> TrackingResult | None:
        """The pose of a frame in the sub-map's anchor frame; None when it is not there."""
        mapper = self._mapper = self._mapper or self._model()
        threads = self._config.threads or None
        reference = CloudView(mapper.gaussians(), self.submap.camera, threads=threads)
        return tracker.relocalise(frame, self.submap.keyframes, reference=reference)

    def _model(self) -> Mapper:
        config = self._config
        threads = config.threads or None
        mapper = Mapper(self.submap.camera, config.mapping, threads=threads, seed=config.seed)
        budget = MappingBudget(iterations=_STEPS_PER_KEYFRAME)
        anchor, *others = self.submap.keyframes
        mapper.begin(_frame(anchor), budget=budget)
        for keyframe in others:
            mapper.insert(_frame(keyframe), keyframe.anchor_from_camera, budget=budget)
        return mapper


def _frame(keyframe: Keyframe) -> Frame:
    return Frame(keyframe.frame_index, keyframe.timestamp_s, keyframe.colour, keyframe.depth)
