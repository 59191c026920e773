"""docs/wire-format.md is enough: a decoder made from the page alone reads what the codec writes."""

from __future__ import annotations

import math
import struct

import numpy as np
import zstandard

from magic_core.gaussians import GaussianCloud, codec


def cloud(count: int) -> GaussianCloud:
    rng = np.random.default_rng(5)
    quaternions = rng.normal(size=(count, 4))
    return GaussianCloud.from_arrays(
        rng.uniform(-4, 4, (count, 3)),
        quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True),
        scales=np.exp(rng.uniform(-8, -1, (count, 3))),
        opacities=rng.uniform(0, 1, count),
        colours=rng.uniform(0, 1, (count, 3)),
    )


def content(data: bytes, layout: int) -> tuple[int, bytes]:
    """n and the content of the zstd frame."""
    magic, version, found, reserved, n = struct.unpack_from("<4sBBHI", data)
    assert (magic, version, found, reserved) == (b"MGSC", 1, layout, 0)
    return n, zstandard.ZstdDecompressor().decompress(data[12:])


def byte_planes(data: bytes, m: int) -> list[int]:
    return [sum(data[plane * m + i] << (8 * plane) for plane in range(4)) for i in range(m)]


def test_layout_0_is_five_columns_of_float32() -> None:
    original = cloud(40)
    n, data = content(codec.encode_lossless(original), 0)
    assert len(data) == 56 * n
    numbers = struct.unpack(f"<{14 * n}f", data)
    expected = np.concatenate([array.reshape(-1) for array in original.arrays()])
    np.testing.assert_array_equal(np.array(numbers, np.float32), expected)


def test_layout_1_is_as_the_page_says() -> None:
    encoded = codec.encode_compact(cloud(200))
    decoded = codec.decode(encoded)
    n, data = content(encoded, 1)
    assert len(data) == 48 + 23 * n
    *origin, step, s0, s1, c0, c1 = struct.unpack_from("<4d4f", data)
    at = 48
    positions, at = byte_planes(data[at:], 3 * n), at + 12 * n
    rotations, at = byte_planes(data[at:], n), at + 4 * n
    scales, opacities, colours = data[at:], data[at + 3 * n :], data[at + 4 * n :]
    for axis in range(3):
        grid = 0
        for i in range(n):
            code = positions[axis * n + i]
            grid += (code >> 1) ^ -(code & 1)
            assert abs(origin[axis] + grid * step - decoded.means[i, axis]) < 1e-5
            scale = math.exp(s0 + scales[axis * n + i] * (s1 - s0) / 255)
            assert abs(scale / decoded.scales[i, axis] - 1) < 1e-5
            colour = c0 + colours[axis * n + i] * (c1 - c0) / 255
            assert abs(colour - decoded.colours[i, axis]) < 1e-5
    for i in range(n):
        rest = [(2 * (rotations[i] >> shift & 1023) / 1023 - 1) / math.sqrt(2)
                for shift in (20, 10, 0)]  # fmt: skip
        missing = math.sqrt(1 - sum(value * value for value in rest))
        rest.insert(rotations[i] >> 30, missing)
        np.testing.assert_allclose(rest, decoded.quaternions[i], atol=1e-5)
        assert abs((opacities[i] + 0.5) / 256 - decoded.opacities[i]) < 1e-6
