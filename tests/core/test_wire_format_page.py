"""docs/wire-format.md is enough: a decoder made from the page alone reads what the codec writes."""

from __future__ import annotations

import math
import struct

import numpy as np
import pytest
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


def written_before(n: int) -> bytes:
    """A blob of layout 1, as agents sent it before; its codes are any."""
    rng = np.random.default_rng(2)
    positions = np.zeros((4, 3 * n), np.uint8)
    positions[:2] = rng.integers(0, 256, (2, 3 * n))
    others = rng.integers(0, 256, 11 * n).astype(np.uint8)
    # Rotation levels of which the sum of squares stays below 1, as a writer's do.
    levels = rng.integers(300, 724, (n, 3)).astype(np.uint32)
    codes = rng.integers(0, 4, n).astype(np.uint32) << 30
    codes |= levels[:, 0] << 20 | levels[:, 1] << 10 | levels[:, 2]
    others[: 4 * n] = codes.astype("<u4").view(np.uint8).reshape(n, 4).T.reshape(-1)
    ranges = struct.pack("<4d4f", 1.5, -2.0, 0.25, 0.0005, -7.0, -2.0, -0.1, 1.2)
    data = ranges + positions.tobytes() + others.tobytes()
    header = struct.pack("<4sBBHI", b"MGSC", 1, 1, 0, n)
    return header + zstandard.ZstdCompressor().compress(data)


@pytest.mark.parametrize("layout", [1, 2])
def test_the_compact_layouts_are_as_the_page_says(layout: int) -> None:
    encoded = codec.encode_compact(cloud(200)) if layout == 2 else written_before(200)
    decoded = codec.decode(encoded)
    n, data = content(encoded, layout)
    assert len(data) == 48 + 23 * n
    *origin, step, s0, s1, c0, c1 = struct.unpack_from("<4d4f", data)
    at = 48
    positions, at = byte_planes(data[at:], 3 * n), at + 12 * n
    rotations, at = data[at:], at + 4 * n
    scales, opacities, colours = data[at:], data[at + 3 * n :], data[at + 4 * n :]
    rgb = colours_1(colours, n) if layout == 1 else colours_2(colours, n)
    for axis in range(3):
        grid = 0
        for i in range(n):
            code = positions[axis * n + i]
            grid += (code >> 1) ^ -(code & 1)
            assert abs(origin[axis] + grid * step - decoded.means[i, axis]) < 1e-4
            scale = math.exp(s0 + scales[axis * n + i] * (s1 - s0) / 255)
            assert abs(scale / decoded.scales[i, axis] - 1) < 1e-5
            colour = c0 + rgb[i][axis] * (c1 - c0) / 255
            assert abs(colour - decoded.colours[i, axis]) < 1e-5
    for i in range(n):
        largest, rest = rotation_1(rotations, i, n) if layout == 1 else rotation_2(rotations, i, n)
        missing = math.sqrt(1 - sum(value * value for value in rest))
        rest.insert(largest, missing)
        np.testing.assert_allclose(rest, decoded.quaternions[i], atol=1e-5)
        assert abs((opacities[i] + 0.5) / 256 - decoded.opacities[i]) < 1e-6


def rotation_1(data: bytes, i: int, n: int) -> tuple[int, list[float]]:
    code = sum(data[plane * n + i] << (8 * plane) for plane in range(4))
    levels = (code >> 20 & 1023, code >> 10 & 1023, code & 1023)
    return code >> 30, [(2 * level / 1023 - 1) / math.sqrt(2) for level in levels]


def rotation_2(data: bytes, i: int, n: int) -> tuple[int, list[float]]:
    levels = (data[n + i], data[2 * n + i], data[3 * n + i])
    return data[i], [(2 * level / 127 - 1) / math.sqrt(2) for level in levels]


def colours_1(data: bytes, n: int) -> list[tuple[int, int, int]]:
    return [(data[i], data[n + i], data[2 * n + i]) for i in range(n)]


def colours_2(data: bytes, n: int) -> list[tuple[int, int, int]]:
    found, green, red, blue = [], 0, 0, 0
    for i in range(n):
        green = (green + data[i]) % 256
        red = (red + data[n + i]) % 256
        blue = (blue + data[2 * n + i]) % 256
        found.append(((green + red) % 256, green, (green + blue) % 256))
    return found
