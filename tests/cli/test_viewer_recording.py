"""The Rerun recording, read back with Rerun's own reader."""

from __future__ import annotations

import dataclasses
import importlib.util
import io
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from magic_cli.main import run_command
from magic_cli.viewer.recording import Recording
from magic_core.geometry import se3
from magic_core.wire.records import CorrectedPose, LoopCandidate
from tests.viewed_session import viewed_session

needs_rerun = pytest.mark.skipif(
    importlib.util.find_spec("rerun") is None,
    reason="needs the extra `rerun` (rerun-sdk)",
)


class Read:
    """Every row of a recording, by entity."""

    def __init__(self, path: Path) -> None:
        from rerun.chunk import RrdReader

        self.rows: dict[str, list[dict]] = {}
        for chunk in RrdReader(path).stream().to_chunks():
            rows = chunk.to_record_batch().to_pylist()
            self.rows.setdefault(str(chunk.entity_path), []).extend(rows)

    def of(self, entity: str, component: str, *, time: str = "revision") -> list[tuple]:
        """(time, values) of each row that sets a component, in order of time."""
        found = [
            (row.get(time), row[component])
            for row in self.rows[entity]
            if row.get(component) is not None
        ]
        return sorted(found, key=lambda item: item[0])


LOOP = LoopCandidate(
    "sessions/room/agents/agent_1/submaps/1", "sessions/room/agents/agent_0/submaps/0",
    0.71, "REJECTED", "FREE_SPACE", fitness=0.62, rmse_m=0.0123, inliers=87, overlap=0.4,
)  # fmt: skip


@pytest.fixture
def corrected(tmp_path):
    """A session before and after a correction that moved agent_0/1 and rejected a loop."""
    view = viewed_session((0, 1))
    recording = Recording(tmp_path / "sub" / "room.rrd", max_points=200)
    recording.update(view)
    recording.update(view)
    moved = "sessions/room/agents/agent_0/submaps/1"
    old = view.snapshot.poses[moved]
    shift = se3.exp([0.3, 0.0, 0.1, 0.0, 0.2, 0.0])
    new = CorrectedPose(moved, old.component, old.world_from_anchor @ shift)
    poses = {**view.snapshot.poses, moved: new}
    view.snapshot = dataclasses.replace(view.snapshot, revision=4, poses=poses)
    view.loops = (LOOP,)
    view.merged = {old.component: view.submaps[moved].cloud}
    recording.update(view)
    recording.close()
    return view, Read(tmp_path / "sub" / "room.rrd")


@needs_rerun
def test_corrections_move_one_transform_and_nothing_else(corrected):
    view, read = corrected
    moved = view.snapshot.poses["sessions/room/agents/agent_0/submaps/1"]
    places = read.of("/map/agent_0/1", "Transform3D:translation")
    assert [time for time, _ in places] == [3, 4]
    np.testing.assert_allclose(places[-1][1][0], moved.world_from_anchor[:3, 3], atol=1e-6)
    quaternion = read.of("/map/agent_0/1", "Transform3D:quaternion")[-1][1][0]
    wxyz = se3.quaternion_from_rotation(moved.world_from_anchor[:3, :3])
    np.testing.assert_allclose(quaternion, wxyz[[1, 2, 3, 0]], atol=1e-6)
    assert len(read.of("/map/agent_0/0", "Transform3D:translation")) == 1
    (points,) = read.of("/map/agent_0/1/points", "Points3D:positions")
    assert 50 < len(points[1]) <= 200


@needs_rerun
def test_trajectories_are_there_before_and_after_the_correction(corrected):
    view, read = corrected
    for kind, anchors in (("corrected", view.world_from_anchor()), ("tracked", view.tracked())):
        time, strips = read.of(f"/trajectories/agent_0/{kind}", "LineStrips3D:strips")[-1]
        expected = np.concatenate(view.world_from_cameras("agent_0", anchors))[:, :3, 3]
        assert time == 4
        np.testing.assert_allclose(strips[0], expected, atol=1e-6)
    corrected_path = read.of("/trajectories/agent_0/corrected", "LineStrips3D:strips")[-1][1]
    tracked = read.of("/trajectories/agent_0/tracked", "LineStrips3D:strips")[-1][1]
    assert np.abs(np.subtract(corrected_path, tracked)).max() > 0.1


@needs_rerun
def test_keyframes_are_images_of_cameras_that_look_along_z(corrected):
    view, read = corrected
    submap = view.submaps["sessions/room/agents/agent_0/submaps/0"]
    images = read.of("/agents/agent_0/camera/image", "EncodedImage:blob", time="sensor_time")
    assert len(images) == sum(len(s.keyframes) for s in view.submaps.values()) / 2
    picture = np.asarray(Image.open(io.BytesIO(bytes(images[0][1][0]))))
    assert picture.shape == submap.keyframes[0].colour.shape
    off = [np.abs(picture.astype(int) - k.colour).mean() for k in submap.keyframes]
    assert off[0] < 12  # JPEG halves the colours of an image of 64x48 pixels
    (pinhole,) = [
        row["Pinhole:image_from_camera"]
        for row in read.rows["/agents/agent_0/camera"]
        if row.get("Pinhole:image_from_camera") is not None
    ][:1]
    np.testing.assert_allclose(np.reshape(pinhole[0], (3, 3)).T[0, 0], submap.camera.fx)
    right_down_forward = [3, 2, 5]  # Rerun's codes of the directions
    assert read.rows["/"][0]["ViewCoordinates:xyz"] == [right_down_forward]


@needs_rerun
def test_the_camera_can_be_played_along_its_corrected_path(corrected):
    view, read = corrected
    expected = np.concatenate(view.world_from_cameras("agent_1", view.world_from_anchor()))
    played = [
        row["Transform3D:translation"][0]
        for row in read.rows["/agents/agent_1/camera"]
        if row.get("Transform3D:translation") is not None and row.get("revision") is None
    ]
    np.testing.assert_allclose(played, expected[:, :3, 3], atol=1e-6)


@needs_rerun
def test_loops_carry_their_reason_and_are_said_once(corrected):
    _, read = corrected
    (verdict,) = read.of("/loops/verdicts", "TextLog:text")
    assert verdict[0] == 4
    assert "agent_1/1 - agent_0/0: FREE_SPACE" in verdict[1][0]
    _, labels = read.of("/loops/rejected", "LineStrips3D:labels")[-1]
    assert "FREE_SPACE" in labels[0]
    _, strips = read.of("/loops/rejected", "LineStrips3D:strips")[-1]
    assert np.linalg.norm(np.subtract(*strips[0])) > 0.1


@needs_rerun
def test_the_merged_map_is_there(corrected):
    _, read = corrected
    ((_, points),) = read.of("/merged/0/points", "Points3D:positions")
    assert len(points) > 50


@needs_rerun
def test_what_lies_there_is_not_overwritten(tmp_path, capsys):
    path = tmp_path / "precious.rrd"
    path.write_bytes(b"recorded for a week")
    assert run_command(["run", str(tmp_path), "--rerun", str(path)]) == 2
    assert "exists" in capsys.readouterr().err
    assert path.read_bytes() == b"recorded for a week"


@pytest.mark.parametrize("command", [["run", "data"], ["view", "127.0.0.1:1"]])
def test_a_missing_package_is_said_with_its_remedy(command, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)  # as when it is not installed
    assert run_command([*command, "--rerun", str(tmp_path / "a.rrd")]) == 2
    assert "[rerun]" in capsys.readouterr().err
    assert not (tmp_path / "a.rrd").exists()


@needs_rerun
def test_axes_of_an_export_are_those_of_the_recording(tmp_path, capsys):
    arguments = ["export", str(tmp_path), "--what", "rerun", "--axes", "flu"]
    assert run_command([*arguments, "--out", str(tmp_path / "a.rrd")]) == 2
    assert "declares its axes" in capsys.readouterr().err
