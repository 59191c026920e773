"""`magic check-data` on good and spoiled recordings, as a person runs it."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest

from magic_cli.main import run_command
from magic_core.data.picture import carried_colour, coloured, depth_edges
from tests.core.layout_writers import write_plain, write_scannet
from tests.core.small_flat import small_flat, small_frames

FRAMES = list(small_frames(0))[::2]
CAMERA = small_flat()[0].camera


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    return write_plain(tmp_path_factory.mktemp("good") / "a" / "b" / "scene", FRAMES, CAMERA)


@pytest.fixture
def recording(good, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return shutil.copytree(good, tmp_path / "a" / "b" / "scene")


def check(capsys, path, *options):
    code = run_command(["check-data", str(path), "--json", *options])
    return code, json.loads(capsys.readouterr().out.strip().splitlines()[-1])


def loud(report):
    return " ".join(f["remedy"] for f in report["findings"] if f["status"] == "fail")


def test_a_good_recording_ends_with_0_and_a_picture(recording, capsys, tmp_path):
    code, report = check(capsys, recording)
    assert (code, report["ok"]) == (0, True)
    assert report["picture"] == "scene-check.png"
    picture = cv2.imread(str(tmp_path / "scene-check.png"))
    assert picture.shape[1] > 1200
    assert picture.std() > 30


def test_a_wrong_depth_scale_is_named_with_the_right_one(recording, capsys):
    path = recording / "cam_params.json"
    path.write_text(path.read_text().replace('"scale": 1000', '"scale": 1000000'))
    code, report = check(capsys, recording, "--no-draw")
    assert code == 1
    assert report["picture"] is None
    assert "WRONG DEPTH SCALE" in loud(report)
    assert "to 1000" in loud(report)
    detail = next(f["detail"] for f in report["findings"] if f["name"] == "depth")
    assert "mm" in detail


def test_swapped_poses_are_named_with_the_conversion(recording, capsys):
    poses = np.loadtxt(recording / "traj.txt").reshape(-1, 4, 4)
    np.savetxt(recording / "traj.txt", np.linalg.inv(poses).reshape(-1, 16))
    code, report = check(capsys, recording, "--picture", "bad.png")
    assert code == 1
    assert "WRONG POSES: they are camera_from_world, OpenCV axes; convert them" in loud(report)
    assert cv2.imread("bad.png") is not None


def test_images_that_were_turned_are_named(recording, capsys):
    turn = np.array([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    poses = np.loadtxt(recording / "traj.txt").reshape(-1, 4, 4)
    np.savetxt(recording / "traj.txt", (poses @ turn.T).reshape(-1, 16))
    _, report = check(capsys, recording, "--no-draw")
    assert "images turned a quarter left" in loud(report)


def test_missing_intrinsics_are_named_with_an_example(recording, capsys):
    (recording / "cam_params.json").unlink()
    code, report = check(capsys, recording)
    assert code == 1
    assert report["picture"] is None  # nothing can be drawn, and that is no crash
    failed = next(f for f in report["findings"] if f["status"] == "fail")
    assert "no cam_params.json" in failed["detail"]
    assert '"fx"' in failed["remedy"]


def test_a_layout_that_fixes_its_unit_is_not_told_to_change_a_setting(tmp_path, capsys):
    folder = write_scannet(tmp_path / "scene", FRAMES, CAMERA)
    for k, frame in enumerate(FRAMES):  # 1/5000 m, as TUM has it, where ScanNet has millimetres
        units = np.rint(frame.depth * 5000).astype(np.uint16)
        cv2.imwrite(str(folder / f"depth/{k}.png"), units)
    _, report = check(capsys, folder, "--no-draw")
    assert "5000 units per metre: export it again" in loud(report)


def test_a_file_cut_short_is_named(recording, capsys):
    path = recording / "rgb" / "4.png"
    path.write_bytes(path.read_bytes()[:300])
    code, report = check(capsys, recording, "--no-draw")
    assert code == 1
    failed = next(f for f in report["findings"] if f["status"] == "fail")
    assert "4.png" in failed["detail"]


def test_damage_inside_a_file_is_found_when_every_frame_is_read(recording, capsys):
    path = recording / "depth" / "5.png"
    data = bytearray(path.read_bytes())
    data[40:-40] = bytes(len(data) - 80)
    path.write_bytes(bytes(data))
    _, report = check(capsys, recording, "--no-draw", "--all")
    assert "5.png" in " ".join(f["detail"] for f in report["findings"] if f["status"] == "fail")


def test_gaps_and_unpaired_images_are_counted(tmp_path, capsys):
    times = [10.0 + k / 30 + (0.6 if k > 6 else 0.0) for k in range(12)]
    folder = write_plain(tmp_path / "scene", FRAMES, CAMERA, names=[f"{t:.6f}" for t in times])
    for name in (f"{times[2]:.6f}", f"{times[9]:.6f}"):
        (folder / "depth" / f"{name}.png").unlink()
    _, report = check(capsys, folder, "--no-draw")
    warned = {f["name"]: f["detail"] for f in report["findings"] if f["status"] == "warn"}
    assert "1 gap(s)" in warned["timestamps"]
    assert "2 colour images have no depth" in warned["files"]


def test_the_picture_is_drawn_where_it_can_be_written_or_not_at_all(recording, capsys, tmp_path):
    (tmp_path / "taken").mkdir()
    code, report = check(capsys, recording, "--picture", str(tmp_path / "taken"))
    assert (code, report["picture"]) == (0, None)


def test_edges_of_depth_are_jumps_and_not_slopes_or_holes():
    depth = np.tile(np.linspace(1.0, 1.5, 40, dtype=np.float32), (30, 1))
    depth[:, 30:] += 1.0
    depth[10:20, 5:10] = 0
    edges = depth_edges(depth)
    assert edges[:, 29].all()
    assert edges.sum() == 30
    assert (coloured(depth, 1, 2.5)[12, 7] == 0).all()


def test_colour_is_carried_by_true_poses_onto_itself():
    a, b = FRAMES[2], FRAMES[3]
    carried, known = carried_colour(b, a, CAMERA)
    right = np.abs(carried.astype(int) - a.colour)[known].mean()
    assert known.mean() > 0.5
    assert right < 12  # measured: 5; occlusions and interpolation
    turned = b.world_from_camera @ np.diag([-1.0, -1.0, 1.0, 1.0])  # an image upside down
    carried, known = carried_colour(replace(b, world_from_camera=turned), a, CAMERA)
    assert np.abs(carried.astype(int) - a.colour)[known].mean() > 2 * right
