"""Sub-maps as header and blobs: what goes in comes out, within what the encoding may lose."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from magicslam.v1 import submap_pb2

from magic_core.errors import CorruptData, FieldViolation, InvalidInput, ResourceExhausted
from magic_core.submap import Submap
from magic_core.wire import (
    SubmapEncoding,
    SubmapLimits,
    check_blob,
    check_header,
    decode_submap,
    encode_submap,
    images,
)
from magic_core.wire.chunks import sha256
from magic_core.wire.submap import decode_keyframe_descriptors
from tests.small_world import DIMENSION, make_submap


def assert_same_but_for_images(a: Submap, b: Submap) -> None:
    assert (a.name, a.camera) == (b.name, b.camera)
    assert [f.frame_index for f in a.trajectory] == [f.frame_index for f in b.trajectory]
    assert [f.lost for f in a.trajectory] == [f.lost for f in b.trajectory]
    for x, y in zip((*a.trajectory, *a.keyframes), (*b.trajectory, *b.keyframes), strict=True):
        assert x.timestamp_s == y.timestamp_s
        np.testing.assert_allclose(x.anchor_from_camera, y.anchor_from_camera, atol=1e-12)
    assert a.descriptor.model_id == b.descriptor.model_id
    np.testing.assert_array_equal(a.descriptor.vector, b.descriptor.vector)
    assert (a.odometry is None) == (b.odometry is None)
    if a.odometry is not None and b.odometry is not None:
        assert a.odometry.previous_index == b.odometry.previous_index
        motions = a.odometry.previous_from_anchor, b.odometry.previous_from_anchor
        np.testing.assert_allclose(*motions, atol=1e-12)
        np.testing.assert_array_equal(a.odometry.information, b.odometry.information)


def test_lossless_keeps_gaussians_and_colours_and_depth_to_half_a_step() -> None:
    submap = make_submap(index=1)
    encoded = encode_submap(submap, request_id="r", encoding=SubmapEncoding.lossless())
    decoded = decode_submap(encoded.header, encoded.blobs)
    assert_same_but_for_images(submap, decoded)
    for before, after in zip(submap.gaussians.arrays(), decoded.gaussians.arrays(), strict=True):
        np.testing.assert_array_equal(before, after)
    for before, after in zip(submap.keyframes, decoded.keyframes, strict=True):
        np.testing.assert_array_equal(before.colour, after.colour)
        assert np.abs(before.depth - after.depth).max() <= 0.000501


def test_compact_is_smaller_and_close() -> None:
    submap = make_submap(index=1)
    compact = encode_submap(submap, request_id="r")
    lossless = encode_submap(submap, request_id="r", encoding=SubmapEncoding.lossless())
    assert compact.wire_bytes < lossless.wire_bytes
    assert len(compact.blobs[0]) < len(lossless.blobs[0])
    decoded = decode_submap(compact.header, compact.blobs)
    assert_same_but_for_images(submap, decoded)
    assert len(decoded.gaussians) == len(submap.gaussians)
    for before, after in zip(submap.keyframes, decoded.keyframes, strict=True):
        difference = before.colour.astype(float) - after.colour.astype(float)
        assert np.sqrt((difference**2).mean()) < 12.0  # the texture is the worst case for JPEG


def test_a_known_start_travels_with_the_submap() -> None:
    submap = make_submap(known_start=True)
    encoded = encode_submap(submap, request_id="r")
    decoded = decode_submap(encoded.header, encoded.blobs)
    assert submap.world_from_anchor_prior is not None
    assert decoded.world_from_anchor_prior is not None
    np.testing.assert_allclose(
        decoded.world_from_anchor_prior, submap.world_from_anchor_prior, atol=1e-12
    )


def test_descriptors_of_keyframes_travel_bit_by_bit_and_cost_nothing_without() -> None:
    submap = make_submap(index=1, keyframes=3, described=True)
    encoded = encode_submap(submap, request_id="r")
    check_header(encoded.header)
    decoded = decode_submap(encoded.header, encoded.blobs)
    assert decoded.anchor.descriptor is None
    for before, after in zip(submap.keyframes[1:], decoded.keyframes[1:], strict=True):
        assert before.descriptor is not None
        assert after.descriptor is not None
        np.testing.assert_array_equal(before.descriptor, after.descriptor)
    places = [place for place, _ in decode_keyframe_descriptors(encoded.header)]
    assert places == [1, 2]
    bare = encode_submap(make_submap(index=1, keyframes=3), request_id="r")
    # Packed: four bytes per number, and a tag with two lengths.
    assert 0 < encoded.header.ByteSize() - bare.header.ByteSize() - 2 * 4 * DIMENSION < 16
    for keyframe in encoded.header.keyframes:
        keyframe.ClearField("image_descriptor")
    assert encoded.header.SerializeToString(True) == bare.header.SerializeToString(True)


def test_depth_beyond_the_range_becomes_no_reading() -> None:
    submap = make_submap()
    depth = submap.anchor.depth.copy()
    depth[0, 0], depth[0, 1], depth[0, 2], depth[0, 3] = 70.0, np.nan, np.inf, 65.0
    anchor = dataclasses.replace(submap.anchor, depth=depth)
    changed = dataclasses.replace(submap, keyframes=(anchor,))
    encoded = encode_submap(changed, request_id="r")
    decoded = decode_submap(encoded.header, encoded.blobs)
    np.testing.assert_allclose(decoded.anchor.depth[0, :4], [0.0, 0.0, 0.0, 65.0], atol=1e-3)


def test_encoding_twice_gives_the_same_bytes() -> None:
    first = encode_submap(make_submap(), request_id="r")
    second = encode_submap(make_submap(), request_id="r")
    assert first.blobs == second.blobs
    assert first.header == second.header


def test_a_bent_pose_never_leaves_this_side() -> None:
    submap = make_submap(index=1)
    assert submap.odometry is not None
    bent = dataclasses.replace(submap.odometry, previous_from_anchor=np.diag([1.0, 1.1, 1.0, 1.0]))
    with pytest.raises(InvalidInput, match="rotation"):
        encode_submap(dataclasses.replace(submap, odometry=bent), request_id="r")


def header_of(index: int = 1) -> submap_pb2.SubmapHeader:
    header = submap_pb2.SubmapHeader()
    header.CopyFrom(encode_submap(make_submap(index=index), request_id="r").header)
    return header


def violations(header: submap_pb2.SubmapHeader) -> tuple[FieldViolation, ...]:
    with pytest.raises(InvalidInput) as caught:
        check_header(header)
    return caught.value.violations


def test_a_right_header_passes() -> None:
    for index in (0, 1):
        check_header(header_of(index))


def _set_nan(header: submap_pb2.SubmapHeader) -> None:
    header.trajectory[2].anchor_from_camera.x = float("nan")


def _unnormalise(header: submap_pb2.SubmapHeader) -> None:
    header.keyframes[1].anchor_from_camera.qw = 2.0


def _describe_keyframe(header: submap_pb2.SubmapHeader, place: int, values: list[float]) -> None:
    header.keyframes[place].image_descriptor[:] = values


UNIT = [1.0] + [0.0] * (DIMENSION - 1)

BROKEN = {
    "name": lambda h: setattr(h, "name", "sessions/../agents/a/submaps/1"),
    "request_id": lambda h: setattr(h, "request_id", ""),
    "camera.width": lambda h: setattr(h.camera, "width", 100_000_000),
    "camera.fx": lambda h: setattr(h.camera, "fx", float("inf")),
    "trajectory": lambda h: h.ClearField("trajectory"),
    "trajectory[2].anchor_from_camera": _set_nan,
    "trajectory[0].anchor_from_camera": lambda h: setattr(
        h.trajectory[0].anchor_from_camera, "x", 0.1
    ),
    "trajectory[1].timestamp_s": lambda h: setattr(h.trajectory[1], "timestamp_s", 0.0),
    "trajectory[3].frame_index": lambda h: setattr(h.trajectory[3], "frame_index", 1),
    "keyframes": lambda h: h.ClearField("keyframes"),
    "keyframes[1].anchor_from_camera": _unnormalise,
    "keyframes[1].frame_index": lambda h: setattr(h.keyframes[1], "frame_index", 99),
    "keyframes[1].colour_blob": lambda h: setattr(h.keyframes[1], "colour_blob", 77),
    "keyframes[1].depth_blob": lambda h: setattr(h.keyframes[1], "depth_blob", 0),
    "keyframes[0].image_descriptor": lambda h: _describe_keyframe(h, 0, UNIT),
    "keyframes[1].image_descriptor": lambda h: _describe_keyframe(h, 1, UNIT[:-1]),
    "image_descriptor": lambda h: h.image_descriptor.vector.append(0.5),
    "odometry.previous_index": lambda h: setattr(h.odometry, "previous_index", 1),
    "odometry.previous_from_anchor": lambda h: h.odometry.ClearField("previous_from_anchor"),
    "odometry.information": lambda h: h.odometry.information.pop(),
    "world_from_anchor_prior": lambda h: setattr(h.world_from_anchor_prior, "qw", 0.5),
    "gaussians_blob": lambda h: setattr(h, "gaussians_blob", 1),
    "blobs[1].media_type": lambda h: setattr(h.blobs[1], "media_type", "image/x-pickle"),
    "blobs[1].length": lambda h: setattr(h.blobs[1], "length", 0),
    "blobs[1].sha256": lambda h: setattr(h.blobs[1], "sha256", b"short"),
    "blobs[2].metres_per_unit": lambda h: setattr(h.blobs[2], "metres_per_unit", 0.0),
    "blobs[5]": lambda h: h.blobs.add().CopyFrom(h.blobs[4]),
}


@pytest.mark.parametrize("field", BROKEN)
def test_each_broken_rule_is_named(field: str) -> None:
    header = header_of()
    BROKEN[field](header)
    assert field in {violation.field for violation in violations(header)}


@pytest.mark.parametrize(
    ("values", "rule"),
    [
        ([*UNIT, 0.0], "expected the 144"),
        ([1.0], "expected the 144"),
        ([0.0] * DIMENSION, "norm 0"),
        ([float("nan"), *UNIT[1:]], "NaN or infinity"),
        ([float("inf"), *UNIT[1:]], "NaN or infinity"),
        ([3.4e38] * DIMENSION, "norm"),
        ([1.01, *UNIT[1:]], "norm 1.01"),
    ],
)
def test_a_keyframe_is_not_described_by_anything_but_a_unit_vector_of_the_length(
    values: list[float], rule: str
) -> None:
    header = header_of()
    _describe_keyframe(header, 1, UNIT)
    check_header(header)
    _describe_keyframe(header, 1, values)
    found = violations(header)[0]
    assert found.field == "keyframes[1].image_descriptor"
    assert rule in found.description


def test_more_described_keyframes_than_the_server_takes_are_refused() -> None:
    header = encode_submap(make_submap(keyframes=4, described=True), request_id="r").header
    check_header(header, SubmapLimits(max_described_keyframes=3))
    with pytest.raises(ResourceExhausted, match=r"3 keyframes .* takes 2; describe fewer"):
        check_header(header, SubmapLimits(max_described_keyframes=2))


def test_an_indefinite_information_matrix_is_refused() -> None:
    header = header_of()
    header.odometry.information[0] = -1.0
    assert violations(header)[0].field == "odometry.information"


def test_several_broken_rules_are_named_together_but_not_without_end() -> None:
    header = header_of()
    for frame in header.trajectory:
        frame.anchor_from_camera.qw = 3.0
    header.request_id = ""
    assert len(violations(header)) >= 5
    for _ in range(100):
        header.trajectory.add().CopyFrom(header.trajectory[1])
    assert len(violations(header)) == 32


@pytest.mark.parametrize(
    "limits",
    [
        SubmapLimits(max_bytes=100),
        SubmapLimits(max_frames=3),
        SubmapLimits(max_keyframes=1),
    ],
)
def test_a_submap_beyond_the_limits_is_refused(limits: SubmapLimits) -> None:
    with pytest.raises(ResourceExhausted):
        check_header(header_of(), limits)


def test_a_descriptor_longer_than_the_limit_is_refused() -> None:
    with pytest.raises(InvalidInput):
        check_header(header_of(), SubmapLimits(max_descriptor_dimension=DIMENSION - 1))


def test_every_blob_of_a_right_submap_passes() -> None:
    submap = make_submap(index=1)
    for encoding in (SubmapEncoding(), SubmapEncoding.lossless()):
        encoded = encode_submap(submap, request_id="r", encoding=encoding)
        counts = [check_blob(encoded.header, i, blob) for i, blob in enumerate(encoded.blobs)]
        assert sum(counts) == len(submap.gaussians)
        assert [info.length for info in encoded.header.blobs] == [len(b) for b in encoded.blobs]
        assert [info.sha256 for info in encoded.header.blobs] == [sha256(b) for b in encoded.blobs]


def test_an_image_of_another_size_is_refused_by_its_header_alone() -> None:
    encoded = encode_submap(make_submap(), request_id="r")
    other = submap_pb2.SubmapHeader()
    other.CopyFrom(encoded.header)
    other.camera.width = 60_000  # never decoded: the first bytes say 64 pixels
    for index in (1, 2):
        with pytest.raises(InvalidInput, match="the camera says") as caught:
            check_blob(other, index, encoded.blobs[index])
        assert caught.value.violations[0].field == f"blobs[{index}]"


def test_blobs_of_the_wrong_kind_are_corrupt_or_invalid() -> None:
    encoded = encode_submap(make_submap(), request_id="r")
    gaussians, colour, depth = encoded.blobs[:3]
    for index, wrong in ((0, colour), (1, gaussians), (1, depth), (2, colour), (2, colour[:50])):
        with pytest.raises((CorruptData, InvalidInput)):
            check_blob(encoded.header, index, wrong)


def test_a_colour_png_is_no_depth_image() -> None:
    encoding = SubmapEncoding.lossless()
    encoded = encode_submap(make_submap(), request_id="r", encoding=encoding)
    encoded.header.blobs[2].media_type = "image/png"
    with pytest.raises(InvalidInput, match="channels"):
        check_blob(encoded.header, 2, encoded.blobs[1])
    depth = images.encode_depth_png(make_submap().anchor.depth)
    with pytest.raises(InvalidInput, match="channels"):
        check_blob(encoded.header, 1, depth)


def test_a_truncated_image_is_corrupt() -> None:
    for encoding in (SubmapEncoding(), SubmapEncoding.lossless()):
        encoded = encode_submap(make_submap(), request_id="r", encoding=encoding)
        for index in (1, 2):
            with pytest.raises(CorruptData):
                check_blob(encoded.header, index, encoded.blobs[index][:40])
