"""The sub-map under construction: its trajectory, and the odometry edge that leads out of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from magic_agent.slam_config import SubmapConfig
from magic_core.data import Frame
from magic_core.gaussians import GaussianCloud
from magic_core.geometry import Camera, se3
from magic_core.submap import Descriptor, OdometryEdge, TrackedFrame

Pose = NDArray[np.float64]

_THIN = 8  # every so many pixels are looked at, each way
_BEHIND = 1.1  # farther than this many times the anchor's reading, a surface is hidden from it


@dataclass(slots=True)
class ActiveSubmap:
    """What an agent knows of the sub-map it is building, besides Gaussians and keyframes."""

    index: int
    odometry: OdometryEdge | None
    descriptor: Descriptor
    prior: Pose | None
    trajectory: list[TrackedFrame] = field(default_factory=list)
    unseen: NDArray[np.float64] = field(default_factory=lambda: np.zeros((6, 6)))
    """Covariance of the motion that no image showed so far, left perturbation (anchor frame)."""

    @property
    def last_pose(self) -> Pose:
        """anchor_from_camera of the last frame."""
        return self.trajectory[-1].anchor_from_camera

    def append(
        self,
        frame: Frame,
        anchor_from_camera: Pose,
        *,
        lost: bool,
        unseen: NDArray[np.float64] | None = None,
    ) -> None:
        """Note one frame's pose, and the (6, 6) covariance of a step that was guessed in part.

        Frames are tracked against the map, so their errors do not add up; but a map that was
        extended at guessed poses carries the error of the guess on.
        """
        if unseen is not None:
            adjoint = se3.adjoint(anchor_from_camera)
            self.unseen = self.unseen + adjoint @ unseen @ adjoint.T
        self.trajectory.append(
            TrackedFrame(frame.index, frame.timestamp_s, anchor_from_camera, lost)
        )

    def is_due(
        self,
        anchor_from_camera: Pose,
        config: SubmapConfig,
        *,
        overlap: Callable[[], float] = lambda: 1.0,
    ) -> bool:
        """Whether a frame at this pose should open the next sub-map: by count, distance, turn, or
        coverage, for which `overlap` tells how much of the frame the anchor's image shows too."""
        count = len(self.trajectory)
        far = float(np.linalg.norm(anchor_from_camera[:3, 3])) > config.translation_m
        turned = float(np.rad2deg(se3.rotation_angle(anchor_from_camera))) > config.rotation_deg
        if count >= config.frames or count < config.min_frames:
            return count >= config.frames
        return far or turned or overlap() < config.min_anchor_overlap


def anchor_overlap(
    anchor_depth: NDArray[np.float32],
    depth: NDArray[np.float32],
    *,
    camera: Camera,
    anchor_from_camera: Pose,
    thin: int = _THIN,
) -> float:
    """Share of a frame's depth readings (h, w) whose surface the anchor's depth image shows too;
    every `thin`th pixel is looked at, each way."""
    points = camera.back_project(depth)[::thin, ::thin][depth[::thin, ::thin] > 0.0]
    if not len(points):
        return 1.0  # nothing is known, so nothing is known to have left the view
    seen = se3.transform_points(anchor_from_camera, points)
    z = np.maximum(seen[:, 2], 1e-6)
    u = np.rint(camera.fx * seen[:, 0] / z + camera.cx)
    v = np.rint(camera.fy * seen[:, 1] / z + camera.cy)
    inside = (seen[:, 2] > 0.0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    there = anchor_depth[v[inside].astype(int), u[inside].astype(int)]
    hidden = (there > 0.0) & (z[inside] > _BEHIND * there)
    return float((~hidden).sum()) / len(points)


@dataclass(frozen=True, slots=True)
class Opening:
    """How a sub-map begins."""

    frame: Frame
    """Its anchor."""
    odometry: OdometryEdge | None
    """From the sub-map before; None begins a new chain."""
    carried: GaussianCloud | None
    """The Gaussians that moved over, in the anchor's frame."""


def hand_over_edge(
    index: int,
    anchor_from_next: Pose,
    information: NDArray[np.float64],
    config: SubmapConfig,
    *,
    unseen: NDArray[np.float64] | None = None,
) -> OdometryEdge:
    """The odometry edge out of sub-map `index`.

    Its covariance is the tracker's for the last pose, plus the drift of the model itself: frames
    are tracked against the sub-map, whose far end was built from near, so the error grows with the
    sub-map and not with the frame count. `information` is that of the tracker, (6, 6); `unseen` is
    what `ActiveSubmap` gathered of motion that no image showed.
    """
    drift = np.concatenate(
        [
            np.full(3, config.drift_translation_m**2),
            np.full(3, np.deg2rad(config.drift_rotation_deg) ** 2),
        ]
    )
    # The eigenvalues are bounded below so that an undetermined direction stays a large variance.
    values, vectors = np.linalg.eigh(0.5 * (information + information.T))
    covariance = (vectors / np.maximum(values, 1.0)) @ vectors.T + np.diag(drift)
    if unseen is not None:
        adjoint = se3.adjoint(se3.inverse(anchor_from_next))
        covariance = covariance + adjoint @ unseen @ adjoint.T
    inverse = np.linalg.inv(covariance)
    return OdometryEdge(index, anchor_from_next, 0.5 * (inverse + inverse.T))
