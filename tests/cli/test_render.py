"""Videos and pictures of a stored map."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from magic_cli.main import run_command
from magic_core.evaluation import Trajectory, psnr, write_tum
from magic_core.render import Rasteriser
from tests.core.small_flat import small_flat
from tests.core.test_evaluation_run import make_run


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return make_run(tmp_path_factory.mktemp("render") / "flat")


def frames_of(path) -> list[np.ndarray]:
    video, frames = cv2.VideoCapture(str(path)), []
    while True:
        read, frame = video.read()
        if not read:
            return frames
        frames.append(cv2.cvtColor(frame, cv2.COLOR_BGR2RGB))


def test_a_video_plays_back_with_as_many_frames_as_poses_and_shows_the_map(run, tmp_path, capsys):
    walk = run.read_trajectory("agent_0", "corrected")
    path = write_tum(
        tmp_path / "path.txt", Trajectory(walk.timestamps_s[:7], walk.world_from_camera[:7])
    )
    out = tmp_path / "walk.mp4"
    width = str(small_flat()[0].camera.width)
    options = ["--trajectory", str(path), "--out", str(out), "--width", width, "--json"]
    assert run_command(["render", str(run.path), *options]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["frames"] == 7
    frames = frames_of(out)
    assert len(frames) == 7
    view = Rasteriser(1).render(run.read_map(), small_flat()[0].camera, walk.world_from_camera[4])
    solid = view.alpha > 0.99
    error = frames[4].astype(float)[solid] / 255.0 - view.colour.clip(0, 1)[solid]
    assert -10 * np.log10((error**2).mean()) > 25  # VP9 loses a little
    assert psnr(frames[0], frames[6]) < 35  # it moves


def test_an_orbit_as_pictures_keeps_the_map_in_sight(run, tmp_path):
    out = tmp_path / "orbit"
    options = ["--out", str(out), "--seconds", "0.5", "--fps", "8", "--width", "96"]
    assert run_command(["render", str(run.path), *options]) == 0
    pictures = [cv2.imread(str(path)) for path in sorted(out.iterdir())]
    assert min(path.name for path in out.iterdir()) == "frame_000000.png"
    assert len(pictures) == 4
    assert all(picture.shape == (64, 96, 3) for picture in pictures)
    assert all(picture.std() > 10 for picture in pictures)


def test_an_agents_own_way_gives_one_picture_per_pose(run, tmp_path):
    out = tmp_path / "agent"
    options = ["--trajectory", "agent_1", "--out", str(out), "--width", "32"]
    assert run_command(["render", str(run.path), *options]) == 0
    assert len(list(out.iterdir())) == len(run.read_trajectory("agent_1", "corrected"))


def test_wrong_options_are_refused_and_leave_nothing(run, tmp_path, capsys):
    for options, said in (
        (["--trajectory", "nobody", "--out", str(tmp_path / "a.mp4")], "agent_0"),
        (["--out", str(tmp_path / "a.avi")], ".mp4"),
        (["--out", str(tmp_path / "a.mp4"), "--fps", "0"], "fps"),
        (["--out", str(tmp_path / "a.mp4"), "--width", "9000"], "width"),
    ):
        assert run_command(["render", str(run.path), *options]) in (1, 2)
        assert said in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
