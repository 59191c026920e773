"""`codec.check` accepts and refuses what `codec.decode` does, without making the cloud."""

from __future__ import annotations

import random

import numpy as np
import pytest
import zstandard

from magic_core.errors import CorruptData, MagicError, ResourceExhausted
from magic_core.gaussians import GaussianCloud, codec
from tests.faults.mutations import mutated_frame
from tests.small_world import make_submap


def verdict(function, data: bytes) -> tuple[type, object]:
    try:
        found = function(data)
    except MagicError as error:
        return type(error), error.reason
    return int, found if isinstance(found, int) else len(found)


def test_it_counts_right_blobs_of_either_layout() -> None:
    cloud = make_submap().gaussians
    for data in (codec.encode_compact(cloud), codec.encode_lossless(cloud)):
        assert codec.check(data) == len(cloud)
    empty = GaussianCloud.empty()
    assert (
        codec.check(codec.encode_compact(empty)) == codec.check(codec.encode_lossless(empty)) == 0
    )


def test_it_agrees_with_decoding_on_damaged_blobs() -> None:
    rng = random.Random(3)
    right = codec.encode_compact(make_submap().gaussians)
    refused = 0
    for _ in range(1500):
        data = mutated_frame(right, rng, header_bytes=12)
        with np.errstate(over="ignore"):
            expected = verdict(codec.decode, data)
        assert verdict(codec.check, data) == expected
        refused += expected[0] is not int
    assert 300 < refused < 1400


@pytest.mark.parametrize(("column", "code"), [(12, 4), (13, 128), (15, 255)])
def test_a_rotation_that_no_code_means_is_refused_by_both(column: int, code: int) -> None:
    right = codec.encode_compact(make_submap().gaussians)
    n = codec.gaussian_count(right)
    content = bytearray(zstandard.ZstdDecompressor().decompress(right[codec.HEADER_BYTES :]))
    content[codec.RANGES_BYTES + column * n + n // 2] = code
    damaged = right[: codec.HEADER_BYTES] + zstandard.ZstdCompressor().compress(bytes(content))
    for function in (codec.decode, codec.check):
        with pytest.raises(CorruptData, match="rotation"):
            function(damaged)


def test_it_bounds_the_number() -> None:
    data = codec.encode_compact(make_submap().gaussians)
    with pytest.raises(ResourceExhausted):
        codec.check(data, max_gaussians=10)
