"""The finished sub-map that an agent hands to the server.

Everything in it is relative to the sub-map's anchor, the camera frame of its first image, and is
never rewritten: `world_from_anchor` is the only thing that the pose graph moves.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from magic_core.gaussians import GaussianCloud
from magic_core.geometry import Camera


@dataclass(frozen=True, slots=True)
class Keyframe:
    """An RGB-D image with its pose in the sub-map. Keyframe 0 is the anchor image itself."""

    frame_index: int
    timestamp_s: float
    anchor_from_camera: NDArray[np.float64]  # (4, 4)
    colour: NDArray[np.uint8]  # (h, w, 3) RGB
    depth: NDArray[np.float32]  # (h, w) metres, 0 = no reading
    descriptor: NDArray[np.float32] | None = None
    """(d,) unit L2 norm, by the model of the sub-map's own; None for keyframe 0, which has that
    one, and for those by which the place is not to be found."""


@dataclass(frozen=True, slots=True)
class TrackedFrame:
    """The estimated pose of one frame of the sub-map."""

    frame_index: int
    timestamp_s: float
    anchor_from_camera: NDArray[np.float64]  # (4, 4)
    lost: bool = False


@dataclass(frozen=True, slots=True)
class OdometryEdge:
    """The tracked motion from the previous sub-map's anchor to this one's."""

    previous_index: int
    """Index of the previous sub-map of the same agent."""
    previous_from_anchor: NDArray[np.float64]  # (4, 4)
    information: NDArray[np.float64]
    """(6, 6), tangent order (translation, rotation), right perturbation; 1/m^2, 1/rad^2."""


@dataclass(frozen=True, slots=True)
class Descriptor:
    """A global image descriptor of the anchor image."""

    model_id: str
    """Name and version of the encoder; descriptors of different models never meet."""
    vector: NDArray[np.float32]  # (d,) unit L2 norm


@dataclass(frozen=True, slots=True)
class Submap:
    """A finished sub-map of one agent, in its own anchor frame."""

    session: str
    agent: str
    index: int
    """0-based number within the agent."""
    camera: Camera
    gaussians: GaussianCloud
    keyframes: tuple[Keyframe, ...]
    """At least the anchor (keyframes[0], anchor_from_camera = identity)."""
    trajectory: tuple[TrackedFrame, ...]
    """Every frame of the sub-map; the first is the anchor."""
    descriptor: Descriptor
    odometry: OdometryEdge | None = None
    """None for the first sub-map of an agent or of a new odometry chain."""
    world_from_anchor_prior: NDArray[np.float64] | None = field(default=None)
    """Known start pose, given only when the user asked for a known start."""

    @property
    def name(self) -> str:
        """The resource name `sessions/{s}/agents/{a}/submaps/{m}`."""
        return f"sessions/{self.session}/agents/{self.agent}/submaps/{self.index}"

    @property
    def anchor(self) -> Keyframe:
        """The anchor RGB-D image, which registration uses at full resolution."""
        return self.keyframes[0]
