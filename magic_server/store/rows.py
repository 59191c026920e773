"""What the store keeps that no message shows, and small conversions of column values."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from magicslam.v1 import submap_pb2
from numpy.typing import ArrayLike, NDArray

from magic_core.submap import Descriptor, OdometryEdge
from magic_core.wire import geometry, names
from magic_core.wire.submap import decode_keyframe_descriptors, decode_odometry
from magic_server.store.blob_store import StoredBlob

DescribedKeyframe = tuple[int, NDArray[np.float32]]
"""Its place among the keyframes of the sub-map's header, and its descriptor (d,)."""


@dataclass(frozen=True, slots=True)
class SessionRow:
    """A session as the coordinator needs it."""

    id: int
    name: str
    model_id: str
    dimension: int


@dataclass(frozen=True, slots=True)
class AgentRow:
    """An agent as the servicers need it."""

    id: int
    session: SessionRow
    name: str
    finished: bool


@dataclass(frozen=True, slots=True)
class GraphVertex:
    """A sub-map as the pose graph needs it, as long as the session lasts."""

    name: str
    agent: str
    """Resource name of its agent."""
    odometry: OdometryEdge | None
    prior: NDArray[np.float64] | None  # world_from_anchor (4, 4)
    span_s: tuple[float, float]
    """Timestamps of its first and its last frame, by the agent's clock."""


@dataclass(frozen=True, slots=True)
class Vertex(GraphVertex):
    """The same with what it is found by: the descriptor index keeps that."""

    index: int
    descriptor: Descriptor
    searched: bool
    """Whether loop candidates were looked for."""
    keyframes: tuple[DescribedKeyframe, ...] = ()
    """Those that have a descriptor of their own."""

    @classmethod
    def of(cls, header: submap_pb2.SubmapHeader, *, searched: bool = False) -> Vertex:
        """From a checked header."""
        session, agent, index = names.parse_submap(header.name)
        prior = None
        if header.HasField("world_from_anchor_prior"):
            prior = geometry.pose_from_proto(header.world_from_anchor_prior)
        frames = header.trajectory
        return cls(
            name=header.name,
            agent=sys.intern(names.agent_name(session, agent)),  # many have the same
            index=index,
            descriptor=geometry.descriptor_from_proto(header.image_descriptor),
            odometry=decode_odometry(header),
            prior=prior,
            searched=searched,
            span_s=(frames[0].timestamp_s, frames[-1].timestamp_s),
            keyframes=decode_keyframe_descriptors(header),
        )

    def bare(self) -> GraphVertex:
        """Without what it is found by."""
        return GraphVertex(self.name, self.agent, self.odometry, self.prior, self.span_s)


@dataclass(frozen=True, slots=True)
class RemovedSubmap:
    """What the pose graph still needs of a deleted sub-map."""

    name: str
    odometry: OdometryEdge | None
    prior: NDArray[np.float64] | None  # world_from_anchor (4, 4)


@dataclass(frozen=True, slots=True)
class NewSubmap:
    """A sub-map whose blobs are in place, ready for its transaction."""

    header: submap_pb2.SubmapHeader
    header_sha256: bytes
    gaussian_count: int
    digests: tuple[str, ...]
    """SHA-256 in hex of each blob, in the header's order."""
    vertex: Vertex


@dataclass(frozen=True, slots=True)
class StoredSubmap:
    """A stored sub-map's header and its blobs."""

    header: bytes
    """magicslam.v1.SubmapHeader, serialised: what is cheap to hand to another process."""
    blobs: tuple[StoredBlob, ...]
    """In the header's order."""


@dataclass(frozen=True, slots=True)
class MapFile:
    """One file of a global map."""

    sha256: str
    length: int


def pack(array: ArrayLike | None) -> bytes | None:
    """An array as little-endian float64 bytes."""
    return None if array is None else np.ascontiguousarray(array, "<f8").tobytes()


def unpack(data: bytes | None, side: int) -> NDArray[np.float64] | None:
    """The (side, side) matrix of its bytes."""
    if data is None:
        return None
    # Shaped first: the copy is then one array, not one and a view of it.
    return np.frombuffer(data, "<f8").reshape(side, side).astype(np.float64)


def pack_keyframes(keyframes: Sequence[DescribedKeyframe]) -> bytes | None:
    """Descriptors of keyframes as bytes; None for none."""
    if not keyframes:
        return None
    rows = np.empty(len(keyframes), _keyframe_row(len(keyframes[0][1])))
    rows["place"] = [place for place, _ in keyframes]
    rows["vector"] = [vector for _, vector in keyframes]
    return rows.tobytes()


def unpack_keyframes(data: bytes | None, dimension: int) -> tuple[DescribedKeyframe, ...]:
    """The descriptors of keyframes of their bytes."""
    rows = np.frombuffer(data or b"", _keyframe_row(dimension))
    return tuple((int(row["place"]), row["vector"].astype(np.float32)) for row in rows)


def _keyframe_row(dimension: int) -> np.dtype:
    return np.dtype([("place", "<u4"), ("vector", "<f4", (dimension,))])
