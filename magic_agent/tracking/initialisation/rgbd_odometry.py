"""OpenCV's RGB-D odometry: photometric and point-to-plane residuals over an image pyramid."""

from __future__ import annotations

import cv2
import numpy as np

from magic_agent.tracking.initialisation.base import InitialPose, LastFrame, Pose, checked
from magic_core.data import Frame
from magic_core.geometry import Camera

_MIN_DEPTH_M, _MAX_DEPTH_M = 0.1, 10.0
_MAX_DEPTH_DIFFERENCE_M = 0.1


class RgbdOdometry:
    """`cv2.Odometry` on grey and depth images."""

    def __init__(self) -> None:
        self._last: LastFrame[cv2.OdometryFrame] = LastFrame()
        self._odometry: cv2.Odometry | None = None
        self._camera: Camera | None = None

    def reset(self) -> None:
        """Forget the last frame."""
        self._last.clear()

    def estimate(
        self,
        previous: Frame,
        current: Frame,
        *,
        camera: Camera,
        predicted_previous_from_current: Pose,
    ) -> InitialPose:
        """OpenCV's estimate; it starts at identity, its interface takes no prediction."""
        odometry = self._odometry_for(camera)
        source = self._prepared(odometry, current)
        target = self._last.get(previous) or self._prepared(odometry, previous)
        self._last.put(current, source)
        try:
            ok, previous_from_current = odometry.compute(source, target)  # pyright: ignore
        except cv2.error:  # raised where a frame has no usable pixels at all
            ok, previous_from_current = False, np.eye(4)
        if not ok:
            return InitialPose(predicted_previous_from_current, False, 0.0)
        share = float((current.depth > 0).mean())
        return checked(
            np.asarray(previous_from_current, np.float64),
            predicted_previous_from_current,
            fitness=share,
        )

    def _odometry_for(self, camera: Camera) -> cv2.Odometry:
        if self._odometry is None or camera != self._camera:
            settings = cv2.OdometrySettings()
            settings.setCameraMatrix(camera.matrix.astype(np.float32))
            settings.setMinDepth(_MIN_DEPTH_M)
            settings.setMaxDepth(_MAX_DEPTH_M)
            settings.setMaxDepthDiff(_MAX_DEPTH_DIFFERENCE_M)
            self._odometry = cv2.Odometry(
                _constant("OdometryType", "RGB_DEPTH"),
                settings,
                _constant("OdometryAlgoType", "COMMON"),
            )
            self._camera = camera
            self._last.clear()
        return self._odometry

    @staticmethod
    def _prepared(odometry: cv2.Odometry, frame: Frame) -> cv2.OdometryFrame:
        grey = cv2.cvtColor(frame.colour, cv2.COLOR_RGB2GRAY)
        prepared = cv2.OdometryFrame(depth=frame.depth.astype(np.float32), image=grey)
        odometry.prepareFrame(prepared)
        return prepared


def _constant(enumeration: str, name: str) -> int:
    """cv2.OdometryType_RGB_DEPTH, or cv2.OdometryType.RGB_DEPTH where a build scopes its enums."""
    flat = f"{enumeration}_{name}"
    return getattr(cv2, flat) if hasattr(cv2, flat) else getattr(getattr(cv2, enumeration), name)
