"""Our own Gauss-Newton on the previous RGB-D image: the tracker's kernel without a render.

The previous image takes the place of the rendered view. The coarse levels suffice for a start,
and the pyramids are those that the refinement needs anyway.
"""

from __future__ import annotations

import numpy as np

from magic_agent.tracking.config import GaussNewtonConfig
from magic_agent.tracking.gauss_newton import GaussNewton, MotionPrior, View
from magic_agent.tracking.initialisation.base import InitialPose, Pose, checked
from magic_agent.tracking.pyramid import keyframe_pyramid
from magic_agent.tracking.pyramid_cache import PyramidCache
from magic_core.data import Frame
from magic_core.geometry import Camera

_FINEST_LEVEL = 1
_MIN_AGREEING = 0.3


class Dense:
    """Frame-to-frame alignment of colour and depth on the coarse pyramid levels."""

    def __init__(self, config: GaussNewtonConfig, pyramids: PyramidCache) -> None:
        self._config = config
        self._pyramids = pyramids

    def reset(self) -> None:
        """Pyramids are kept by the frame they belong to; there is nothing to forget."""

    def estimate(
        self,
        previous: Frame,
        current: Frame,
        *,
        camera: Camera,
        predicted_previous_from_current: Pose,
    ) -> InitialPose:
        """Alignment from the prediction; little agreement gives the prediction back."""
        image = self._pyramids.get(current)
        finest = min(_FINEST_LEVEL, len(image) - 1)
        reference = keyframe_pyramid(self._pyramids.get(previous), finest=finest)
        solution = GaussNewton(self._config).align(
            [View(reference, np.eye(4), finest=finest)],
            image,
            anchor_from_camera=predicted_previous_from_current,
            prior=MotionPrior.around(predicted_previous_from_current, self._config),
            finest=finest,
        )
        agreeing = solution.fits[0].inlier_share
        if agreeing < _MIN_AGREEING:
            return InitialPose(predicted_previous_from_current, False, agreeing)
        return checked(
            solution.anchor_from_camera, predicted_previous_from_current, fitness=agreeing
        )
