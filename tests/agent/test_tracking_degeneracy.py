"""Directions that the images do not show: a bare corridor, where noise must not pass for motion."""

from __future__ import annotations

import box_room
import numpy as np
import pytest
from box_room import CAMERA

from magic_agent.mapping import MappingConfig
from magic_agent.slam import LocalSlam
from magic_agent.slam_config import SlamConfig
from magic_agent.tracking.config import GaussNewtonConfig, TrackingConfig
from magic_agent.tracking.degeneracy import Directions
from magic_core.data import Frame
from magic_core.geometry import se3
from magic_core.submap import Descriptor

ALONG = 2  # the corridor's axis is the world's z
CONFIG = SlamConfig(
    tracking=TrackingConfig(gauss_newton=GaussNewtonConfig(levels=3)),
    mapping=MappingConfig(iterations=8, anchor_iterations=16),
    threads=1,
)


def corridor_frame(world_from_camera: np.ndarray, index: int, *, bare_beyond_m: float) -> Frame:
    """A corridor whose ends are out of sight; its walls carry texture up to `bare_beyond_m`."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(box_room, "HALF_SIZE", np.array([1.1, 0.9, 60.0]))
        depth, points = box_room._cast(CAMERA, world_from_camera)
    side = np.abs(points[..., :1]) > 1.0999  # walls, as against floor and ceiling
    bare = np.full(points.shape, 0.5) + 0.15 * np.sign(points[..., :1]) * side
    textured = points[..., 2:] < bare_beyond_m
    colour = np.where(textured, box_room.texture(points), bare)
    rng = np.random.default_rng(index)
    colour = colour + rng.normal(0.0, 0.01, colour.shape)
    noisy = depth + rng.normal(0.0, 1.0, depth.shape) * (0.0015 + 0.002 * depth**2)
    return Frame(
        index,
        index / 30.0,
        np.clip(255.0 * colour, 0.0, 255.0).astype(np.uint8),
        np.where(depth < 6.0, noisy, 0.0).astype(np.float32),
        world_from_camera,
    )


def walk_along(count: int, *, bare_beyond_m: float, step_m: float = 0.02) -> list:
    """(result, error of the pose as (6,) tangent in world axes) of each frame."""
    slam = LocalSlam(
        CAMERA, CONFIG, session="s", agent="a",
        describe=lambda _: Descriptor("none", np.ones(1, np.float32)),
    )  # fmt: skip
    start = se3.exp([0.1, 0.05, 0.0, 0.0, 0.25, 0.0])
    found = []
    for index in range(count):
        pose = start.copy()
        pose[ALONG, 3] += step_m * index
        result = slam.process(corridor_frame(pose, index, bare_beyond_m=bare_beyond_m))
        off = start @ result.anchor_from_camera @ se3.inverse(pose)
        found.append((result, se3.log(off)))
    return found


def test_a_bare_corridor_is_degenerate_along_its_axis_alone():
    walked = walk_along(8, bare_beyond_m=-100.0)
    for result, error in walked[1:]:
        tracked = result.tracked
        assert tracked is not None
        assert tracked.verdict == "degenerate"
        assert "1 of 6" in tracked.reason
        assert tracked.eigenvalues[0] < 10.0 < 100.0 < tracked.eigenvalues[1]
        assert tracked.condition_number > 1e3
        across = np.delete(error[:3], ALONG)
        assert np.abs(across).max() < 0.02
        assert np.degrees(np.linalg.norm(error[3:])) < 0.5
        # Nothing shows the motion, and the information says so: at least 3 cm along the axis.
        covariance = np.linalg.inv(tracked.information)
        camera_from_world = se3.inverse(result.anchor_from_camera)[:3, :3]
        axis = camera_from_world @ se3.exp([0.1, 0.05, 0.0, 0.0, 0.25, 0.0])[:3, :3].T[:, ALONG]
        assert np.sqrt(axis @ covariance[:3, :3] @ axis) > 0.03


def test_motion_goes_on_as_before_where_texture_ends():
    """The texture leaves the view after a while; from then on the motion prior carries on."""
    walked = walk_along(26, bare_beyond_m=2.2, step_m=0.06)
    verdicts = [result.tracked.verdict for result, _ in walked[1:]]
    assert verdicts[:5] == ["ok"] * 5
    assert verdicts[-1] == "degenerate"
    assert "lost" not in verdicts
    assert abs(walked[-1][1][ALONG]) < 0.15  # of 150 cm


def test_a_textured_corridor_is_not_degenerate():
    walked = walk_along(6, bare_beyond_m=100.0)
    for result, error in walked[1:]:
        assert result.tracked.verdict == "ok", result.tracked.reason
        assert np.linalg.norm(error[:3]) < 0.015
        assert result.tracked.condition_number < 1e4


def test_directions_give_their_information_back():
    rng = np.random.default_rng(3)
    root = rng.normal(size=(6, 6)) * [10.0, 20.0, 30.0, 50.0, 60.0, 70.0]
    information = root.T @ root
    prior = np.diag([400.0] * 3 + [365.0] * 3)
    directions = Directions.of(information, prior)
    assert np.allclose(directions.information, information)
    for i in range(6):
        axis = directions.basis[:, i]
        assert axis @ prior @ axis == pytest.approx(1.0)
        assert axis @ information @ axis == pytest.approx(directions.values[i])
