"""Gauss-Newton alignment, the initialisers and the keyframe window, on an exact ray-cast room."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from box_room import CAMERA, room_frame, walk

from magic_agent.tracking.config import (
    GaussNewtonConfig,
    KeyframeWindowConfig,
    TrackingConfig,
)
from magic_agent.tracking.gauss_newton import GaussNewton, MotionPrior, View
from magic_agent.tracking.initialisation import make_initialiser
from magic_agent.tracking.keyframe_window import KeyframeWindow
from magic_agent.tracking.pyramid import image_pyramid, keyframe_pyramid, pyramid_cameras
from magic_agent.tracking.pyramid_cache import PyramidCache
from magic_agent.tracking.rotation import align_rotation
from magic_core.data import Frame
from magic_core.errors import ConfigError
from magic_core.geometry import se3

CONFIG = GaussNewtonConfig(levels=3)


def pyramid(frame: Frame):
    return image_pyramid(frame.colour, frame.depth, camera=CAMERA, levels=CONFIG.levels)


def pose_error(estimate: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """(millimetres, degrees)."""
    off = se3.inverse(truth) @ estimate
    return 1e3 * float(np.linalg.norm(off[:3, 3])), float(np.degrees(se3.rotation_angle(off)))


def align(reference: Frame, frame: Frame, start: np.ndarray, **settings):
    view = View(keyframe_pyramid(pyramid(reference)), reference.world_from_camera)
    config = GaussNewtonConfig(levels=CONFIG.levels, **settings)
    return GaussNewton(config).align([view], pyramid(frame), anchor_from_camera=start)


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("speed", [1.0, 2.0])
def test_alignment_finds_the_motion_between_noisy_frames(seed, speed):
    poses = walk(2, speed=speed)
    first = room_frame(poses[0], 0, noise_seed=2 * seed)
    second = room_frame(poses[1], 1, noise_seed=2 * seed + 1)
    solution = align(first, second, poses[0])
    millimetres, degrees = pose_error(solution.anchor_from_camera, poses[1])
    assert millimetres < 4.0  # 1.5 to 2.6 measured: a pixel is 2 cm wide on the walls
    assert degrees < 0.1


def test_levels_below_a_views_finest_keep_its_pull():
    poses = walk(2)
    first, second = room_frame(poses[0], 0, noise_seed=0), room_frame(poses[1], 1, noise_seed=1)
    coarse = keyframe_pyramid(pyramid(first), finest=1)
    solution = GaussNewton(CONFIG).align(
        [View(coarse, poses[0], finest=1)], pyramid(second), anchor_from_camera=poses[0]
    )
    assert pose_error(solution.anchor_from_camera, poses[1])[0] < 5.0
    assert solution.fits[0].pixels == CAMERA.width * CAMERA.height // 4


def test_two_views_know_more_than_one():
    poses = walk(3)
    frames = [room_frame(pose, i, noise_seed=i) for i, pose in enumerate(poses)]
    views = [View(keyframe_pyramid(pyramid(frame)), frame.world_from_camera) for frame in frames]
    image = pyramid(frames[2])
    one = GaussNewton(CONFIG).align(views[1:2], image, anchor_from_camera=poses[1])
    both = GaussNewton(CONFIG).align(views[:2], image, anchor_from_camera=poses[1])
    gained = both.information - one.information
    assert np.linalg.eigvalsh(gained).min() > 0.1 * np.linalg.eigvalsh(one.information).min()
    assert pose_error(both.anchor_from_camera, poses[2])[0] < 4.0


def test_exposure_step_is_taken_up_by_gain_and_bias():
    poses = walk(2)
    first, second = room_frame(poses[0], 0), room_frame(poses[1], 1)
    darker = Frame(
        1, second.timestamp_s, (0.7 * second.colour + 8.0).astype(np.uint8), second.depth
    )
    solution = align(first, darker, poses[0])
    assert pose_error(solution.anchor_from_camera, poses[1])[0] < 4.0
    fit = solution.fits[0]
    assert fit.exposure.gain == pytest.approx(1 / 0.7, rel=0.05)
    blind = align(first, darker, poses[0], photometric=False)
    assert blind.fits[0].model.colour_sigma > 3.0 * fit.model.colour_sigma


def test_information_is_that_of_the_errors():
    """Over many noisy pairs, squared errors weighted by the information average to order one."""
    poses, weighted = walk(2), []
    for seed in range(8):
        first = room_frame(poses[0], 0, noise_seed=100 + seed)
        second = room_frame(poses[1], 1, noise_seed=200 + seed)
        solution = align(first, second, poses[0])
        error = se3.log(se3.inverse(poses[1]) @ solution.anchor_from_camera)
        weighted.append(error @ solution.information @ error / 6.0)
    # Noise here is independent from pixel to pixel, so the allowance for correlation is too large.
    assert 1e-3 < np.mean(weighted) < 3.0


def bare_wall(distance_m: float) -> Frame:
    grey = np.full((CAMERA.height, CAMERA.width, 3), 128, np.uint8)
    return Frame(0, 0.0, grey, np.full((CAMERA.height, CAMERA.width), distance_m, np.float32))


def test_bare_wall_leaves_sliding_to_the_motion_prior():
    wall = bare_wall(2.0)
    predicted = se3.exp([0.02, 0.01, 0.0, 0.0, 0.0, 0.01])
    view = View(keyframe_pyramid(pyramid(wall)), np.eye(4))
    prior = MotionPrior.around(predicted, CONFIG)
    nearer = bare_wall(1.98)
    solution = GaussNewton(CONFIG).align(
        [view], pyramid(nearer), anchor_from_camera=np.eye(4), prior=prior
    )
    moved = se3.log(solution.anchor_from_camera)
    assert moved[2] == pytest.approx(0.02, abs=1e-3)  # depth knows the distance
    assert moved[:2] == pytest.approx(predicted[:2, 3], abs=2e-3)  # nothing else knows the rest
    values = np.linalg.eigvalsh(solution.information)
    assert values[0] < 1e-3 * values[-1]


def test_window_keeps_old_images_while_they_overlap_and_survives_a_new_anchor():
    window = KeyframeWindow(KeyframeWindowConfig(images=2, finest_level=0))
    poses = walk(12, speed=2.0)
    frames = [room_frame(pose, i) for i, pose in enumerate(poses)]
    window.start(frames[0], pyramid(frames[0]))
    anchor = np.eye(4)
    for previous, current in itertools.pairwise(frames):
        if current.index == 7:
            anchor = se3.exp([0.5, 0.1, 0.2, 0.3, 0.2, 0.1])  # another sub-map begins
        views = window.views(anchor @ previous.world_from_camera)
        assert 1 <= len(views) <= 2
        oldest = min(pose_error(view.anchor_from_view, anchor @ poses[0]) for view in views)
        if current.index <= 4:
            assert oldest == pytest.approx((0.0, 0.0), abs=1e-3)
        solution = GaussNewton(CONFIG).evaluate(
            views, pyramid(current), anchor_from_camera=anchor @ current.world_from_camera
        )
        assert all(fit.visible_share > 0.35 for fit in solution.fits)
        window.advance(
            current,
            pyramid(current),
            last_from_frame=se3.inverse(previous.world_from_camera) @ current.world_from_camera,
            fits=solution.fits,
        )


@pytest.mark.parametrize(
    ("name", "bound_mm"),
    [("dense", 6.0), ("rgbd_odometry", 15.0), ("point_to_plane", 12.0), ("coloured_icp", 12.0)],
)
def test_initialisers_find_the_motion_between_frames(name, bound_mm):
    initialiser = make_initialiser(
        TrackingConfig(initialisation=name), PyramidCache(CAMERA, CONFIG.levels)
    )
    poses = walk(4)
    frames = [room_frame(pose, i, noise_seed=i) for i, pose in enumerate(poses)]
    for previous, current in itertools.pairwise(frames):
        truth = se3.inverse(previous.world_from_camera) @ current.world_from_camera
        found = initialiser.estimate(
            previous, current, camera=CAMERA, predicted_previous_from_current=np.eye(4)
        )
        assert found.ok
        assert pose_error(found.previous_from_current, truth)[0] < bound_mm


@pytest.mark.parametrize("name", ["dense", "rgbd_odometry", "point_to_plane", "coloured_icp"])
def test_initialisers_give_the_prediction_back_where_there_is_nothing_to_see(name):
    initialiser = make_initialiser(
        TrackingConfig(initialisation=name), PyramidCache(CAMERA, CONFIG.levels)
    )
    seen = room_frame(walk(1)[0])
    black = Frame(1, 1 / 30, np.zeros_like(seen.colour), np.zeros_like(seen.depth))
    predicted = se3.exp([0.01, 0.02, 0.03, 0.0, 0.01, 0.0])
    found = initialiser.estimate(
        seen, black, camera=CAMERA, predicted_previous_from_current=predicted
    )
    assert not found.ok
    assert np.array_equal(found.previous_from_current, predicted)


@pytest.mark.parametrize("degrees", [6.0, 10.0])
def test_rotation_prealignment_finds_a_fast_turn(degrees):
    start = walk(1)[0]
    turn = se3.exp([0.0, 0.0, 0.0, 0.3 * np.radians(degrees), np.radians(degrees), 0.0])
    first, second = room_frame(start, 0), room_frame(start @ turn, 1)
    fit = align_rotation(pyramid(first), pyramid(second), previous_from_current=np.eye(4))
    assert fit is not None
    left = float(np.degrees(se3.rotation_angle(se3.inverse(turn) @ fit.previous_from_current)))
    assert left < 0.3 * degrees
    assert fit.cost_after < fit.cost_before


def test_rotation_prealignment_leaves_a_fitting_prediction_alone():
    poses = walk(2)
    first, second = (room_frame(pose, i) for i, pose in enumerate(poses))
    truth = se3.inverse(poses[0]) @ poses[1]
    assert align_rotation(pyramid(first), pyramid(second), previous_from_current=truth) is None


@pytest.mark.parametrize("level", [0, 12, 255])
def test_rotation_prealignment_reads_no_turn_out_of_a_covered_lens(level):
    first = room_frame(walk(1)[0])
    rng = np.random.default_rng(level)
    flat = np.clip(level + rng.integers(-1, 2, first.colour.shape), 0, 255).astype(np.uint8)
    covered = Frame(1, 1 / 30, flat, first.depth)
    for pair in [(first, covered), (covered, first)]:
        previous, current = (pyramid(frame) for frame in pair)
        assert align_rotation(previous, current, previous_from_current=np.eye(4)) is None


def test_pyramid_cameras_keep_the_rays():
    cameras = pyramid_cameras(CAMERA, 3)
    full, half = CAMERA.rays(), cameras[1].rays()
    assert np.allclose(half[3, 5], full[6:8, 10:12].mean(axis=(0, 1)), atol=1e-6)


def test_unknown_settings_are_refused():
    with pytest.raises(ConfigError, match="levels"):
        TrackingConfig(gauss_newton=GaussNewtonConfig(levels=0))
    assert TrackingConfig(solver="gn").solver == "gauss_newton"
