"""Every export, opened again by a library that had no part in writing it."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData

from magic_cli.collect import write_ground_truth
from magic_cli.main import run_command
from magic_core.errors import InvalidInput
from magic_core.geometry.axes import axes_from_ours
from magic_core.render import Rasteriser
from magic_server.posegraph.g2o import write_g2o
from tests.core.small_flat import small_flat, small_frames
from tests.core.test_evaluation_run import make_run

AXES = ("rdf", "flu", "ruf")  # ours, ROS's, and Unity's, which are left-handed


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = make_run(tmp_path_factory.mktemp("export") / "flat")
    write_ground_truth(folder, list(small_flat()[:2]))
    poses = folder.read_trajectory("agent_0", "corrected").world_from_camera[::6]
    motion = np.linalg.inv(poses[0]) @ poses[1]
    weights = np.diag([100.0, 200.0, 300.0, 400.0, 500.0, 600.0])
    write_g2o(folder.posegraph_path, dict(enumerate(poses)), [(0, 1, motion, weights)])
    return folder


def export(run, out: Path, *options: str) -> Path:
    assert run_command(["export", str(run.path), "--out", str(out), *options]) == 0
    return out


def test_axes_are_signed_permutations_of_ours():
    ours = np.array([1.0, 2.0, 3.0])  # right, down, forward
    assert (axes_from_ours("rdf") @ ours == [1, 2, 3]).all()
    assert (axes_from_ours("flu") @ ours == [3, -1, -2]).all()
    assert (axes_from_ours("ruf") @ ours == [1, -2, 3]).all()
    assert np.linalg.det(axes_from_ours("rub")) == 1.0
    assert np.linalg.det(axes_from_ours("ruf")) == -1.0
    for wrong in ("", "rd", "rdx", "rlf", "rdfu"):
        with pytest.raises(InvalidInput, match="axes"):
            axes_from_ours(wrong)


@pytest.mark.parametrize("axes", AXES)
def test_map_in_other_axes_is_the_map_seen_by_a_camera_in_other_axes(run, tmp_path, axes):
    path = export(run, tmp_path / "map.ply", "--axes", axes)
    vertices = PlyData.read(str(path))["vertex"]
    positions = np.stack([vertices[name] for name in "xyz"], axis=1)
    matrix, cloud = axes_from_ours(axes), run.read_map()
    np.testing.assert_allclose(positions, cloud.means @ matrix.T, atol=1e-5)
    back = run.read_map().reoriented(matrix).reoriented(matrix.T)
    pose = run.read_trajectory("agent_0", "corrected").world_from_camera[4]
    camera = small_flat()[0].camera
    first, again = (Rasteriser(1).render(c, camera, pose).image for c in (cloud, back))
    np.testing.assert_allclose(again, first, atol=2e-3)
    turned = cloud.reoriented(matrix)
    assert _covariance(turned) == pytest.approx(matrix @ _covariance(cloud) @ matrix.T, abs=1e-6)


def _covariance(cloud) -> np.ndarray:
    """Of the tenth Gaussian, made elongated so that its turning shows."""
    from scipy.spatial.transform import Rotation

    rotation = Rotation.from_quat(cloud.quaternions[10], scalar_first=True).as_matrix()
    return rotation @ np.diag([0.01, 0.04, 0.09]) @ rotation.T


@pytest.mark.parametrize("kind", ["ply", "glb"])
def test_mesh_is_read_by_trimesh_and_open3d_and_lies_on_the_surface(run, tmp_path, kind):
    import open3d as o3d
    import trimesh

    path = export(
        run, tmp_path / f"mesh.{kind}", "--what", "mesh", "--axes", "rub",
        "--mesh.voxel-m", "0.05", "--mesh.truncation-m", "0.2", "--mesh.views", "12",
    )  # fmt: skip
    mesh = trimesh.load_mesh(path) if kind == "ply" else trimesh.load(path).to_mesh()
    theirs = o3d.io.read_triangle_mesh(str(path))
    assert len(theirs.triangles) == len(mesh.faces) > 500
    assert theirs.has_vertex_colors()
    assert np.asarray(theirs.vertex_colors).std() > 0.02
    pose = run.read_trajectory("agent_0", "corrected").world_from_camera[4]
    camera, frame = small_flat()[0].camera, small_frames(0)[4]
    ours = np.asarray(mesh.vertices) @ axes_from_ours("rub")  # the transpose undoes it
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(ours.astype(np.float32), np.asarray(mesh.faces, np.uint32))
    rays = camera.rays().reshape(-1, 3).astype(np.float64) @ pose[:3, :3].T
    both = np.concatenate([np.broadcast_to(pose[:3, 3], rays.shape), rays], axis=1)
    hit = scene.cast_rays(o3d.core.Tensor(both.astype(np.float32)))
    depth = hit["t_hit"].numpy().reshape(frame.depth.shape)
    seen = np.isfinite(depth) & (frame.depth > 0)
    assert seen.mean() > 0.3
    assert np.median(np.abs(depth - frame.depth)[seen]) < 0.05
    # Outside is where the cameras are: triangles face the viewer.
    facing = (hit["primitive_normals"].numpy().reshape(-1, 3) * rays).sum(axis=1)
    assert (facing[seen.reshape(-1)] < 0).mean() > 0.9


def test_points_are_read_by_trimesh(run, tmp_path):
    import trimesh

    path = export(run, tmp_path / "points.ply", "--what", "points", "--axes", "flu")
    cloud, points = run.read_map(), trimesh.load(path)
    solid = cloud.opacities >= 0.5
    assert len(points.vertices) == solid.sum()
    expected = cloud.means[solid] @ axes_from_ours("flu").T
    np.testing.assert_allclose(points.vertices, expected, atol=1e-5)
    np.testing.assert_allclose(
        np.asarray(points.colors)[:, :3] / 255.0, cloud.colours[solid].clip(0, 1), atol=0.003
    )


@pytest.mark.parametrize("kind", ["compressed-ply", "spz"])
def test_compressed_splats_keep_the_gaussians(run, tmp_path, kind):
    gsply = pytest.importorskip("gsply")
    path = tmp_path / ("map.spz" if kind == "spz" else "map.compressed.ply")
    export(run, path, "--format", kind)
    plain = export(run, tmp_path / "map.ply")
    assert path.stat().st_size < 0.35 * plain.stat().st_size
    axes = axes_from_ours("rub" if kind == "spz" else "rdf")
    expected = run.read_map().means @ axes.T
    if kind == "spz":
        means = gsply.read_spz(path).means
    else:
        means = _unpacked_positions(PlyData.read(str(path)))
    assert len(means) == len(expected)
    distance = np.abs(np.sort(means, axis=0) - np.sort(expected, axis=0)).max()
    assert distance < 0.01


def _unpacked_positions(data: PlyData) -> np.ndarray:
    """SuperSplat's layout: 11, 10 and 11 bits within the bounds of each chunk of 256."""
    chunks, packed = data["chunk"].data, data["vertex"]["packed_position"].astype(np.uint32)
    chunk = chunks[np.arange(len(packed)) // 256]
    parts = (((packed >> 21) & 2047) / 2047, ((packed >> 11) & 1023) / 1023, (packed & 2047) / 2047)
    return np.stack(
        [
            chunk[f"min_{name}"] + part * (chunk[f"max_{name}"] - chunk[f"min_{name}"])
            for name, part in zip("xyz", parts, strict=True)
        ],
        axis=1,
    )


@pytest.mark.parametrize("axes", AXES)
def test_pose_graph_is_read_by_gtsam_and_fits_as_well_as_before(run, tmp_path, axes):
    import gtsam

    path = export(run, tmp_path / "graph.g2o", "--what", "posegraph", "--axes", axes)
    graph, values = gtsam.readG2o(str(path), True)
    assert graph.size() == 1
    assert graph.error(values) == pytest.approx(0.0, abs=1e-12)
    # Pushed aside, the edge weighs as much as in our axes.
    before, start = gtsam.readG2o(str(run.posegraph_path), True)
    push = np.array([0.01, -0.02, 0.03, 0.1, 0.2, -0.3])  # gtsam: rotation, translation
    matrix = axes_from_ours(axes)
    theirs = np.concatenate([np.linalg.det(matrix) * matrix @ push[:3], matrix @ push[3:]])
    start.update(1, start.atPose3(1).retract(push))
    values.update(1, values.atPose3(1).retract(theirs))
    assert graph.error(values) == pytest.approx(before.error(start), rel=1e-6)


@pytest.mark.parametrize("kind", ["tum", "kitti"])
def test_trajectories_have_the_layouts_of_their_formats(run, tmp_path, kind):
    out = export(run, tmp_path / kind, "--what", "trajectories", "--format", kind, "--axes", "flu")
    rows = np.loadtxt(out / "agent_0.txt")
    trajectory = run.read_trajectory("agent_0", "corrected")
    assert rows.shape == (len(trajectory), 8 if kind == "tum" else 12)
    matrix = axes_from_ours("flu")
    positions = rows[:, 1:4] if kind == "tum" else rows[:, [3, 7, 11]]
    np.testing.assert_allclose(positions, trajectory.positions @ matrix.T, atol=1e-6)


def test_evo_reads_the_trajectories(run, tmp_path):
    beside = str(Path(sys.executable).parent)
    evo = shutil.which("evo_ape", path=beside) or shutil.which("evo_ape")
    if evo is None:
        pytest.skip("evo is not installed; it is run as a program of its own, never imported")
    for kind, folder in (("corrected", "ours"), ("ground_truth", "truth")):
        options = ("--what", "trajectories", "--kind", kind, "--format", "tum")
        export(run, tmp_path / folder, *options)
    arguments = [evo, "tum", "truth/agent_0.txt", "ours/agent_0.txt", "--align", "--no_warnings"]
    done = subprocess.run(
        arguments, cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    rmse = next(line.split()[1] for line in done.stdout.splitlines() if "rmse" in line)
    assert float(rmse) < 1e-5


def test_what_cannot_be_written_is_refused_with_the_choices(run, tmp_path, capsys):
    out = str(tmp_path / "x")
    assert run_command(["export", str(run.path), "--out", out, "--format", "kitti"]) == 2
    assert "ply, compressed-ply, spz" in capsys.readouterr().err
    assert run_command(["export", str(run.path), "--out", out, "--axes", "xyz"]) == 1
    assert "rdf" in capsys.readouterr().err
    assert run_command(["export", str(tmp_path / "none"), "--out", out]) == 1
    assert "map.ply" in capsys.readouterr().err
    assert not Path(out).exists()


def test_json_says_what_was_written(run, tmp_path, capsys):
    export(run, tmp_path / "m.mgsc", "--format", "compact", "--json")
    said = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert said["format"] == "compact"
    assert said["axes"] == "rdf"
    from magic_core.gaussians import codec

    assert len(codec.decode((tmp_path / "m.mgsc").read_bytes())) == len(run.read_map())


def test_a_part_of_the_map_in_fewer_gaussians(run, tmp_path, capsys):
    whole = run.read_map()
    middle = np.median(whole.means, axis=0)
    low, high = (middle - 1.0).tolist(), (middle + 1.0).tolist()
    inside = ((whole.means >= low) & (whole.means < high)).all(axis=1)
    box = [str(value) for value in (*low, *high)]
    path = export(run, tmp_path / "part.ply", "--region", *box)
    assert len(PlyData.read(str(path))["vertex"]) == inside.sum() > 10
    path = export(
        run, tmp_path / "fewer.ply", "--axes", "rub", "--region", *box, "--max-gaussians", "10"
    )
    vertices = PlyData.read(str(path))["vertex"]
    ours = np.stack([vertices[name] for name in "xyz"], axis=1) @ axes_from_ours("rub")
    assert len(ours) == 10
    assert ((ours >= np.array(low) - 1e-5) & (ours < np.array(high) + 1e-5)).all()
    for wrong, words in (
        (["--region", *box[3:], *box[:3]], "lowest"),
        (["--region", *["1e6"] * 3, *["2e6"] * 3], "no Gaussian"),
        (["--max-gaussians", "-1"], "0 or more"),
        (["--what", "mesh", "--max-gaussians", "5"], "map and points"),
    ):
        assert run_command(["export", str(run.path), "--out", str(tmp_path / "x.ply"), *wrong])
        assert words in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "x.ply").exists()
