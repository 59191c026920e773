"""What the service answers, as typed data: the server fills these in, the client returns them."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import datetime
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from magic_core.gaussians.region import Region

Verdict = Literal["SIMILAR", "PENDING", "ACCEPTED", "REJECTED"]
OperationState = Literal["PENDING", "RUNNING", "SUCCEEDED", "FAILED"]
AgentState = Literal["ACTIVE", "FINISHED"]
MapFormat = Literal["ply", "lossless", "compact"]


@dataclass(frozen=True, slots=True)
class AgentRegistration:
    """An agent may start to submit."""

    agent: str
    """Resource name."""
    next_submap_index: int
    resumed: bool
    """True when the agent was registered before."""
    revision: int
    max_submap_bytes: int
    max_chunk_bytes: int


@dataclass(frozen=True, slots=True)
class SubmapReceipt:
    """A sub-map is durable."""

    submap: str
    """Resource name."""
    received_at: datetime
    stored_bytes: int
    """Bytes of its blobs."""
    duplicate: bool
    """True when an earlier request with the same id had stored it."""
    wire_bytes: int = 0
    """Bytes of header and blobs that were sent; known to the sender only."""


@dataclass(frozen=True, slots=True)
class UploadPosition:
    """Where an upload that broke off goes on."""

    blob_index: int
    offset: int
    """Position within that blob, bytes."""
    durable_bytes: int
    """Bytes of all blobs that the server has on its disk."""
    stored: bool
    """True when the sub-map is stored already: the header alone gets the first answer."""


@dataclass(frozen=True, slots=True)
class LoopCandidate:
    """Two sub-maps that may show the same place, and what became of it."""

    source: str
    """Resource name; empty for a raw descriptor."""
    target: str
    similarity: float
    """Cosine, -1 to 1."""
    verdict: Verdict
    reason: str
    """Upper-case code, ACCEPTED or why not."""
    target_from_source: NDArray[np.float64] | None = None  # (4, 4)
    information: NDArray[np.float64] | None = None  # (6, 6), 1/m^2 and 1/rad^2
    fitness: float = 0.0
    rmse_m: float = 0.0
    inliers: int = 0
    overlap: float = 0.0
    verify_seconds: float = 0.0
    kept: bool = False
    """True when the newest solution of the pose graph relies on it."""
    source_keyframe: int = 0
    """Which of the source's keyframes looks like the target; 0 is the anchor."""
    target_keyframe: int = 0
    """Which of the target's keyframes looks like the source; 0 is the anchor."""


@dataclass(frozen=True, slots=True)
class LoopAnswer:
    """Loop candidates, and the revision that `kept` speaks of."""

    candidates: tuple[LoopCandidate, ...]
    revision: int


@dataclass(frozen=True, slots=True)
class CorrectedPose:
    """The corrected pose of one sub-map, in the world frame of its component."""

    submap: str
    component: str
    world_from_anchor: NDArray[np.float64]  # (4, 4)


@dataclass(frozen=True, slots=True)
class ComponentInfo:
    """A set of linked sub-maps with one world frame."""

    id: str
    """Resource name of its oldest sub-map."""
    submap_count: int
    agents: tuple[str, ...]
    """Resource names."""


@dataclass(frozen=True, slots=True)
class PoseSnapshot:
    """The pose graph's solution at one revision."""

    session: str
    """Resource name."""
    revision: int
    """0 before the first solution."""
    solved_at: datetime | None
    poses: dict[str, CorrectedPose]
    """By resource name of the sub-map, in order of arrival."""
    components: tuple[ComponentInfo, ...] = ()
    """Largest first."""
    loop_count: int = 0
    loops_kept: int = 0


@dataclass(frozen=True, slots=True)
class CorrectedFrame:
    """The corrected pose of one camera image."""

    frame_index: int
    timestamp_s: float
    world_from_camera: NDArray[np.float64]  # (4, 4)
    lost: bool


@dataclass(frozen=True, slots=True)
class TrajectoryPart:
    """The corrected frames of one sub-map."""

    submap: str
    component: str
    revision: int
    frames: tuple[CorrectedFrame, ...]


@dataclass(frozen=True, slots=True)
class MapPart:
    """What a file holds of a map."""

    region: Region | None
    """As it was asked for; None for the whole map."""
    max_gaussians: int
    """As it was asked for; 0 for all."""
    gaussian_count: int
    """Gaussians in the file."""
    full_gaussian_count: int
    """Gaussians that the map has in the region; where these are more, neighbours were merged."""


@dataclass(frozen=True, slots=True)
class GlobalMapInfo:
    """A merged map of one component."""

    name: str
    """Resource name `sessions/{s}/maps/{m}`."""
    component: str
    revision: int
    submaps: tuple[str, ...]
    gaussian_count: int
    created_at: datetime
    part: MapPart | None = field(default=None, compare=False)
    """What a download holds of it; None where nothing was downloaded."""


@dataclass(frozen=True, slots=True)
class OperationError:
    """Why an operation failed."""

    code: str
    """Name of the gRPC status code."""
    reason: str
    message: str


@dataclass(frozen=True, slots=True)
class OperationStatus:
    """How far an operation is."""

    name: str
    """Resource name `sessions/{s}/operations/{o}`."""
    state: OperationState
    progress: float
    """0 to 1."""
    stage: str
    created_at: datetime
    updated_at: datetime
    error: OperationError | None = None
    result: GlobalMapInfo | None = None

    @property
    def done(self) -> bool:
        """True when it succeeded or failed."""
        return self.state in ("SUCCEEDED", "FAILED")


@dataclass(frozen=True, slots=True)
class SessionInfo:
    """A mapping session."""

    name: str
    created_at: datetime
    descriptor_model_id: str
    descriptor_dimension: int
    agent_count: int
    submap_count: int
    stored_bytes: int
    revision: int
    pending_loops: int
    """Candidates that wait for, or are under, verification."""


@dataclass(frozen=True, slots=True)
class AgentInfo:
    """One agent of a session."""

    name: str
    state: AgentState
    registered_at: datetime
    last_seen_at: datetime
    submap_count: int
    next_submap_index: int


@dataclass(frozen=True, slots=True)
class SubmapInfo:
    """Summary of a stored sub-map."""

    name: str
    received_at: datetime
    first_timestamp_s: float
    last_timestamp_s: float
    frame_count: int
    keyframe_count: int
    gaussian_count: int
    stored_bytes: int


@dataclass(frozen=True, slots=True)
class Localization:
    """Where an RGB-D image was taken."""

    world_from_camera: NDArray[np.float64]  # (4, 4)
    component: str
    revision: int
    submap: str
    anchor_from_camera: NDArray[np.float64]  # (4, 4); stays right when the graph moves
    fitness: float
    rmse_m: float
    inliers: int
    overlap: float
    """Share of the image that the sub-map's images confirm, 0 to 1."""
    similarity: float
    """Cosine of the descriptors, -1 to 1."""
    confidence: float
    """Agreement of image and map where they overlap, 0 to 1."""
    information: NDArray[np.float64]
    """(6, 6) of anchor_from_camera, 1/m^2 and 1/rad^2."""


@dataclass(frozen=True, slots=True)
class Deletion:
    """What was deleted."""

    submap_count: int
    freed_bytes: int
