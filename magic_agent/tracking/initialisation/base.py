"""What every pose initialiser offers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from magic_core.data import Frame
from magic_core.geometry import Camera, se3

Pose = NDArray[np.float64]
Prepared = TypeVar("Prepared")


@dataclass(frozen=True, slots=True)
class InitialPose:
    """An estimate of the motion between two frames."""

    previous_from_current: Pose  # (4, 4)
    ok: bool
    """False where the method failed; the pose is then the prediction."""
    fitness: float
    """0 to 1: the share of the frame that supports the estimate, as the method counts it."""


class PoseInitialiser(Protocol):
    """Frame-to-frame registration. May keep what it prepared of the last frame."""

    def reset(self) -> None:
        """Forget everything kept of earlier frames."""
        ...

    def estimate(
        self,
        previous: Frame,
        current: Frame,
        *,
        camera: Camera,
        predicted_previous_from_current: Pose,
    ) -> InitialPose:
        """The motion from `current` to `previous`, starting at the predicted one."""
        ...


def checked(
    estimate: Pose,
    predicted: Pose,
    *,
    fitness: float,
    max_translation_m: float = 0.5,
    max_rotation_rad: float = 0.6,
) -> InitialPose:
    """The estimate, or the prediction where the estimate is no plausible motion of one frame.

    It must be a rigid transform and lie within the bounds around the prediction.
    """
    finite = bool(np.isfinite(estimate).all())
    if finite and abs(np.linalg.det(estimate[:3, :3]) - 1.0) < 1e-2:
        estimate = se3.orthonormalised(estimate)
        off = se3.inverse(predicted) @ estimate
        near = float(np.linalg.norm(off[:3, 3])) <= max_translation_m
        if near and se3.rotation_angle(off) <= max_rotation_rad:
            return InitialPose(estimate, True, float(np.clip(fitness, 0.0, 1.0)))
    return InitialPose(predicted, False, 0.0)


class LastFrame(Generic[Prepared]):
    """Remembers what was prepared of the newest frame: it is the previous one of the next call."""

    def __init__(self) -> None:
        self._frame: Frame | None = None
        self._prepared: Prepared | None = None

    def clear(self) -> None:
        """Forget the frame."""
        self._frame, self._prepared = None, None

    def get(self, frame: Frame) -> Prepared | None:
        """What was put for exactly this frame, or None."""
        return self._prepared if self._frame is frame else None

    def put(self, frame: Frame, prepared: Prepared) -> None:
        """Replace what is remembered."""
        self._frame, self._prepared = frame, prepared
