"""The Gaussian codec: lossless is lossless, compact is bounded, bad bytes are refused."""

from __future__ import annotations

import struct

import numpy as np
import pytest
import zstandard

from magic_core.errors import CorruptData, InvalidInput, MagicError, ResourceExhausted
from magic_core.gaussians import GaussianCloud, codec


def cloud(count: int, *, seed: int = 0, extent_m: float = 5.0) -> GaussianCloud:
    rng = np.random.default_rng(seed)
    quaternions = rng.normal(size=(count, 4))
    return GaussianCloud.from_arrays(
        rng.uniform(-extent_m, extent_m, (count, 3)),
        quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True),
        scales=np.exp(rng.uniform(-9.0, 0.0, (count, 3))),
        opacities=rng.uniform(0.01, 0.99, count),
        colours=rng.uniform(0.0, 1.0, (count, 3)),
    )


def matched(original: GaussianCloud, decoded: GaussianCloud) -> GaussianCloud:
    """The decoded Gaussians in the order of the original ones."""
    distance = np.linalg.norm(original.means[:, None] - decoded.means[None], axis=2)
    nearest = distance.argmin(axis=1)
    assert len(set(nearest.tolist())) == len(original)
    return decoded.select(nearest)


@pytest.mark.parametrize("count", [0, 1, 2, 777])
def test_lossless_returns_every_bit_in_order(count: int) -> None:
    original = cloud(count)
    decoded = codec.decode(codec.encode_lossless(original))
    for before, after in zip(original.arrays(), decoded.arrays(), strict=True):
        assert before.shape == after.shape
        assert before.tobytes() == after.tobytes()


@pytest.mark.parametrize("count", [0, 1, 2, 777])
def test_compact_keeps_the_number_of_gaussians(count: int) -> None:
    data = codec.encode_compact(cloud(count))
    assert codec.gaussian_count(data) == count
    assert len(codec.decode(data)) == count


@pytest.mark.parametrize("step_m", [0.0005, 0.004])
def test_compact_errors_stay_within_the_stated_bounds(step_m: float) -> None:
    original = cloud(800)
    options = codec.CompactOptions(position_step_m=step_m)
    decoded = matched(original, codec.decode(codec.encode_compact(original, options)))
    # A float32 at 10 m has a spacing of 1e-6 m.
    assert np.abs(decoded.means - original.means).max() <= step_m / 2 + 1e-6
    assert np.abs(np.log(decoded.scales / original.scales)).max() <= 0.02
    assert np.abs(decoded.opacities - original.opacities).max() <= 1 / 512 + 1e-6
    assert np.abs(decoded.colours - original.colours).max() <= 1 / 510 + 1e-6
    cosine = np.abs((decoded.quaternions * original.quaternions).sum(axis=1))
    assert np.degrees(2 * np.arccos(np.minimum(cosine, 1.0))).max() <= 2.3


def test_compact_is_less_than_a_third_of_lossless() -> None:
    original = cloud(20_000)
    assert 3 * len(codec.encode_compact(original)) < len(codec.encode_lossless(original))


def test_compact_takes_a_coarser_grid_for_a_huge_extent() -> None:
    original = cloud(50, extent_m=50_000.0)
    decoded = codec.decode(codec.encode_compact(original))
    distance = np.linalg.norm(original.means[:, None] - decoded.means[None], axis=2).min(axis=1)
    assert distance.max() <= 100_000.0 / 2**21 * np.sqrt(3) + 0.01  # float32 at 50 km: 4 mm


def test_compact_keeps_colours_beyond_the_unit_range() -> None:
    original = cloud(64)
    bright = GaussianCloud(*original.arrays()[:4], original.colours * 3.0 - 1.0)
    decoded = matched(bright, codec.decode(codec.encode_compact(bright)))
    assert np.abs(decoded.colours - bright.colours).max() <= 3.0 / 510 + 1e-5


def test_equal_clouds_give_equal_bytes() -> None:
    assert codec.encode_compact(cloud(300)) == codec.encode_compact(cloud(300))


@pytest.mark.parametrize("encode", [codec.encode_lossless, codec.encode_compact])
def test_truncated_or_extended_bytes_are_corrupt(encode) -> None:
    data = encode(cloud(100))
    for bad in (b"", data[:5], data[:12], data[:-1], data[: len(data) // 2], data + b"\0"):
        with pytest.raises(CorruptData):
            codec.decode(bad)


@pytest.mark.parametrize(("position", "value"), [(0, 0x58), (4, 2), (5, 9), (8, 0xFF), (13, 0)])
def test_a_changed_header_is_corrupt(position: int, value: int) -> None:
    data = bytearray(codec.encode_lossless(cloud(100)))
    data[position] = value
    with pytest.raises(CorruptData):
        codec.decode(bytes(data))


def test_a_count_beyond_the_limit_is_refused_before_anything_is_decompressed() -> None:
    data = codec.encode_lossless(cloud(101))
    with pytest.raises(ResourceExhausted):
        codec.decode(data, max_gaussians=100)


@pytest.mark.parametrize("count", [0, 1])
def test_a_frame_that_expands_beyond_its_count_is_refused_unread(count: int) -> None:
    bomb = zstandard.ZstdCompressor().compress(bytes(200 << 20))
    for layout in (codec.LOSSLESS, codec.PACKED, codec.COMPACT):
        data = struct.pack("<4sBBHI", codec.MAGIC, codec.VERSION, layout, 0, count) + bomb
        with pytest.raises(CorruptData):
            codec.decode(data)


@pytest.mark.parametrize(
    ("column", "value"), [(0, np.nan), (1, 0.0), (2, -1.0), (2, 0.0), (3, 1.5), (4, np.inf)]
)
def test_values_out_of_range_are_invalid(column: int, value: float) -> None:
    arrays = [array.copy() for array in cloud(10).arrays()]
    arrays[column][3] = value
    with pytest.raises(InvalidInput) as caught:
        codec.decode(codec.encode_lossless(GaussianCloud(*arrays)))
    assert caught.value.violations


def test_random_damage_never_raises_anything_unexpected() -> None:
    rng = np.random.default_rng(3)
    for encode in (codec.encode_lossless, codec.encode_compact):
        good = encode(cloud(60))
        for _ in range(300):
            bad = bytearray(good)
            for position in rng.integers(0, len(bad), rng.integers(1, 4)):
                bad[position] = rng.integers(0, 256)
            try:
                decoded = codec.decode(bytes(bad))
            except MagicError:
                continue
            decoded.validate()
