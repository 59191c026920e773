"""Fewer Gaussians, the same picture; and maps in columns that are larger than a piece."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest

from magic_core.errors import CorruptData, InvalidInput, NotFound
from magic_core.gaussians import GaussianCloud, codec, reduction, stream
from magic_core.gaussians.columns import ColumnFile
from magic_core.gaussians.reduction import reduced
from magic_core.gaussians.region import Region
from magic_core.render import Rasteriser
from magic_server.globalmap import excerpt
from magic_server.globalmap.excerpt import excerpt_of
from magic_server.store.blobs import LocalFile
from tests.small_world import LARGE, gaussians_of, look, render

POSE = look(0.0, -1.2, 0.2)


@pytest.fixture(scope="module")
def scene() -> GaussianCloud:
    """A view of the room, in the world."""
    return gaussians_of(LARGE, *render(LARGE, POSE)).transformed(POSE)


def psnr(cloud: GaussianCloud, wanted: np.ndarray) -> float:
    shown = np.clip(Rasteriser(1).render(cloud, LARGE, POSE).colour, 0.0, 1.0)
    return float(-10.0 * np.log10(np.mean((shown - wanted) ** 2)))


def strongest(cloud: GaussianCloud, count: int) -> GaussianCloud:
    """Those that show most, as a selection would leave them."""
    areas = np.sort(cloud.scales, axis=1)[:, 1:].prod(axis=1)
    return cloud.select(np.argsort(-cloud.opacities * areas, kind="stable")[:count])


def columns_of(folder: Path, cloud: GaussianCloud) -> ColumnFile:
    columns = ColumnFile(folder / "source", len(cloud))
    columns.put(0, cloud)
    return columns


def whole(columns: ColumnFile) -> GaussianCloud:
    return GaussianCloud.concatenate(list(columns.pieces()))


def same(first: GaussianCloud, second: GaussianCloud) -> bool:
    return all(np.array_equal(a, b) for a, b in zip(first.arrays(), second.arrays(), strict=True))


def test_each_level_has_its_count_and_shows_more_than_the_one_below(scene):
    wanted = Rasteriser(1).render(scene, LARGE, POSE).colour
    found = []
    for share in (2, 4, 8, 16):
        cloud = reduced(scene, len(scene) // share)
        cloud.validate()
        assert len(cloud) == len(scene) // share
        found.append(psnr(cloud, wanted))
        # Measured: 7 dB and more above a selection at every level.
        assert found[-1] > psnr(strongest(scene, len(cloud)), wanted) + 3.0
    assert all(a > b for a, b in itertools.pairwise(found)), found


def test_what_is_not_merged_stays_bit_for_bit(scene):
    cloud = reduced(scene, len(scene) - 10)
    rows = {row.tobytes() for row in np.column_stack(scene.arrays())}
    kept = [row.tobytes() in rows for row in np.column_stack(cloud.arrays())]
    assert sum(kept) == len(scene) - 20
    assert reduced(scene, len(scene)) is scene


def test_a_pair_of_equals_keeps_colour_and_place_and_covers_both():
    pair = GaussianCloud.from_arrays(
        [[0.0, 0.0, 1.0], [0.02, 0.0, 1.0]],
        np.tile([1.0, 0.0, 0.0, 0.0], (2, 1)),
        scales=np.tile([0.01, 0.01, 0.001], (2, 1)),
        opacities=[0.5, 0.5],
        colours=np.tile([0.2, 0.4, 0.6], (2, 1)),
    )
    one = reduced(pair, 1)
    np.testing.assert_allclose(one.means, [[0.01, 0.0, 1.0]], atol=1e-7)
    np.testing.assert_allclose(one.colours, pair.colours[:1], atol=1e-7)
    np.testing.assert_allclose(np.sort(one.scales[0]), [0.001, 0.01, 0.01 * 2**0.5], rtol=1e-5)
    # Opacity times area is that of both.
    np.testing.assert_allclose(one.opacities, [2 * 0.5 / 2**0.5], rtol=1e-5)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_extreme_clouds_become_valid_ones(count):
    rng = np.random.default_rng(0)
    quaternions = rng.normal(size=(60, 4))
    cloud = GaussianCloud.from_arrays(
        np.repeat(rng.choice([-1e6, 0.0, 1e6], (30, 3)), 2, axis=0),
        quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True),
        scales=rng.choice([1e-12, 1e-3, 1e6, 3e38], (60, 3)),
        opacities=rng.choice([0.0, 0.5, 1.0], 60),
        colours=rng.choice([-1.0, 0.0, 2.0], (60, 3)),
    )
    found = reduced(cloud, count)
    found.validate()
    assert len(found) == count


@pytest.mark.parametrize(
    "x",
    [np.zeros(4096), np.arange(4096) * 0.25, 1e-3 * 1.002 ** np.arange(4096)],
    ids=["one place", "a row", "a row that opens"],
)
def test_clouds_without_cheapest_pairs_take_few_rounds(monkeypatch, x):
    cloud = GaussianCloud.from_arrays(
        np.stack([x, np.zeros(4096), np.zeros(4096)], axis=1),
        np.tile([1.0, 0.0, 0.0, 0.0], (4096, 1)),
        scales=np.full((4096, 3), 0.01),
        opacities=np.full(4096, 0.5),
        colours=np.full((4096, 3), 0.5),
    )
    rounds = []
    merged = reduction._with_pairs_merged
    monkeypatch.setattr(
        reduction, "_with_pairs_merged", lambda *given: rounds.append(1) or merged(*given)
    )
    found = reduced(cloud, 512)
    found.validate()
    assert len(found) == 512
    # One for each Gaussian that goes would be 3,584.
    assert len(rounds) < 100


@pytest.mark.parametrize(
    ("low", "high"),
    [
        ((0, 0, 0), (1, 1, 0)),
        ((0, 2, 0), (1, 1, 1)),
        ((0, 0, float("nan")), (1, 1, 1)),
        ((0, 0, 0), (1, float("nan"), 1)),
        ((float("inf"), 0, 0), (float("inf"), 1, 1)),
    ],
)
def test_a_region_that_holds_nothing_is_refused(low, high):
    with pytest.raises(InvalidInput, match=r"region\.low\.[xyz]: .*expected"):
        Region(low, high)


def test_regions_side_by_side_share_nothing_and_leave_nothing_out(scene, tmp_path):
    # A border that runs through Gaussians.
    border = float(np.sort(scene.means[:, 0])[len(scene) // 2])
    inf = float("inf")
    halves = [
        Region((-inf, -inf, -inf), (border, inf, inf)),
        Region((border, -inf, -inf), (inf, inf, inf)),
    ]
    columns = columns_of(tmp_path, scene)
    found = []
    for number, region in enumerate(halves):
        folder = tmp_path / str(number)
        folder.mkdir()
        part = excerpt_of(columns, folder, region=region, max_gaussians=0)
        found.append(whole(part.columns))
        # In the map's order, and bit for bit.
        assert same(found[-1], scene.select(region.holds(scene.means)))
        fewer = excerpt_of(columns, folder, region=region, max_gaussians=100)
        assert (len(fewer.columns), fewer.full_count) == (100, len(found[-1]))
        assert region.holds(whole(fewer.columns).means).all()
    assert sum(map(len, found)) == len(scene)


@pytest.mark.parametrize("count", [1, 7, 500, 3000, 12287])
def test_a_map_of_many_pieces_is_reduced_to_the_count(scene, tmp_path, monkeypatch, count):
    monkeypatch.setattr("magic_core.gaussians.columns.PIECE", 1000)
    monkeypatch.setattr(excerpt, "PIECE", 1000)
    part = excerpt_of(columns_of(tmp_path, scene), tmp_path, region=None, max_gaussians=count)
    cloud = whole(part.columns)
    cloud.validate()
    assert (len(cloud), part.full_count) == (min(count, len(scene)), len(scene))
    if count == 3000:  # nearly as good as in one piece
        wanted = Rasteriser(1).render(scene, LARGE, POSE).colour
        assert psnr(cloud, wanted) > psnr(reduced(scene, count), wanted) - 1.0


def test_a_lossless_file_is_unpacked_whatever_its_pieces(scene, tmp_path):
    data = codec.encode_lossless(scene)
    for size in (5, 1000, len(data)):
        pieces = [data[i : i + size] for i in range(0, len(data), size)]
        columns = ColumnFile.unpacked(tmp_path / f"columns-{size}", pieces)
        assert same(whole(columns), scene)
    path = tmp_path / "again"
    stream.write_lossless_pieces(path, columns.pieces)
    assert same(codec.decode(path.read_bytes()), scene)
    empty = ColumnFile.unpacked(tmp_path / "none", [codec.encode_lossless(GaussianCloud.empty())])
    assert len(whole(empty)) == 0


def test_what_is_no_lossless_file_is_refused(scene, tmp_path):
    data = codec.encode_lossless(scene)
    damaged = [
        [],
        [b"MGS"],
        [data[:-5]],
        [data[:40], b"\0" * 40],
        [codec.encode_compact(scene)],
        [b"nonsense" * 20],
    ]
    for number, pieces in enumerate(damaged):
        with pytest.raises(CorruptData):
            ColumnFile.unpacked(tmp_path / str(number), pieces)


def test_a_stored_file_that_was_changed_or_deleted_says_so(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(b"changed")
    with pytest.raises(CorruptData, match="damaged"):
        list(LocalFile(path, "0" * 64).pieces())
    with pytest.raises(NotFound, match="deleted"):
        list(LocalFile(tmp_path / "none", "0" * 64).pieces())
