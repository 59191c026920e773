"""Image pyramids of the newest frames, each built once and used by every stage."""

from __future__ import annotations

from collections import OrderedDict

from magic_agent.tracking.pyramid import Pyramid, image_pyramid
from magic_core.data import Frame
from magic_core.geometry import Camera


class PyramidCache:
    """Keeps the pyramids of the last few frames by their identity."""

    def __init__(self, camera: Camera, levels: int, *, capacity: int = 3) -> None:
        self._camera = camera
        self._levels = levels
        self._capacity = capacity
        self._pyramids: OrderedDict[int, tuple[Frame, Pyramid]] = OrderedDict()

    def get(self, frame: Frame) -> Pyramid:
        """The frame's pyramid, built on first use."""
        kept = self._pyramids.get(id(frame))
        if kept is None or kept[0] is not frame:
            pyramid = image_pyramid(
                frame.colour, frame.depth, camera=self._camera, levels=self._levels
            )
            kept = (frame, pyramid)
            self._pyramids[id(frame)] = kept
            while len(self._pyramids) > self._capacity:
                self._pyramids.popitem(last=False)
        return kept[1]
