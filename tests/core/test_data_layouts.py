"""ScanNet, ScanNet++, Record3D, Aria and plain folders, read from files in those very layouts."""

from __future__ import annotations

import json
import re
import shutil
import zipfile

import numpy as np
import pytest

from magic_core.data import check_dataset, open_dataset, write_replica
from magic_core.data.discovery import LAYOUTS, layout_of
from magic_core.errors import DataError
from tests.core.layout_writers import (
    write_plain,
    write_record3d,
    write_scannet,
    write_scannetpp,
)
from tests.core.small_flat import small_flat, small_frames

FRAMES = list(small_frames(0))[::2]  # 12 frames, far enough apart for the check of the poses
CAMERA = small_flat()[0].camera


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    folder = tmp_path_factory.mktemp("layouts")
    return {
        "ScanNet": write_scannet(folder / "scene0000_00", FRAMES, CAMERA),
        "ScanNet++ iPhone": write_scannetpp(folder / "0a5c013435", FRAMES, CAMERA),
        "Record3D": write_record3d(folder / "kitchen.r3d", FRAMES, CAMERA),
        "plain folder": write_plain(folder / "mine", FRAMES, CAMERA),
    }


NAMES = ["ScanNet", "ScanNet++ iPhone", "Record3D", "plain folder"]


@pytest.mark.parametrize("layout", NAMES)
def test_the_layout_is_recognised_and_its_frames_come_back(stored, layout):
    path = stored[layout]
    assert layout_of(path).name == layout
    (source,) = open_dataset(path)
    assert (source.name, len(source)) == ("agent_0", len(FRAMES))
    times = 1 if source.camera.width == CAMERA.width else 2
    assert source.camera.width == times * CAMERA.width
    assert source.camera.fx == pytest.approx(times * CAMERA.fx)
    frame, truth = source[3], FRAMES[3]
    # measured: 1e-6 m where nothing is resampled; half-millimetre units elsewhere
    np.testing.assert_allclose(frame.world_from_camera, truth.world_from_camera, atol=2e-6)
    (half,) = open_dataset(path, scale=1 / times)
    assert (half.camera.width, half.camera.height) == (CAMERA.width, CAMERA.height)
    same = half[3].depth[:, 5:]  # the first columns of Record3D's are of low confidence
    assert np.median(np.abs(same - truth.depth[:, 5:])) < 1e-3
    difference = half[3].colour.astype(float) - truth.colour
    assert np.abs(difference).mean() < 4  # JPEG at 2x, averaged back


@pytest.mark.parametrize("layout", NAMES)
def test_depth_poses_and_intrinsics_fit_each_other_as_delivered(stored, layout):
    report = check_dataset(stored[layout])
    assert [f for f in report.findings if f.status != "ok"] == []
    convention = next(f for f in report.findings if f.name == "pose convention")
    assert "world_from_camera, OpenCV axes" in convention.detail


def test_every_frame_of_a_phone_is_seen_by_one_camera_though_its_focus_changes(tmp_path):
    """ARKit reports other intrinsics for each frame; the delivered frames share one camera."""

    def breathe(metadata):
        for k, values in enumerate(metadata["perFrameIntrinsicCoeffs"]):
            values[0] *= 1 + 0.02 * (k - 5)
            values[1] *= 1 + 0.02 * (k - 5)

    path = write_record3d(tmp_path / "breathing.r3d", FRAMES, CAMERA, change=breathe)
    (source,) = open_dataset(path)
    assert source.camera.fx == pytest.approx(2 * CAMERA.fx, rel=0.02)
    # The image was taken with the nominal camera, but says 10 % shorter: its content is magnified
    # about the centre, and the edge shows what lay nearer to it.
    first = source[0].depth
    centre = (slice(60, 80), slice(90, 102))
    (nominal,) = open_dataset(write_record3d(tmp_path / "still.r3d", FRAMES, CAMERA))
    assert np.median(np.abs(first[centre] - nominal[0].depth[centre])) < 0.02
    assert (first == 0).mean() != (nominal[0].depth == 0).mean()


def test_lost_poses_of_scannet_are_unknown(stored, tmp_path):
    folder = shutil.copytree(stored["ScanNet"], tmp_path / "scene")
    np.savetxt(folder / "pose" / "2.txt", np.full((4, 4), -np.inf), fmt="%f")
    (folder / "pose" / "5.txt").unlink()
    poses = [pose for _, pose in open_dataset(folder)[0].timed_poses()]
    assert [k for k, pose in enumerate(poses) if pose is None] == [2, 5]


def test_scannet_numbers_are_numbers_and_give_the_times(stored):
    times = [time for time, _ in open_dataset(stored["ScanNet"])[0].timed_poses()]
    np.testing.assert_allclose(times, np.arange(12) / 30)  # 10 after 9, not after 1


def test_low_confidence_and_missing_readings_of_record3d_are_no_readings(stored):
    (source,) = open_dataset(stored["Record3D"], scale=0.5)
    depth = source[0].depth
    assert (depth[:, :3] == 0).all()
    assert np.isfinite(depth).all()
    assert (depth[:, 6:] > 0).mean() > 0.9


def test_an_unzipped_record3d_recording_is_the_same(stored, tmp_path):
    with zipfile.ZipFile(stored["Record3D"]) as archive:
        archive.extractall(tmp_path / "kitchen")
    (zipped,), (unzipped,) = open_dataset(stored["Record3D"]), open_dataset(tmp_path / "kitchen")
    np.testing.assert_array_equal(zipped[2].depth, unzipped[2].depth)
    np.testing.assert_array_equal(zipped[2].colour, unzipped[2].colour)


def test_old_record3d_files_without_depth_size_are_read(tmp_path):
    def forget(metadata):
        del metadata["dw"], metadata["dh"], metadata["perFrameIntrinsicCoeffs"]

    (source,) = open_dataset(write_record3d(tmp_path / "old.r3d", FRAMES, CAMERA, change=forget))
    assert source.camera.fx == pytest.approx(2 * CAMERA.fx)
    assert (source[0].depth > 0).mean() > 0.8


def test_an_aria_export_in_replica_layout_is_read(tmp_path):
    """Square images with one intrinsics file for all agents, depth in 1/6553.5 m."""
    folder = write_replica(small_flat()[:2], tmp_path / "room0", depth_scale=6553.5)
    for agent in ("agent_0", "agent_1"):
        (folder / agent / "cam_params.json").rename(folder / "cam_params.json")
    sources = open_dataset(folder)
    assert [source.name for source in sources] == ["agent_0", "agent_1"]
    truth = small_frames(1)[4]
    assert np.abs(sources[1][4].depth - truth.depth).max() < 1e-4
    assert check_dataset(folder).ok


def test_names_that_are_times_give_the_times(tmp_path):
    names = [f"{1700000000 + 0.1 * k:.6f}" for k in range(12)]
    (source,) = open_dataset(write_plain(tmp_path / "seconds", FRAMES, CAMERA, names=names))
    assert source[1].timestamp_s == pytest.approx(1700000000.1)
    names = [f"{1700000000_000000000 + 50_000_000 * k}" for k in range(12)]
    (source,) = open_dataset(write_plain(tmp_path / "nanoseconds", FRAMES, CAMERA, names=names))
    assert source[2].timestamp_s == pytest.approx(1700000000.1)
    (source,) = open_dataset(write_plain(tmp_path / "numbers", FRAMES, CAMERA))
    assert source[3].timestamp_s == pytest.approx(3 / 15)


def test_images_of_other_names_pair_by_their_number(tmp_path):
    folder = write_plain(tmp_path / "mine", FRAMES, CAMERA)
    for k in range(12):
        (folder / f"rgb/{k}.png").rename(folder / f"rgb/left-{k:04d}.png")
        (folder / f"depth/{k}.png").rename(folder / f"depth/d_{k}.png")
    (folder / "depth/d_7.png").unlink()
    (source,) = open_dataset(folder)
    assert len(source) == 11
    assert source.left_out == 1
    np.testing.assert_allclose(source[7].world_from_camera, FRAMES[8].world_from_camera)


def test_recordings_in_files_are_agents_named_after_them(tmp_path):
    write_record3d(tmp_path / "agent_0.r3d", FRAMES[:3], CAMERA)
    write_record3d(tmp_path / "agent_1.r3d", FRAMES[:3], CAMERA)
    assert [source.name for source in open_dataset(tmp_path)] == ["agent_0", "agent_1"]


def _edit_json(path, change):
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


@pytest.mark.parametrize(
    ("layout", "spoil", "message"),
    [
        ("ScanNet", lambda f: (f / "intrinsic/intrinsic_color.txt").unlink(), "export_intrinsics"),
        ("ScanNet", lambda f: shutil.rmtree(f / "intrinsic"), "export_intrinsics"),
        ("ScanNet", lambda f: shutil.rmtree(f / "depth"), "depth image of the same name"),
        ("ScanNet", lambda f: (f / "pose/3.txt").write_text("1 2 3"), "expected 4x4"),
        ("ScanNet", lambda f: np.savetxt(f / "intrinsic/extrinsic_color.txt", np.eye(4) * 2),
         "not the identity"),
        ("ScanNet++ iPhone", lambda f: shutil.rmtree(f / "iphone/rgb"), "prepare_iphone_data"),
        ("ScanNet++ iPhone", lambda f: _edit_json(
            f / "iphone/pose_intrinsic_imu.json", lambda c: c["frame_000002"].pop("intrinsic")),
         "frame_000002: intrinsic"),
        ("ScanNet++ iPhone", lambda f: _edit_json(
            f / "iphone/pose_intrinsic_imu.json", lambda c: c["frame_000002"].update(timestamp=1)),
         "timestamps must increase"),
        ("plain folder", lambda f: (f / "cam_params.json").unlink(), "cam_params.json"),
        ("plain folder", lambda f: (f / "traj.txt").write_text("1 " * 16), "1 poses for 12"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named_with_its_remedy(stored, tmp_path, layout, spoil, message):
    folder = shutil.copytree(stored[layout], tmp_path / "deep" / "er" / "scene")
    spoil(folder)
    with pytest.raises(DataError, match=re.escape(message)):
        open_dataset(folder)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m.pop("w"), "expected JSON with w, h"),
        (lambda m: m["poses"].__setitem__(4, [1, 2]), "poses[4]"),
        (lambda m: m["frameTimestamps"].__setitem__(4, 0), "timestamps must increase"),
        (lambda m: m.pop("K") and m.pop("perFrameIntrinsicCoeffs"), "no usable intrinsics"),
        (lambda m: m["perFrameIntrinsicCoeffs"][4].__setitem__(0, -3), "focal length"),
    ],
)
def test_bad_record3d_metadata_is_named(tmp_path, change, message):
    path = write_record3d(tmp_path / "bad.r3d", FRAMES, CAMERA, change=change)
    with pytest.raises(DataError, match=re.escape(message)):
        open_dataset(path)


def test_damaged_record3d_files_are_named(tmp_path):
    path = tmp_path / "bad.r3d"
    path.write_bytes(b"not a zip")
    with pytest.raises(DataError, match=r"not readable as an \.r3d file"):
        open_dataset(path)
    write_record3d(path, FRAMES, CAMERA)
    with zipfile.ZipFile(path) as archive:
        archive.extractall(tmp_path / "open")
    (tmp_path / "open/rgbd/5.depth").write_bytes(b"bvx$")
    (source,) = open_dataset(tmp_path / "open")
    with pytest.raises(DataError, match=r"5\.depth"):
        source[5]


def test_the_exr_export_is_told_to_be_exported_otherwise(tmp_path):
    for name in ("rgb", "depth"):
        (tmp_path / name).mkdir()
    (tmp_path / "metadata.json").write_text('{"w": 4, "h": 4}')
    (tmp_path / "depth" / "0.exr").write_bytes(b"")
    with pytest.raises(DataError, match="not EXR"):
        open_dataset(tmp_path)


def test_a_folder_of_something_else_lists_what_was_looked_for(tmp_path):
    (tmp_path / "holiday.mp4").write_bytes(b"")
    with pytest.raises(DataError) as caught:
        open_dataset(tmp_path)
    assert "holiday.mp4" in caught.value.message
    for layout in LAYOUTS:
        assert layout.name in caught.value.message
        assert layout.expected in caught.value.message
