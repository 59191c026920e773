"""3DGS PLY files: what viewers expect, and the way back."""

from __future__ import annotations

import numpy as np
import plyfile
import pytest

from magic_core.errors import CorruptData
from magic_core.gaussians import GaussianCloud
from magic_core.gaussians.ply import SH_DEGREE_0, read_ply, write_ply
from tests.core.test_gaussian_cloud import random_cloud


def test_reading_gives_back_what_was_written(tmp_path):
    cloud = random_cloud(200)
    back = read_ply(write_ply(tmp_path / "map.ply", cloud))
    for name, ours, theirs in zip(
        ("means", "quaternions", "scales", "opacities", "colours"), cloud.arrays(), back.arrays(),
        strict=True,
    ):  # fmt: skip
        np.testing.assert_allclose(theirs, ours, atol=3e-7, rtol=3e-6, err_msg=name)
    back.validate()


def test_file_has_the_layout_that_splat_viewers_read(tmp_path):
    cloud = random_cloud(3)
    data = plyfile.PlyData.read(str(write_ply(tmp_path / "map.ply", cloud)))
    assert data.byte_order == "<"
    assert not data.text
    vertex = data["vertex"]
    assert [p.name for p in vertex.properties] == [
        "x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity",
        "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3",
    ]  # fmt: skip
    assert {p.val_dtype for p in vertex.properties} == {"f4"}
    o = cloud.opacities[1]
    assert vertex["opacity"][1] == pytest.approx(np.log(o / (1 - o)), rel=1e-5)
    assert vertex["scale_2"][1] == pytest.approx(np.log(cloud.scales[1, 2]), rel=1e-6)
    assert vertex["rot_0"][1] == pytest.approx(cloud.quaternions[1, 0])  # w comes first
    shown = 0.5 + SH_DEGREE_0 * np.array([vertex[f"f_dc_{c}"][1] for c in range(3)])
    np.testing.assert_allclose(shown, cloud.colours[1], atol=1e-6)
    assert pytest.approx(0.28209479177387814) == SH_DEGREE_0


def test_extreme_opacities_stay_finite(tmp_path):
    a = random_cloud(2)
    cloud = GaussianCloud(a.means, a.quaternions, a.scales, np.array([0, 1], np.float32), a.colours)
    back = read_ply(write_ply(tmp_path / "map.ply", cloud))
    np.testing.assert_allclose(back.opacities, [0, 1], atol=2e-6)


def test_higher_harmonics_of_other_writers_are_dropped(tmp_path):
    path = write_ply(tmp_path / "map.ply", random_cloud(4))
    old = plyfile.PlyData.read(str(path))["vertex"].data
    wider = np.zeros(4, dtype=[*old.dtype.descr, ("f_rest_0", "<f4")])
    for name in old.dtype.names:
        wider[name] = old[name]
    for name in ("rot_0", "rot_1", "rot_2", "rot_3"):
        wider[name] *= 3.0  # other writers store unnormalised quaternions
    element = plyfile.PlyElement.describe(wider, "vertex")
    plyfile.PlyData([element], text=True).write(str(tmp_path / "other.ply"))
    np.testing.assert_allclose(
        read_ply(tmp_path / "other.ply").quaternions, read_ply(path).quaternions, atol=1e-5
    )


def test_an_empty_map_is_a_valid_file(tmp_path):
    assert len(read_ply(write_ply(tmp_path / "map.ply", GaussianCloud.empty()))) == 0


@pytest.mark.parametrize("content", [b"", b"no ply at all", b"ply\nformat ascii 1.0\nend_header\n"])
def test_other_files_are_refused(tmp_path, content):
    (tmp_path / "bad.ply").write_bytes(content)
    with pytest.raises(CorruptData, match=r"bad\.ply"):
        read_ply(tmp_path / "bad.ply")


def test_a_truncated_file_is_refused(tmp_path):
    path = write_ply(tmp_path / "map.ply", random_cloud(50))
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(CorruptData):
        read_ply(path)


def test_a_mesh_is_refused_by_what_it_lacks(tmp_path):
    vertices = np.zeros(2, dtype=[("x", "f4"), ("y", "f4"), ("z", "f4")])
    plyfile.PlyData([plyfile.PlyElement.describe(vertices, "vertex")]).write(
        str(tmp_path / "mesh.ply")
    )
    with pytest.raises(CorruptData, match="opacity"):
        read_ply(tmp_path / "mesh.ply")


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = write_ply(tmp_path / "map.ply", random_cloud(5))
    before = path.read_bytes()
    a = random_cloud(5)
    broken = GaussianCloud(a.means[:3], a.quaternions, a.scales, a.opacities, a.colours)
    with pytest.raises((ValueError, IndexError)):
        write_ply(path, broken)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]
