"""What check-data says about good and spoiled recordings."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

from magic_core.data import check_dataset, write_replica
from tests.core.small_flat import SHARED_DATA, small_flat

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    return write_replica(small_flat()[:1], tmp_path_factory.mktemp("data") / "flat")


@pytest.fixture
def recording(good, tmp_path):
    """A copy of a good recording, alone in nested folders, to be spoiled."""
    folder = tmp_path / "a" / "b" / "scene"
    shutil.copytree(good / "agent_0", folder)
    return folder


def findings(path, status):
    return {f.name: f for f in check_dataset(path).findings if f.status == status}


def set_camera(folder, **change):
    content = json.loads((folder / "cam_params.json").read_text())
    content["camera"].update(change)
    (folder / "cam_params.json").write_text(json.dumps(content))


def convert_poses(folder, convert):
    poses = np.loadtxt(folder / "traj.txt").reshape(-1, 4, 4)
    np.savetxt(folder / "traj.txt", np.array([convert(pose) for pose in poses]).reshape(-1, 16))


def test_a_good_recording_passes_every_check(good):
    report = check_dataset(good)
    assert report.ok
    assert [f for f in report.findings if f.status != "ok"] == []
    assert {"layout", "files", "intrinsics", "timestamps", "colour", "depth", "motion",
            "pose convention"} <= {f.name for f in report.findings}  # fmt: skip


@pytest.mark.parametrize("scale", [5000, 100, 1, 6553.5])
def test_a_wrong_depth_scale_is_loud_and_the_right_one_named(recording, scale):
    set_camera(recording, scale=scale)
    report = check_dataset(recording)
    assert not report.ok
    loud = [f for f in report.findings if "WRONG DEPTH SCALE" in f.remedy]
    assert loud
    assert any("1000" in f.remedy for f in loud)


def test_a_wrong_depth_scale_is_suspected_without_poses(recording):
    (recording / "traj.txt").unlink()
    set_camera(recording, scale=5000)
    found = findings(recording, "warn") | findings(recording, "fail")
    assert "1000" in found["depth"].remedy


@pytest.mark.parametrize(
    ("convert", "named"),
    [
        (np.linalg.inv, "camera_from_world, OpenCV axes"),
        (lambda pose: pose @ np.diag([1, -1, -1, 1]), "world_from_camera, OpenGL axes"),
        (
            lambda pose: np.linalg.inv(pose @ np.diag([1, -1, -1, 1])),
            "camera_from_world, OpenGL axes",
        ),
    ],
)
def test_poses_in_another_convention_are_recognised(recording, convert, named):
    convert_poses(recording, convert)
    failed = findings(recording, "fail")["pose convention"]
    assert f"they are {named}" in failed.remedy


def test_poses_of_other_frames_do_not_pass(recording):
    rng = np.random.default_rng(0)
    poses = np.loadtxt(recording / "traj.txt")
    np.savetxt(recording / "traj.txt", poses[rng.permutation(len(poses))])
    assert "pose convention" in findings(recording, "warn") | findings(recording, "fail")


def test_poses_that_are_no_rotations_fail(recording):
    convert_poses(recording, lambda pose: pose * 1.3)
    assert "rigid" in findings(recording, "fail")["ground truth"].remedy


def test_missing_and_empty_files_are_counted_and_named(recording):
    (recording / "results" / "frame000003.jpg").write_bytes(b"")
    failed = findings(recording, "fail")["files"]
    assert "frame000003.jpg" in failed.detail
    (recording / "results" / "depth000005.png").unlink()
    assert "depth000005.png" in findings(recording, "fail")["opening"].detail


def test_missing_intrinsics_are_named_with_an_example(recording):
    (recording / "cam_params.json").unlink()
    failed = findings(recording, "fail")["opening"]
    assert "cam_params.json" in failed.detail
    assert '"fx"' in failed.remedy


def test_implausible_intrinsics_are_doubted(recording):
    set_camera(recording, fx=900.0, cx=3.0)
    found = findings(recording, "warn")["intrinsics"]
    assert "field of view" in found.detail
    assert "principal point" in found.detail


def test_intrinsics_of_another_image_size_fail(recording):
    set_camera(recording, w=192, h=144)
    assert "96x72" in findings(recording, "fail")["images"].detail


def test_a_folder_of_something_else_fails(tmp_path):
    report = check_dataset(tmp_path)
    assert not report.ok
    assert report.findings[0].name == "layout"


def test_an_absent_ground_truth_is_no_fault(recording):
    (recording / "traj.txt").unlink()
    report = check_dataset(recording)
    assert report.ok
    assert any("none" in f.detail for f in report.findings if f.name == "ground truth")


def test_a_live_camera_is_told_what_can_be_checked():
    (failed,) = check_dataset("realsense:").findings
    assert "live camera" in failed.detail
    assert "magic agent" in failed.remedy


def test_a_wrong_depth_scale_is_suspected_where_the_camera_only_turned(tmp_path):
    """Poses of a turning camera fit any depth unit; but nothing nearer than 3 m is unusual."""
    original = SHARED_DATA / "tum_fr1_rpy_excerpt"
    if not original.is_dir():
        pytest.skip(f"{original} is not there")
    folder = shutil.copytree(original, tmp_path / "freiburg1_rpy")
    right = findings(folder, "ok")
    assert "too little to tell the depth unit" in right["pose convention"].detail
    camera = {"w": 640, "h": 480, "fx": 517.3, "fy": 516.5, "cx": 318.6, "cy": 255.3, "scale": 1000}
    (folder / "cam_params.json").write_text(json.dumps({"camera": camera}))
    suspected = findings(folder, "warn")["depth"]
    assert "WRONG DEPTH SCALE?" in suspected.remedy
    assert "5000 (1.16 m)" in suspected.remedy


@pytest.mark.parametrize(
    "name",
    ["tum_fr1_rpy_excerpt", *(pytest.param(n, marks=pytest.mark.slow)
                              for n in ("redkitchen", "living_room_3agents"))],
)  # fmt: skip
def test_real_recordings_pass(name):
    if not (SHARED_DATA / name).is_dir():
        pytest.skip(f"{SHARED_DATA / name} is not there")
    report = check_dataset(SHARED_DATA / name)
    assert [f for f in report.findings if f.status != "ok"] == []
