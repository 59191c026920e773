"""The TUM RGB-D layout."""

from __future__ import annotations

import json
import re

import cv2
import numpy as np
import pytest

from magic_core.data import open_dataset
from magic_core.data.association import associate
from magic_core.data.consistency import DOCUMENTED, fits
from magic_core.errors import DataError
from tests.core.small_flat import SHARED_DATA

EXCERPT = SHARED_DATA / "tum_fr1_rpy_excerpt"


def write_tum_recording(folder, *, name="rgbd_dataset_freiburg3_test"):
    """Colour at 30 Hz, depth 8 ms later, ground truth at 100 Hz; depth of frame 2 is lost."""
    folder = folder / name
    (folder / "rgb").mkdir(parents=True)
    (folder / "depth").mkdir()
    rgb, depth, truth = ["# color images"], ["# depth maps"], ["# ground truth"]
    for k in range(5):
        t = 1311868164.25 + k / 30
        cv2.imwrite(str(folder / f"rgb/{k}.png"), np.full((480, 640, 3), (30, 20, 10), np.uint8))
        rgb.append(f"{t:.6f} rgb/{k}.png")
        if k != 2:
            cv2.imwrite(str(folder / f"depth/{k}.png"), np.full((480, 640), 5000 + k, np.uint16))
            depth.append(f"{t + 0.008:.6f} depth/{k}.png")
    for k in range(-5, 12):
        half = np.deg2rad(k) / 2
        truth.append(
            f"{1311868164.25 + k / 100:.4f} {0.01 * k:.4f} 0 1 0 0 {np.sin(half)} {np.cos(half)}"
        )
    for file, lines in (("rgb.txt", rgb), ("depth.txt", depth), ("groundtruth.txt", truth)):
        (folder / file).write_text("\n".join(lines) + "\n")
    return folder


def test_pairs_images_by_nearest_time(tmp_path):
    (source,) = open_dataset(write_tum_recording(tmp_path))
    assert source.name == "agent_0"
    assert len(source) == 4  # frame 2 has no depth
    frames = list(source)
    assert [round((f.timestamp_s - 1311868164.25) * 30) for f in frames] == [0, 1, 3, 4]
    assert frames[2].depth[0, 0] == pytest.approx(5003 / 5000)
    assert frames[0].colour[0, 0].tolist() == [10, 20, 30]  # RGB, not OpenCV's BGR


def test_ground_truth_is_the_nearest_pose_with_w_last(tmp_path):
    frames = list(open_dataset(write_tum_recording(tmp_path))[0])
    pose = frames[1].world_from_camera  # 33 ms: nearest is 30 ms, k = 3
    np.testing.assert_allclose(pose[:3, 3], [0.03, 0, 1], atol=1e-9)
    angle = np.arctan2(pose[1, 0], pose[0, 0])
    assert np.rad2deg(angle) == pytest.approx(3.0)
    assert frames[3].world_from_camera is None  # 133 ms: the last pose is 23 ms away


def test_known_cameras_are_recognised_by_the_folder_name(tmp_path):
    (source,) = open_dataset(write_tum_recording(tmp_path))
    assert (source.camera.fx, source.camera.fy) == (535.4, 539.2)
    (distorted,) = open_dataset(write_tum_recording(tmp_path, name="rgbd_dataset_freiburg1_x"))
    assert distorted.camera.fx != 517.3  # undistorted: the usable field is a little narrower
    assert 500 < distorted.camera.fx < 600


def test_cam_params_override_the_published_calibration(tmp_path):
    folder = write_tum_recording(tmp_path)
    values = {"w": 640, "h": 480, "fx": 600, "fy": 601, "cx": 320, "cy": 240, "scale": 1000}
    (folder / "cam_params.json").write_text(json.dumps({"camera": values}))
    (source,) = open_dataset(folder)
    assert source.camera.fy == 601
    assert source[0].depth[0, 0] == pytest.approx(5.0)
    del values["scale"]
    (folder / "cam_params.json").write_text(json.dumps({"camera": values}))
    assert open_dataset(folder)[0][0].depth[0, 0] == pytest.approx(1.0)  # the layout's 5000


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda f: f.rename(f.with_name("mine")), "cam_params.json"),
        (lambda f: (f / "depth.txt").unlink(), "depth.txt: missing"),
        (lambda f: (f / "depth.txt").write_text("12.5 depth/0.png\n"), "within 20 ms"),
        (lambda f: (f / "rgb.txt").write_text("abc rgb/0.png\n"), "timestamp filename"),
        (lambda f: (f / "groundtruth.txt").write_text("1 2 3\n"), "qx qy qz qw"),
    ],
)
def test_what_is_wrong_is_named(tmp_path, spoil, message):
    folder = write_tum_recording(tmp_path / "data")
    moved = spoil(folder)
    with pytest.raises(DataError, match=re.escape(message)):
        open_dataset(moved if folder.name == "mine" or not folder.exists() else folder)


def test_a_listed_file_that_is_missing_is_named_when_read(tmp_path):
    folder = write_tum_recording(tmp_path)
    (folder / "rgb" / "1.png").unlink()
    (source,) = open_dataset(folder)
    source[0]
    with pytest.raises(DataError, match=r"rgb/1\.png: is missing"):
        source[1]


def test_association_serves_the_closest_pairs_first_and_each_once():
    pairs = associate(np.array([0.0, 1.0, 2.0]), np.array([0.95, 1.01, 5.0]), max_difference_s=0.1)
    assert pairs.tolist() == [[1, 1]]  # 0.95 is also near 1.0, but 1.01 is nearer
    pairs = associate(np.array([1.0, 1.03]), np.array([1.02, 1.1]), max_difference_s=0.1)
    assert pairs.tolist() == [[0, 1], [1, 0]] or pairs.tolist() == [[1, 0]]
    assert len(associate(np.array([]), np.array([1.0]), max_difference_s=1.0)) == 0


@pytest.mark.skipif(not EXCERPT.is_dir(), reason=f"{EXCERPT} is not there")
def test_real_recording_is_consistent_after_undistortion():
    (source,) = open_dataset(EXCERPT)
    assert len(source) == 20
    frames = [source[k] for k in range(0, 20, 5)]
    assert all(frame.world_from_camera is not None for frame in frames)
    assert all(0.6 < (frame.depth > 0).mean() < 1.0 for frame in frames)
    assert min(frame.colour.min(axis=(0, 1)).min() for frame in frames) < 60
    best = next(fit for fit in fits(frames, source.camera) if fit.depth_factor == 1.0)
    assert best.convention == DOCUMENTED
    assert best.error < 0.02  # measured: 0.009
