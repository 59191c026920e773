"""No registration: the camera is expected to move on as it did."""

from __future__ import annotations

from magic_agent.tracking.initialisation.base import InitialPose, Pose
from magic_core.data import Frame
from magic_core.geometry import Camera


class ConstantVelocity:
    """The prediction itself."""

    def reset(self) -> None:
        """Nothing is kept."""

    def estimate(
        self,
        previous: Frame,
        current: Frame,
        *,
        camera: Camera,
        predicted_previous_from_current: Pose,
    ) -> InitialPose:
        """The prediction, whatever the images show."""
        return InitialPose(predicted_previous_from_current, True, 1.0)
