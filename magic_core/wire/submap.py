"""Sub-maps to header and blobs, and back. docs/wire-format.md specifies the bytes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from magicslam.v1 import submap_pb2
from numpy.typing import NDArray

from magic_core.errors import InvalidInput
from magic_core.gaussians import GaussianCloud, codec
from magic_core.submap import Keyframe, OdometryEdge, Submap, TrackedFrame
from magic_core.wire import geometry, images, names
from magic_core.wire.chunks import sha256

GAUSSIANS_MEDIA_TYPE = "application/vnd.magicslam.gaussians"


@dataclass(frozen=True, slots=True)
class SubmapEncoding:
    """How a sub-map becomes bytes."""

    gaussians: Literal["compact", "lossless"] = "compact"
    """`lossless` keeps every float32 bit; `compact` is about a quarter of the size."""
    colour: Literal["jpeg", "png"] = "jpeg"
    """`png` is lossless."""
    jpeg_quality: int = 90
    """1 to 100."""
    metres_per_unit: float = 0.001
    """Step of the 16-bit depth images, metres; the largest depth is 65,535 steps."""

    @classmethod
    def lossless(cls) -> SubmapEncoding:
        """Nothing lost but depth below half a millimetre."""
        return cls(gaussians="lossless", colour="png")


@dataclass(frozen=True, slots=True)
class EncodedSubmap:
    """A sub-map ready to be sent."""

    header: submap_pb2.SubmapHeader
    blobs: tuple[bytes, ...]
    """In the order of `header.blobs`."""

    @property
    def wire_bytes(self) -> int:
        """Bytes of the header and every blob."""
        return self.header.ByteSize() + sum(len(blob) for blob in self.blobs)


def encode_submap(
    submap: Submap, *, request_id: str, encoding: SubmapEncoding = SubmapEncoding()
) -> EncodedSubmap:
    """A sub-map as header and blobs. Slow (images are compressed): call it off the event loop."""
    blobs = _Blobs()
    gaussians = _encode_gaussians(submap.gaussians, encoding)
    header = submap_pb2.SubmapHeader(
        name=submap.name,
        request_id=request_id,
        camera=geometry.camera_to_proto(submap.camera),
        trajectory=[_frame_to_proto(frame) for frame in submap.trajectory],
        image_descriptor=geometry.descriptor_to_proto(submap.descriptor),
        odometry=None if submap.odometry is None else _odometry_to_proto(submap.odometry),
        gaussians_blob=blobs.add(gaussians, submap_pb2.BLOB_ROLE_GAUSSIANS, GAUSSIANS_MEDIA_TYPE),
    )
    if submap.world_from_anchor_prior is not None:
        prior = geometry.pose_to_proto(submap.world_from_anchor_prior)
        header.world_from_anchor_prior.CopyFrom(prior)
    for keyframe in submap.keyframes:
        colour, media_type = _encode_colour(keyframe, encoding)
        unit = encoding.metres_per_unit
        depth = images.encode_depth(keyframe.depth, metres_per_unit=unit)
        header.keyframes.add(
            frame_index=keyframe.frame_index,
            timestamp_s=keyframe.timestamp_s,
            anchor_from_camera=geometry.pose_to_proto(keyframe.anchor_from_camera),
            colour_blob=blobs.add(colour, submap_pb2.BLOB_ROLE_COLOUR, media_type),
            depth_blob=blobs.add(depth, submap_pb2.BLOB_ROLE_DEPTH, images.DEPTH_PLANES, unit),
            image_descriptor=() if keyframe.descriptor is None else keyframe.descriptor.tolist(),
        )
    header.blobs.extend(blobs.infos)
    return EncodedSubmap(header, tuple(blobs.data))


def decode_submap(header: submap_pb2.SubmapHeader, blobs: Sequence[bytes]) -> Submap:
    """The sub-map of a checked header (see `header_check`) and its blobs.

    Raises CorruptData when a blob is not in its format, InvalidInput when its content breaks a
    rule. Slow: call it off the event loop.
    """
    session, agent, index = names.parse_submap(header.name)
    camera = geometry.camera_from_proto(header.camera)
    keyframes = [_keyframe_from_proto(i, header, blobs) for i in range(len(header.keyframes))]
    prior = None
    if header.HasField("world_from_anchor_prior"):
        prior = geometry.pose_from_proto(header.world_from_anchor_prior)
    return Submap(
        session=session,
        agent=agent,
        index=index,
        camera=camera,
        gaussians=codec.decode(blobs[header.gaussians_blob]),
        keyframes=tuple(keyframes),
        trajectory=decode_trajectory(header),
        descriptor=geometry.descriptor_from_proto(header.image_descriptor),
        odometry=decode_odometry(header),
        world_from_anchor_prior=prior,
    )


def decode_trajectory(header: submap_pb2.SubmapHeader) -> tuple[TrackedFrame, ...]:
    """The frames of a checked header."""
    rows = geometry.pose_rows(frame.anchor_from_camera for frame in header.trajectory)
    poses = geometry.transforms_of_rows(rows)
    return tuple(
        TrackedFrame(frame.frame_index, frame.timestamp_s, pose, frame.lost)
        for frame, pose in zip(header.trajectory, poses, strict=True)
    )


def decode_odometry(header: submap_pb2.SubmapHeader) -> OdometryEdge | None:
    """The odometry edge of a checked header."""
    if not header.HasField("odometry"):
        return None
    edge = header.odometry
    return OdometryEdge(
        previous_index=edge.previous_index,
        previous_from_anchor=geometry.pose_from_proto(edge.previous_from_anchor),
        information=geometry.information_from_list(edge.information),
    )


def check_blob(header: submap_pb2.SubmapHeader, index: int, data: bytes) -> int:
    """Raise unless blob `index` holds what the header says; returns its Gaussians, else 0.

    Errors name the blob as the field `blobs[i]`.
    """
    info = header.blobs[index]
    try:
        if info.role == submap_pb2.BLOB_ROLE_GAUSSIANS:
            return codec.check(data)
        size = (header.camera.width, header.camera.height)
        depth = info.role == submap_pb2.BLOB_ROLE_DEPTH
        images.check_image(data, info.media_type, size=size, depth=depth)
    except InvalidInput as error:
        raise InvalidInput.field(f"blobs[{index}]", error.message) from error
    return 0


class _Blobs:
    """Collects blobs in order, each with its description."""

    def __init__(self) -> None:
        self.data: list[bytes] = []
        self.infos: list[submap_pb2.BlobInfo] = []

    def add(
        self,
        data: bytes,
        role: submap_pb2.BlobRole.ValueType,
        media_type: str,
        metres_per_unit: float = 0.0,
    ) -> int:
        """The new blob's index."""
        info = submap_pb2.BlobInfo(
            role=role,
            media_type=media_type,
            length=len(data),
            sha256=sha256(data),
            metres_per_unit=metres_per_unit,
        )
        self.data.append(data)
        self.infos.append(info)
        return len(self.data) - 1


def _keyframe_from_proto(
    position: int, header: submap_pb2.SubmapHeader, blobs: Sequence[bytes]
) -> Keyframe:
    message = header.keyframes[position]
    size = (header.camera.width, header.camera.height)
    colour_info = header.blobs[message.colour_blob]
    depth_info = header.blobs[message.depth_blob]
    return Keyframe(
        frame_index=message.frame_index,
        timestamp_s=message.timestamp_s,
        anchor_from_camera=geometry.pose_from_proto(message.anchor_from_camera),
        colour=images.decode_colour(blobs[message.colour_blob], colour_info.media_type, size=size),
        depth=images.decode_depth(
            blobs[message.depth_blob],
            depth_info.media_type,
            metres_per_unit=depth_info.metres_per_unit,
            size=size,
        ),
        descriptor=geometry.vector_from_proto(message.image_descriptor),
    )


def decode_keyframe_descriptors(
    header: submap_pb2.SubmapHeader,
) -> tuple[tuple[int, NDArray[np.float32]], ...]:
    """(place among the keyframes, unit vector (d,)) of those of a checked header that have one."""
    vectors = [geometry.vector_from_proto(item.image_descriptor) for item in header.keyframes]
    return tuple((place, vector) for place, vector in enumerate(vectors) if vector is not None)


def _frame_to_proto(frame: TrackedFrame) -> submap_pb2.TrackedFrame:
    return submap_pb2.TrackedFrame(
        frame_index=frame.frame_index,
        timestamp_s=frame.timestamp_s,
        anchor_from_camera=geometry.pose_to_proto(frame.anchor_from_camera),
        lost=frame.lost,
    )


def _odometry_to_proto(edge: OdometryEdge) -> submap_pb2.OdometryEdge:
    return submap_pb2.OdometryEdge(
        previous_index=edge.previous_index,
        previous_from_anchor=geometry.pose_to_proto(edge.previous_from_anchor),
        information=geometry.information_to_list(np.asarray(edge.information)),
    )


def _encode_gaussians(cloud: GaussianCloud, encoding: SubmapEncoding) -> bytes:
    if encoding.gaussians == "lossless":
        return codec.encode_lossless(cloud)
    return codec.encode_compact(cloud)


def _encode_colour(keyframe: Keyframe, encoding: SubmapEncoding) -> tuple[bytes, str]:
    if encoding.colour == "png":
        return images.encode_colour_png(keyframe.colour), images.PNG
    quality = encoding.jpeg_quality
    return images.encode_colour_jpeg(keyframe.colour, quality=quality), images.JPEG
