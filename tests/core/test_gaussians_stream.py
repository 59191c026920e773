"""Map files written from pieces."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from magic_core.gaussians import GaussianCloud, codec
from magic_core.gaussians.ply import read_ply, write_ply
from magic_core.gaussians.stream import (
    write_compact_pieces,
    write_lossless_pieces,
    write_ply_pieces,
)
from tests.core.test_gaussian_cloud import random_cloud


def pieces_of(cloud: GaussianCloud, *sizes: int):
    ends = np.cumsum([0, *sizes])
    assert ends[-1] == len(cloud)
    parts = [cloud.select(np.arange(a, b)) for a, b in itertools.pairwise(ends)]
    return lambda: iter(parts)


def test_a_ply_of_pieces_is_the_ply_of_the_whole(tmp_path):
    cloud = random_cloud(100)
    assert write_ply_pieces(tmp_path / "a.ply", pieces_of(cloud, 30, 0, 70)) == 100
    write_ply(tmp_path / "b.ply", cloud)
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()
    assert len(read_ply(tmp_path / "a.ply")) == 100


def test_lossless_pieces_decode_bit_for_bit(tmp_path):
    cloud = random_cloud(100)
    write_lossless_pieces(tmp_path / "a", pieces_of(cloud, 1, 59, 0, 40))
    back = codec.decode((tmp_path / "a").read_bytes())
    for ours, theirs in zip(cloud.arrays(), back.arrays(), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_compact_pieces_decode_as_the_whole_does(tmp_path):
    cloud = random_cloud(100)
    write_compact_pieces(tmp_path / "a", pieces_of(cloud, 25, 0, 75))
    back = codec.decode((tmp_path / "a").read_bytes())
    whole = codec.decode(codec.encode_compact(cloud))
    for ours, theirs in zip(_sorted(whole), _sorted(back), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    write_compact_pieces(tmp_path / "b", pieces_of(cloud, 100))
    assert (tmp_path / "b").read_bytes()[:12] == codec.encode_compact(cloud)[:12]
    assert codec.decode((tmp_path / "b").read_bytes()).means.tobytes() == whole.means.tobytes()


def _sorted(cloud: GaussianCloud):
    return cloud.select(np.lexsort(cloud.means.T)).arrays()


@pytest.mark.parametrize("write", [write_lossless_pieces, write_compact_pieces])
def test_a_map_of_nothing_is_a_map(tmp_path, write):
    write(tmp_path / "a", lambda: iter([GaussianCloud.empty()]))
    assert len(codec.decode((tmp_path / "a").read_bytes())) == 0
