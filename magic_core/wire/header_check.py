"""The rules of a sub-map header, checked before a byte of its blobs is taken."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from magicslam.v1 import submap_pb2

from magic_core.errors import FieldViolation, InvalidInput, ResourceExhausted
from magic_core.wire import geometry, images, names

MAX_VIOLATIONS = 32
_ANCHOR_RULE = "the anchor's pose is the identity"
_IDENTITY_ROW = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
_MEDIA_TYPES = {
    submap_pb2.BLOB_ROLE_GAUSSIANS: ("application/vnd.magicslam.gaussians",),
    submap_pb2.BLOB_ROLE_COLOUR: images.COLOUR_MEDIA_TYPES,
    submap_pb2.BLOB_ROLE_DEPTH: images.DEPTH_MEDIA_TYPES,
}


@dataclass(frozen=True, slots=True)
class SubmapLimits:
    """What a sub-map may at most be."""

    max_bytes: int = 512 << 20
    """Bytes of all its blobs."""
    max_frames: int = 20_000
    """Frames in its trajectory."""
    max_keyframes: int = 2_000
    """Keyframes stored with it."""
    max_pixels: int = 16_000_000
    """Pixels of one image."""
    max_gaussians: int = 5_000_000
    """Gaussians in it."""
    max_descriptor_dimension: int = 8192
    """Length of its descriptor."""
    max_described_keyframes: int = 32
    """Keyframes with a descriptor of their own; each is one more vector in the index."""


def check_header(header: submap_pb2.SubmapHeader, limits: SubmapLimits = SubmapLimits()) -> None:
    """Raise InvalidInput with every rule that is broken (at most 32 named), or ResourceExhausted.

    Slow for thousands of frames: call it off the event loop.
    """
    _check_limits(header, limits)
    _check_described(header, limits)
    found: list[FieldViolation] = []
    for violation in _violations(header, limits):
        found.append(violation)
        if len(found) == MAX_VIOLATIONS:
            break
    if found:
        more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
        message = f"{found[0].field}: {found[0].description}{more}"
        raise InvalidInput(message, violations=tuple(found))


def request_id_problem(request_id: str) -> str | None:
    """What is wrong with a request id, or None."""
    if 1 <= len(request_id) <= 128 and request_id.isprintable():
        return None
    return "must be 1 to 128 printable characters"


def _check_limits(header: submap_pb2.SubmapHeader, limits: SubmapLimits) -> None:
    amounts = {
        "frames": (len(header.trajectory), limits.max_frames),
        "keyframes": (len(header.keyframes), limits.max_keyframes),
        "blobs": (len(header.blobs), 2 * limits.max_keyframes + 1),
        "bytes": (sum(blob.length for blob in header.blobs), limits.max_bytes),
    }
    for what, (amount, limit) in amounts.items():
        if amount > limit:
            raise ResourceExhausted(
                f"the sub-map has {amount} {what}, this server takes {limit}; make sub-maps shorter"
            )


def _check_described(header: submap_pb2.SubmapHeader, limits: SubmapLimits) -> None:
    described = sum(bool(keyframe.image_descriptor) for keyframe in header.keyframes)
    if described > (limit := limits.max_described_keyframes):
        raise ResourceExhausted(
            f"{described} keyframes of the sub-map have descriptors, this server takes {limit}; "
            "describe fewer"
        )


def _violations(header: submap_pb2.SubmapHeader, limits: SubmapLimits) -> Iterator[FieldViolation]:
    yield from _identity_violations(header)
    if (pixels := header.camera.width * header.camera.height) > limits.max_pixels:
        rule = f"{pixels} pixels per image, at most {limits.max_pixels}; send smaller images"
        yield FieldViolation("camera.width", rule)
    yield from _trajectory_violations(header)
    yield from _blob_violations(header)
    yield from _keyframe_violations(header)
    yield from _odometry_violations(header)
    dimension = limits.max_descriptor_dimension
    if problem := geometry.descriptor_problem(header.image_descriptor, max_dimension=dimension):
        yield FieldViolation("image_descriptor", problem)
    yield from _keyframe_descriptor_violations(header)
    if header.HasField("world_from_anchor_prior"):
        row = geometry.pose_row(header.world_from_anchor_prior)
        if problem := geometry.pose_problems(row[None])[0]:
            yield FieldViolation("world_from_anchor_prior", problem)


def _identity_violations(header: submap_pb2.SubmapHeader) -> Iterator[FieldViolation]:
    try:
        names.parse_submap(header.name)
    except InvalidInput as error:
        yield from error.violations
    if problem := request_id_problem(header.request_id):
        yield FieldViolation("request_id", problem)
    try:
        geometry.camera_from_proto(header.camera)
    except InvalidInput as error:
        yield from error.violations


def _trajectory_violations(header: submap_pb2.SubmapHeader) -> Iterator[FieldViolation]:
    frames = header.trajectory
    if not frames:
        yield FieldViolation("trajectory", "is empty; the first frame is the anchor")
        return
    rows = geometry.pose_rows(frame.anchor_from_camera for frame in frames)
    yield from _pose_violations("trajectory", rows)
    if not _is_identity(rows[0]):
        yield FieldViolation("trajectory[0].anchor_from_camera", _ANCHOR_RULE)
    times = np.array([frame.timestamp_s for frame in frames])
    if not np.isfinite(times).all():
        yield FieldViolation("trajectory", "a timestamp is NaN or infinite")
    elif (late := np.flatnonzero(np.diff(times) <= 0)).size:
        at = int(late[0]) + 1
        yield FieldViolation(
            f"trajectory[{at}].timestamp_s", "not after the frame before; times strictly increase"
        )
    if (late := np.flatnonzero(np.diff([frame.frame_index for frame in frames]) <= 0)).size:
        at = int(late[0]) + 1
        yield FieldViolation(
            f"trajectory[{at}].frame_index", "not after the frame before; numbers strictly increase"
        )


def _keyframe_violations(header: submap_pb2.SubmapHeader) -> Iterator[FieldViolation]:
    keyframes = header.keyframes
    if not keyframes:
        yield FieldViolation("keyframes", "is empty; keyframe 0 is the anchor image")
        return
    rows = geometry.pose_rows(keyframe.anchor_from_camera for keyframe in keyframes)
    yield from _pose_violations("keyframes", rows)
    if not _is_identity(rows[0]):
        yield FieldViolation("keyframes[0].anchor_from_camera", _ANCHOR_RULE)
    frames = {frame.frame_index for frame in header.trajectory}
    for i, keyframe in enumerate(keyframes):
        if keyframe.frame_index not in frames:
            rule = f"frame {keyframe.frame_index} is not in the trajectory"
            yield FieldViolation(f"keyframes[{i}].frame_index", rule)
        if not np.isfinite(keyframe.timestamp_s):
            yield FieldViolation(f"keyframes[{i}].timestamp_s", "must be finite")
        wanted = (
            ("colour_blob", keyframe.colour_blob, submap_pb2.BLOB_ROLE_COLOUR),
            ("depth_blob", keyframe.depth_blob, submap_pb2.BLOB_ROLE_DEPTH),
        )
        for field, index, role in wanted:
            if problem := _reference_problem(header, index, role):
                yield FieldViolation(f"keyframes[{i}].{field}", problem)
    if frames and keyframes[0].frame_index != header.trajectory[0].frame_index:
        yield FieldViolation("keyframes[0].frame_index", "must be the trajectory's first frame")


def _keyframe_descriptor_violations(header: submap_pb2.SubmapHeader) -> Iterator[FieldViolation]:
    length = len(header.image_descriptor.vector)
    for i, keyframe in enumerate(header.keyframes):
        values = keyframe.image_descriptor
        problem = geometry.unit_problem(values) if values else None
        if values and i == 0:
            problem = "the descriptor of keyframe 0 is the sub-map's `image_descriptor`"
        elif values and len(values) != length:
            problem = f"{len(values)} numbers, expected the {length} of `image_descriptor`"
        if problem:
            yield FieldViolation(f"keyframes[{i}].image_descriptor", problem)


def _blob_violations(header: submap_pb2.SubmapHeader) -> Iterator[FieldViolation]:
    gaussians = submap_pb2.BLOB_ROLE_GAUSSIANS
    if problem := _reference_problem(header, header.gaussians_blob, gaussians):
        yield FieldViolation("gaussians_blob", problem)
    used = {header.gaussians_blob}
    used.update(*((k.colour_blob, k.depth_blob) for k in header.keyframes))
    for i, blob in enumerate(header.blobs):
        field = f"blobs[{i}]"
        if blob.media_type not in _MEDIA_TYPES.get(blob.role, ()):
            allowed = ", ".join(_MEDIA_TYPES.get(blob.role, ("a known role",)))
            yield FieldViolation(f"{field}.media_type", f"{blob.media_type!r}, expected {allowed}")
        if blob.length == 0:
            yield FieldViolation(f"{field}.length", "must be above 0")
        if len(blob.sha256) != 32:
            yield FieldViolation(f"{field}.sha256", f"{len(blob.sha256)} bytes, expected 32")
        if blob.role == submap_pb2.BLOB_ROLE_DEPTH and not 0.0 < blob.metres_per_unit <= 1.0:
            rule = f"{blob.metres_per_unit}, expected above 0 and at most 1"
            yield FieldViolation(f"{field}.metres_per_unit", rule)
        if i not in used:
            yield FieldViolation(field, "neither `gaussians_blob` nor a keyframe refers to it")


def _odometry_violations(header: submap_pb2.SubmapHeader) -> Iterator[FieldViolation]:
    if not header.HasField("odometry"):
        return
    edge = header.odometry
    index = header.name.rpartition("/")[2]
    if index.isdigit() and edge.previous_index >= int(index):
        rule = f"{edge.previous_index} is not before {index}"
        yield FieldViolation("odometry.previous_index", rule)
    row = geometry.pose_row(edge.previous_from_anchor)
    if problem := geometry.pose_problems(row[None])[0]:
        yield FieldViolation("odometry.previous_from_anchor", problem)
    if problem := geometry.information_problem(edge.information):
        yield FieldViolation("odometry.information", problem)


def _pose_violations(field: str, rows: np.ndarray) -> Iterator[FieldViolation]:
    for i, problem in enumerate(geometry.pose_problems(rows)):
        if problem:
            yield FieldViolation(f"{field}[{i}].anchor_from_camera", problem)


def _is_identity(row: np.ndarray) -> bool:
    """True for the identity, up to rounding and the sign of the quaternion."""
    sign = -1.0 if row[3] < 0 else 1.0
    return bool(np.allclose(row * np.array([1, 1, 1, sign, sign, sign, sign]), _IDENTITY_ROW,
                            atol=1e-6))  # fmt: skip


def _reference_problem(
    header: submap_pb2.SubmapHeader, index: int, role: submap_pb2.BlobRole.ValueType
) -> str | None:
    if index >= len(header.blobs):
        return f"blob {index} of {len(header.blobs)}"
    if header.blobs[index].role != role:
        return f"blob {index} is not of role {submap_pb2.BlobRole.Name(role)}"
    return None
