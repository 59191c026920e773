"""Sub-maps to load a server with: recorded ones, replayed by many agents, never twice the same."""

from __future__ import annotations

import functools
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, cast

import numpy as np
import zstandard
from magicslam.v1 import submap_pb2
from numpy.typing import NDArray

from magic_core.geometry import se3
from magic_core.submap import Keyframe, OdometryEdge, Submap, TrackedFrame
from magic_core.wire import EncodedSubmap, depth_planes, geometry, images, names
from magic_core.wire.chunks import sha256

if TYPE_CHECKING:
    from magic_core.data.synthetic import SyntheticSource
    from magic_core.submap import Descriptor

SESSION = "load"
AGENTS, SUBMAPS, KEYFRAMES, FRAMES = 4, 8, 5, 40
"""Of the recording: walks, sub-maps of each, keyframes and frames of each sub-map."""
GAUSSIANS = 40_000
_INFORMATION = np.diag([1e4] * 3 + [4e4] * 3)
_GAUSSIAN_HEADER_BYTES = 12


@dataclass(frozen=True, slots=True)
class RecordedSubmap:
    """A sub-map as it was encoded once, and where it really is."""

    encoded: EncodedSubmap
    world_from_anchor: np.ndarray  # (4, 4)


@dataclass(frozen=True, slots=True)
class Recording:
    """What the agents of a load replay."""

    walks: tuple[tuple[RecordedSubmap, ...], ...]
    """Of each recorded agent, in order."""
    model_id: str
    dimension: int


def record(progress: Callable[[float], None]) -> Recording:
    """Walks through the generated flat with real images, descriptors and Gaussians."""
    from magic_agent.places import load_descriptor_model
    from magic_core.data.synthetic import SyntheticConfig, synthetic_flat
    from magic_core.wire import encode_submap

    model = load_descriptor_model()
    config = SyntheticConfig(agents=AGENTS, frames=SUBMAPS * FRAMES)
    sources = cast("list[SyntheticSource]", synthetic_flat(config))
    walks = []
    for agent, source in enumerate(sources):
        walk = []
        for index in range(SUBMAPS):
            submap = _submap(source, index, agent=agent, describe=model.describe)
            world_from_anchor = source.timed_poses()[index * FRAMES][1]
            assert world_from_anchor is not None  # generated data knows
            encoded = encode_submap(submap, request_id="recorded")
            walk.append(RecordedSubmap(encoded, world_from_anchor))
            progress((agent * SUBMAPS + index + 1) / (AGENTS * SUBMAPS))
        walks.append(tuple(walk))
    return Recording(tuple(walks), model.model_id, model.dimension)


def _submap(
    source: SyntheticSource,
    index: int,
    *,
    agent: int,
    describe: Callable[[NDArray[np.uint8]], Descriptor],
) -> Submap:
    """FRAMES frames of a walk as a sub-map, at their true poses."""
    from magic_core.gaussians.seeding import seed_uniform

    first = index * FRAMES
    times_and_poses = source.timed_poses()[first : first + FRAMES]
    worlds = [pose for _, pose in times_and_poses if pose is not None]
    anchor_from_world = se3.inverse(worlds[0])
    poses = [anchor_from_world @ pose for pose in worlds]
    poses[0] = np.eye(4)
    kept = np.linspace(0, FRAMES - 1, KEYFRAMES).astype(int).tolist()
    frames = {i: source[first + i] for i in kept}
    rng = np.random.default_rng([agent, index])
    return Submap(
        session=SESSION,
        agent=f"agent_{agent}",
        index=index,
        camera=source.camera,
        gaussians=seed_uniform(
            frames[0].colour,
            frames[0].depth,
            source.camera,
            need=frames[0].depth > 0,
            count=GAUSSIANS,
            existing=np.zeros((0, 3), np.float32),
            rng=rng,
        ),
        keyframes=tuple(
            Keyframe(i, times_and_poses[i][0], poses[i], frame.colour, frame.depth)
            for i, frame in frames.items()
        ),
        trajectory=tuple(
            TrackedFrame(i, time_s, poses[i]) for i, (time_s, _) in enumerate(times_and_poses)
        ),
        descriptor=describe(frames[0].colour),
    )


def replayed(recording: Recording, *, agent: int, index: int) -> EncodedSubmap:
    """Sub-map `index` of agent `agent`, who walks a recorded path to and fro.

    Every blob differs from all others of the load, as real ones do: a store that keeps equal files
    once must not profit.
    """
    walk = recording.walks[agent % len(recording.walks)]
    recorded = walk[_to_and_fro(index, len(walk))]
    unique = agent * 100_000 + index
    header = submap_pb2.SubmapHeader()
    header.CopyFrom(recorded.encoded.header)
    blobs = tuple(
        _varied(data, info, unique)
        for data, info in zip(recorded.encoded.blobs, header.blobs, strict=True)
    )
    header.name = names.submap_name(SESSION, f"load_{agent}", index)
    header.request_id = header.name
    for info, data in zip(header.blobs, blobs, strict=True):
        info.length, info.sha256 = len(data), sha256(data)
    if index:
        before = walk[_to_and_fro(index - 1, len(walk))]
        motion = se3.inverse(before.world_from_anchor) @ recorded.world_from_anchor
        edge = OdometryEdge(index - 1, motion, _INFORMATION)
        header.odometry.previous_index = edge.previous_index
        header.odometry.previous_from_anchor.CopyFrom(geometry.pose_to_proto(motion))
        header.odometry.information[:] = geometry.information_to_list(edge.information)
    return EncodedSubmap(header, blobs)


def _to_and_fro(index: int, length: int) -> int:
    """0 1 2 ... length-1 length-2 ... 1 0 1 ..."""
    if length == 1:
        return 0
    position = index % (2 * length - 2)
    return position if position < length else 2 * length - 2 - position


def _varied(data: bytes, info: submap_pb2.BlobInfo, unique: int) -> bytes:
    """The same content in other bytes; depth becomes PNG, which has room for a comment."""
    if info.role == submap_pb2.BLOB_ROLE_GAUSSIANS:
        return _with_moved_origin(data, unique)
    if info.media_type == images.DEPTH_PLANES:
        data, info.media_type = _as_png(data), images.PNG
    if info.media_type == images.JPEG:
        comment = b"%016d" % unique
        segment = b"\xff\xfe" + (len(comment) + 2).to_bytes(2, "big") + comment
        return data[:2] + segment + data[2:]
    body = b"tEXt" + b"load\x00%016d" % unique
    chunk = (len(body) - 4).to_bytes(4, "big") + body + zlib.crc32(body).to_bytes(4, "big")
    return data[:33] + chunk + data[33:]


@functools.lru_cache(maxsize=AGENTS * SUBMAPS * KEYFRAMES)
def _as_png(depth: bytes) -> bytes:
    return images.encode_depth_png(depth_planes.decode(depth).astype(np.float32), metres_per_unit=1)


def _with_moved_origin(data: bytes, unique: int) -> bytes:
    """A compact Gaussian blob whose grid begins some nanometres further along x."""
    content = bytearray(zstandard.ZstdDecompressor().decompress(data[_GAUSSIAN_HEADER_BYTES:]))
    origin_x = np.frombuffer(content, "<f8", count=1)[0] + unique * 1e-9
    content[:8] = np.array([origin_x], "<f8").tobytes()
    compressed = zstandard.ZstdCompressor(level=1).compress(bytes(content))
    return data[:_GAUSSIAN_HEADER_BYTES] + compressed
