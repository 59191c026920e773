"""A few earlier images that the current one is aligned with, beside the rendered sub-map.

A raw RGB-D image is sharp and does not move when the map is optimised, so its pose cannot creep
along with tracking errors that were mapped; as long as it overlaps with the current image it pins
the pose. Poses are kept relative to the last tracked frame, hence they do not care where one
sub-map ends and the next begins.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magic_agent.tracking.config import KeyframeWindowConfig
from magic_agent.tracking.exposure import SAME, Exposure
from magic_agent.tracking.gauss_newton import View, ViewFit
from magic_agent.tracking.pyramid import Pyramid, keyframe_pyramid
from magic_core.data import Frame
from magic_core.geometry import se3

Pose = NDArray[np.float64]

_MIN_DEPTH_SHARE = 0.1
_MIN_CONTRAST = 0.01  # standard deviation of the green channel, full scale is 1


@dataclass(frozen=True, slots=True)
class _Kept:
    """An earlier image as reference levels, and its pose relative to the last tracked frame."""

    pyramid: Pyramid
    keyframe_from_last: Pose
    exposure: Exposure = SAME
    """Correction of the last frame to this image's exposure."""


class KeyframeWindow:
    """Up to a few images, chosen so that old ones stay as long as they overlap."""

    def __init__(self, config: KeyframeWindowConfig) -> None:
        self._config = config
        self._kept: list[_Kept] = []
        self._last: Frame | None = None

    def clear(self) -> None:
        """Forget all images."""
        self._kept, self._last = [], None

    def start(self, frame: Frame, image: Pyramid) -> None:
        """Begin anew from one image unless the window already ends with this frame."""
        if self._last is frame or self._config.images == 0:
            return
        self._kept = [_Kept(self._reference(image), np.eye(4))]
        self._last = frame

    def views(self, anchor_from_last: Pose, *, jump: Exposure = SAME) -> list[View]:
        """The images as reference views in the anchor frame of the last frame's pose.

        jump: correction of the current image to the last one's exposure.
        """
        return [
            View(
                kept.pyramid,
                anchor_from_last @ se3.inverse(kept.keyframe_from_last),
                finest=min(self._config.finest_level, len(kept.pyramid) - 1),
                exposure=kept.exposure.after(jump),
            )
            for kept in self._kept
        ]

    def advance(
        self, frame: Frame, image: Pyramid, *, last_from_frame: Pose, fits: tuple[ViewFit, ...]
    ) -> None:
        """Take note of the next tracked frame and of how it fits each view given by `views`."""
        config = self._config
        if config.images == 0:
            return
        overlaps = [fit.visible_share for fit in fits]
        moved = [
            replace(
                kept,
                keyframe_from_last=kept.keyframe_from_last @ last_from_frame,
                exposure=fit.exposure,
            )
            for kept, fit in zip(self._kept, fits, strict=True)
        ]
        staying = [
            (overlap, kept)
            for overlap, kept, fit in zip(overlaps, moved, fits, strict=True)
            if overlap >= config.min_overlap and fit.inlier_share >= config.min_inlier_share
        ]
        due = not overlaps or overlaps[-1] < config.new_overlap or not staying
        if due and _shows_something(image):
            while len(staying) >= config.images:
                staying.remove(min(staying, key=lambda each: each[0]))
            staying.append((1.0, _Kept(self._reference(image), np.eye(4))))
        self._kept = [kept for _, kept in staying]
        self._last = frame

    def _reference(self, image: Pyramid) -> Pyramid:
        return keyframe_pyramid(image, finest=min(self._config.finest_level, len(image) - 1))


def _shows_something(image: Pyramid) -> bool:
    """Whether an image has both colour and depth: a covered lens makes no reference."""
    coarsest = image.levels[-1]
    has_depth = float((coarsest[..., 3] > 0.0).mean()) > _MIN_DEPTH_SHARE
    return has_depth and float(coarsest[..., 1].std()) > _MIN_CONTRAST
