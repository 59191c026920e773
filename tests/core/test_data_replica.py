"""The Replica layout, folder discovery, and writing recordings."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

from magic_core.data import Frame, open_dataset, write_replica
from magic_core.errors import DataError
from tests.core.small_flat import small_flat, small_frames, write_gray_replica


def test_reads_images_poses_and_units(tmp_path):
    (source,) = open_dataset(write_gray_replica(tmp_path / "scene"))
    assert source.name == "agent_0"
    assert len(source) == 4
    frames = list(source)
    assert [frame.index for frame in frames] == [0, 1, 2, 3]
    assert frames[2].timestamp_s == pytest.approx(2 / 30)
    assert frames[2].depth[0, 0] == pytest.approx(2.002)
    assert frames[2].depth.dtype == np.float32
    assert abs(int(frames[2].colour[0, 0, 0]) - 20) <= 1
    np.testing.assert_allclose(frames[2].world_from_camera[:3, 3], [0.2, 0, 0])


def test_one_source_per_agent_folder_in_order(tmp_path):
    for name in ("agent_1", "agent_0", "agent_10", "other"):
        write_gray_replica(tmp_path / name)
    assert [s.name for s in open_dataset(tmp_path)] == ["agent_0", "agent_1", "agent_10"]
    assert [s.name for s in open_dataset(tmp_path / "agent_1")] == ["agent_1"]


def test_folders_of_any_name_are_agents_where_none_is_called_agent(tmp_path):
    for name in ("kitchen", "hall"):
        write_gray_replica(tmp_path / name)
    assert [s.name for s in open_dataset(tmp_path)] == ["hall", "kitchen"]


def test_intrinsics_may_lie_above_the_agents(tmp_path):
    write_gray_replica(tmp_path / "agent_0")
    (tmp_path / "agent_0" / "cam_params.json").rename(tmp_path / "cam_params.json")
    assert open_dataset(tmp_path)[0].camera.fx == 14


def test_stride_and_max_frames_choose_frames(tmp_path):
    folder = write_gray_replica(tmp_path / "scene", frames=7)
    (source,) = open_dataset(folder, stride=3, max_frames=2)
    assert [frame.index for frame in source] == [0, 1]
    assert source[1].timestamp_s == pytest.approx(3 / 30)
    np.testing.assert_allclose(source[1].world_from_camera[0, 3], 0.3)
    with pytest.raises(DataError, match="stride"):
        open_dataset(folder, stride=0)
    with pytest.raises(DataError, match="max_frames"):
        open_dataset(folder, max_frames=0)


def test_indexing_past_the_end_is_an_index_error(tmp_path):
    (source,) = open_dataset(write_gray_replica(tmp_path / "scene"))
    assert source[-1].index == 3
    with pytest.raises(IndexError):
        source[4]


def test_scale_resizes_images_and_camera_together(tmp_path):
    (source,) = open_dataset(write_gray_replica(tmp_path / "scene"), scale=0.5)
    frame = source[0]
    assert frame.colour.shape == (6, 8, 3)
    assert frame.depth.shape == (6, 8)
    assert (source.camera.width, source.camera.height, source.camera.fx) == (8, 6, 7)


def test_an_excerpt_finds_its_poses_by_frame_number(tmp_path):
    folder = write_gray_replica(tmp_path / "scene", frames=3, first=5)
    poses = np.tile(np.eye(4), (9, 1, 1))
    poses[:, 0, 3] = np.arange(9)
    np.savetxt(folder / "traj.txt", poses.reshape(-1, 16))
    assert [f.world_from_camera[0, 3] for f in open_dataset(folder)[0]] == [5, 6, 7]


def test_unknown_poses_are_none(tmp_path):
    folder = write_gray_replica(tmp_path / "scene", frames=2)
    lines = (folder / "traj.txt").read_text().splitlines()
    (folder / "traj.txt").write_text("\n".join([lines[0], " ".join(["nan"] * 16)]))
    source = open_dataset(folder)[0]
    assert source[0].world_from_camera is not None
    assert source[1].world_from_camera is None
    (folder / "traj.txt").unlink()
    assert open_dataset(folder)[0][0].world_from_camera is None


def _without_camera(folder):
    (folder / "cam_params.json").unlink()


def _without_one_depth(folder):
    (folder / "results" / "depth000002.png").unlink()


def _with_few_poses(folder):
    (folder / "traj.txt").write_text(" ".join(["1"] * 16) + "\n")


def _with_short_pose_lines(folder):
    (folder / "traj.txt").write_text("1 2 3\n" * 4)


def _with_key_missing(folder):
    (folder / "cam_params.json").write_text('{"camera": {"w": 16, "h": 12, "fx": 14, "fy": 14}}')


def _with_zero_focal_length(folder):
    values = json.loads((folder / "cam_params.json").read_text())
    values["camera"]["fx"] = 0
    (folder / "cam_params.json").write_text(json.dumps(values))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (_without_camera, "cam_params.json"),
        (_without_one_depth, "depth000002.png"),
        (_with_few_poses, "1 poses for 4 frames"),
        (_with_short_pose_lines, "expected 16"),
        (_with_key_missing, "cx, cy, scale"),
        (_with_zero_focal_length, "focal length"),
    ],
)
def test_what_is_wrong_is_named(tmp_path, spoil, message):
    # Two levels below tmp_path, so that no stray file above is taken for the intrinsics.
    folder = write_gray_replica(tmp_path / "a" / "b" / "scene")
    spoil(folder)
    with pytest.raises(DataError, match=re.escape(message)):
        open_dataset(folder)


def test_images_of_another_size_than_the_intrinsics_are_refused(tmp_path):
    folder = write_gray_replica(tmp_path / "scene")
    text = (folder / "cam_params.json").read_text()
    (folder / "cam_params.json").write_text(text.replace('"w": 16', '"w": 20'))
    with pytest.raises(DataError, match="16x12 pixels, but the intrinsics are for 20x12"):
        open_dataset(folder)[0][0]


def test_a_folder_without_recordings_says_what_was_expected(tmp_path):
    with pytest.raises(DataError, match="agent_"):
        open_dataset(tmp_path)
    with pytest.raises(DataError, match="no such folder"):
        open_dataset(tmp_path / "nowhere")


def test_written_recordings_read_back_the_same(tmp_path):
    folder = write_replica(small_flat()[:2], tmp_path / "out")
    for agent, source in enumerate(open_dataset(folder)):
        assert source.camera == small_flat()[agent].camera
        for original, back in zip(small_frames(agent), source, strict=True):
            pose = original.world_from_camera
            np.testing.assert_allclose(back.depth, original.depth, atol=0.00051)
            np.testing.assert_allclose(back.world_from_camera, pose, atol=1e-8)
            difference = np.abs(back.colour.astype(float) - original.colour)
            assert difference.mean() < 7.0  # JPEG with halved chroma, tiny image: measured 5.1
            assert back.timestamp_s == pytest.approx(original.timestamp_s)


def test_progress_counts_every_frame_to_the_total(tmp_path):
    seen = []
    write_replica(
        small_flat()[:2], tmp_path / "out", progress=lambda done, all_: seen.append((done, all_))
    )
    assert seen == [(k, 48) for k in range(1, 49)]


def test_existing_recordings_are_not_overwritten(tmp_path):
    folder = write_gray_replica(tmp_path / "scene")
    with pytest.raises(DataError, match="not empty"):
        write_replica(small_flat()[:1], folder)


class _BreaksAtFrameTwo:
    name = "agent_0"

    def __init__(self) -> None:
        self.camera = small_flat()[0].camera

    def __len__(self) -> int:
        return 4

    def __iter__(self):
        return (self[k] for k in range(4))

    def __getitem__(self, index: int) -> Frame:
        if index == 2:
            raise DataError("frame 2 is unreadable")
        return small_frames(0)[index]


def test_a_failed_write_leaves_nothing_behind(tmp_path):
    with pytest.raises(DataError, match="frame 2"):
        write_replica([_BreaksAtFrameTwo()], tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def test_depth_beyond_the_range_of_the_files_becomes_a_hole(tmp_path):
    frame = small_frames(0)[0]
    far = frame.depth.copy()
    far[:10] = 70.0

    class Far(_BreaksAtFrameTwo):
        def __len__(self) -> int:
            return 1

        def __getitem__(self, index: int) -> Frame:
            return Frame(index, 0.0, frame.colour, far, None)

    source = open_dataset(write_replica([Far()], tmp_path / "out"))[0]
    assert (source[0].depth[:10] == 0).all()
    assert source[0].world_from_camera is None
