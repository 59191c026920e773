"""Depth in planes: lossless, small, and no way to make a reader spend more than its size."""

from __future__ import annotations

import struct

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis.extra import numpy as hypothesis_numpy

from magic_core.errors import CorruptData, InvalidInput, MagicError
from magic_core.wire import depth_planes, images

SHAPES = hypothesis_numpy.array_shapes(min_dims=2, max_dims=2, max_side=40)


@settings(max_examples=60, deadline=None)
@given(hypothesis_numpy.arrays(np.uint16, SHAPES))
def test_any_image_comes_back(units):
    data = depth_planes.encode(units)
    assert depth_planes.read_size(data) == units.shape[::-1]
    np.testing.assert_array_equal(depth_planes.decode(data), units)


@pytest.mark.parametrize("count", [1, 2, 1024, 1025, 65536])
def test_few_depths_and_many_come_back(count: int):
    chosen = np.linspace(0, 65535, count).astype(np.uint16)
    units = np.random.default_rng(count).choice(chosen, (260, 260))
    units.flat[:count] = chosen[: units.size]
    data = depth_planes.encode(units)
    levels = struct.unpack_from("<H", data, 6)[0]
    assert levels == (count if count <= depth_planes.MAX_LEVELS else 0)
    np.testing.assert_array_equal(depth_planes.decode(data), units)


def test_depth_of_a_disparity_sensor_is_smaller_than_as_png():
    ys, xs = np.mgrid[:240, :320]
    disparity = 400 - 0.5 * ys - 0.2 * xs + np.random.default_rng(0).normal(0, 0.1, ys.shape)
    depth = (300.0 / (np.rint(disparity * 2) / 2)).astype(np.float32)
    planes, png = images.encode_depth(depth), images.encode_depth_png(depth)
    assert len(planes) < 0.8 * len(png)
    for data, media_type in ((planes, images.DEPTH_PLANES), (png, images.PNG)):
        decoded = images.decode_depth(data, media_type, metres_per_unit=0.001, size=(320, 240))
        np.testing.assert_allclose(decoded, depth, atol=0.00051)


def written(content: bytes, *, levels: int = 0, size: tuple[int, int] = (4, 3)) -> bytes:
    header = struct.pack("<4sBBHII", b"MGSD", 1, 0, levels, *size)
    return header + zstandard.ZstdCompressor().compress(content)


def test_an_image_written_by_the_specification_is_read():
    # Rows 5 6 4 and 5 5 65535, as differences 5 1 -2 and 5 0 -6.
    low = bytes([10, 2, 3, 10, 0, 11])
    assert depth_planes.decode(written(low + bytes(6), size=(3, 2))).tolist() == [
        [5, 6, 4],
        [5, 5, 65535],
    ]
    table = struct.pack("<3H", 0, 700, 900)
    codes = bytes([2, 2, 3])  # positions 1 2 0
    assert depth_planes.decode(
        written(table + codes + bytes(3), levels=3, size=(3, 1))
    ).tolist() == [[700, 900, 0]]


TABLE = struct.pack("<2H", 3, 9)


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"", "begin"),
        (b"MGSX" + bytes(30), "begin"),
        (written(bytes(24))[:20], "zstd|hold"),
        (written(bytes(24)) + b"more", "zstd"),
        (written(bytes(23)), "24 bytes"),
        (written(bytes(25)), "24 bytes"),
        (written(bytes(2_000_000)), "24 bytes"),
        (written(b"", size=(0, 3)), "header"),
        (written(bytes(24), levels=2000), "header"),
        (written(struct.pack("<2H", 9, 3) + bytes(24), levels=2), "increase"),
        (written(TABLE + b"\x04" + bytes(23), levels=2), "table of 2"),
    ],
)
def test_what_is_not_in_the_format_is_corrupt(data: bytes, says: str):
    with pytest.raises(CorruptData, match=says):
        depth_planes.decode(data)


def test_another_version_and_another_size_are_refused_before_decoding():
    data = bytearray(written(bytes(24)))
    data[4] = 2
    with pytest.raises(InvalidInput, match="version 2"):
        depth_planes.decode(bytes(data))
    huge = written(bytes(24), size=(60_000, 60_000))
    for size in ((60_000, 60_000), (4, 3)):
        with pytest.raises(InvalidInput, match="60000x60000"):
            images.check_image(huge, images.DEPTH_PLANES, size=size, depth=True)


def test_colour_is_never_read_as_depth_nor_depth_as_colour():
    depth = images.encode_depth(np.ones((3, 4), np.float32))
    with pytest.raises(MagicError):
        images.check_image(depth, images.DEPTH_PLANES, size=(4, 3), depth=False)
    with pytest.raises(MagicError):
        images.check_image(depth, images.PNG, size=(4, 3), depth=True)
