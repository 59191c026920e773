"""The synthetic flat: exact, repeatable, overlapping, Kinect-like when asked."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from magic_core.data import open_dataset
from magic_core.data.consistency import DOCUMENTED, fits
from magic_core.data.synthetic import SyntheticConfig, synthetic_flat
from magic_core.data.synthetic.noise import kinect_depth
from magic_core.data.synthetic.paths import walk_poses
from magic_core.errors import ConfigError
from magic_core.geometry import se3
from tests.core.small_flat import SMALL, small_flat, small_frames


def walk(agent: int, frames: int = 120, seed: int = 0) -> np.ndarray:
    return walk_poses(agent, frames, rng=np.random.default_rng((seed, 1, agent)))


def test_sources_are_as_configured():
    sources = small_flat()
    assert [source.name for source in sources] == ["agent_0", "agent_1", "agent_2"]
    assert all(len(source) == 24 for source in sources)
    frame = small_frames(0)[5]
    assert frame.colour.shape == (72, 96, 3)
    assert frame.colour.dtype == np.uint8
    assert frame.depth.dtype == np.float32
    assert frame.timestamp_s == pytest.approx(5 / 30)
    field = 2 * np.rad2deg(np.arctan(48 / sources[0].camera.fx))
    assert field == pytest.approx(SMALL.field_of_view_deg)


def test_the_same_frame_is_the_same_every_time():
    again = synthetic_flat(SMALL)[1][7]
    np.testing.assert_array_equal(again.colour, small_frames(1)[7].colour)
    np.testing.assert_array_equal(again.depth, small_frames(1)[7].depth)
    noisy = dataclasses.replace(SMALL, depth_noise=True)
    first, second = (synthetic_flat(noisy)[1][7].depth for _ in range(2))
    np.testing.assert_array_equal(first, second)
    assert not np.array_equal(first, small_frames(1)[7].depth)


def test_another_seed_is_another_walk():
    assert not np.allclose(walk(0, seed=0), walk(0, seed=1), atol=1e-3)


def test_poses_depth_and_intrinsics_are_exact():
    frames = [small_frames(2)[k] for k in (0, 6, 12, 18)]
    best = fits(frames, small_flat()[2].camera)[0]
    assert best.convention == DOCUMENTED
    assert best.depth_factor == 1.0
    assert best.error < 0.004  # half a pixel of 96 on slanted surfaces: measured 0.002


def test_colour_of_a_place_is_the_same_from_two_poses():
    camera = small_flat()[0].camera
    a, b = small_frames(0)[0], small_frames(0)[8]
    b_from_a = se3.inverse(b.world_from_camera) @ a.world_from_camera
    pixels, z = camera.project(
        se3.transform_points(b_from_a, camera.back_project(a.depth).reshape(-1, 3))
    )
    column, row = np.rint(pixels).astype(int).T
    inside = (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height) & (z > 0)
    seen = inside.copy()
    seen[inside] = np.abs(b.depth[row[inside], column[inside]] - z[inside]) < 0.03
    difference = np.abs(
        a.colour.reshape(-1, 3)[seen].astype(float) - b.colour[row[seen], column[seen]]
    )
    assert seen.mean() > 0.5
    assert np.median(difference) < 6


@pytest.mark.parametrize("agent", range(4))
@pytest.mark.parametrize("frames", [120, 300])
def test_motion_per_frame_is_steady_and_trackable(agent, frames):
    poses = walk(agent, frames)
    motion = se3.inverse(poses[:-1]) @ poses[1:]
    step = np.linalg.norm(motion[:, :3, 3], axis=1)
    turn = np.rad2deg([se3.rotation_angle(m) for m in motion])
    assert step.max() < 0.04
    assert turn.max() < 2.5
    assert 0.005 < np.median(step) < 0.035


def test_cameras_are_level_and_inside_the_flat():
    poses = np.concatenate([walk(agent, 400) for agent in range(3)])
    np.testing.assert_allclose(poses[:, 2, 0], 0.0, atol=1e-12)  # no roll: x stays horizontal
    np.testing.assert_allclose(np.linalg.det(poses[:, :3, :3]), 1.0)
    assert (poses[:, 2, 3] > 1.2).all()
    assert (poses[:, 2, 3] < 1.8).all()
    assert (poses[:, :2, 3] > 0.3).all()
    assert (poses[:, :2, 3] < (9.7, 7.7)).all()


@pytest.mark.parametrize("pair", [(0, 1), (1, 2)])
@pytest.mark.parametrize("submap_frames", [30, 40, 50])
def test_successive_agents_have_anchors_that_look_at_the_same_place(pair, submap_frames):
    """A place can only be recognised between anchors: the first frames of sub-maps."""
    first, second = (walk(agent)[::submap_frames] for agent in pair)
    relative = se3.inverse(first)[:, None] @ second[None]
    near = np.linalg.norm(relative[..., :3, 3], axis=-1) < 0.8
    angle = np.array([[se3.rotation_angle(m) for m in row] for row in relative])
    assert (near & (angle < np.deg2rad(25))).any()


def test_frames_hold_enough_to_track_on():
    for agent in range(3):
        for frame in small_frames(agent)[::8]:
            assert frame.colour.std() > 25
            assert (frame.depth > 0).mean() > 0.99
            assert np.ptp(frame.depth) > 1.0
            assert 60 < frame.colour.mean() < 215


def test_sensor_noise_grows_with_distance_and_loses_edges():
    rng = np.random.default_rng(0)
    depth = np.full((100, 200), 1.0, np.float32)
    depth[:, 100:] = 4.0
    noisy = kinect_depth(depth, np.ones_like(depth), rng=rng)
    near, far = noisy[:, 5:95], noisy[:, 105:195]
    assert (near > 0).all()
    assert near.std() < 0.005
    assert 3 * near.std() < far.std() < 0.08
    assert near.mean() == pytest.approx(1.0, abs=0.002)
    assert far.mean() == pytest.approx(4.0, abs=0.01)
    assert 0.2 < (noisy[:, 99:101] == 0).mean() < 0.9
    steps = np.unique(580 * 0.075 / far) / 0.125
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-3)  # disparity in eighths of a pixel


@pytest.mark.parametrize(
    ("depth_m", "cosine", "seen"),
    [(2.0, 1.0, True), (0.2, 1.0, False), (9.0, 1.0, False), (2.0, 0.05, False)],
)
def test_sensor_sees_nothing_out_of_range_or_at_grazing_angles(depth_m, cosine, seen):
    depth, cosines = (np.full((9, 9), value, np.float32) for value in (depth_m, cosine))
    noisy = kinect_depth(depth, cosines, rng=np.random.default_rng(0))
    assert ((noisy > 0) == seen).all()


def test_addresses_configure_the_flat():
    sources = open_dataset(
        "synthetic://flat?agents=2&frames=9&width=64&height=48&detail=draft&depth_noise=false",
        scale=0.5, max_frames=3, stride=2,
    )  # fmt: skip
    assert [len(source) for source in sources] == [3, 3]
    assert (sources[0].camera.width, sources[0].camera.height) == (32, 24)
    times = [time for time, _ in sources[0].timed_poses()]
    np.testing.assert_allclose(times, [0, 2 / 30, 4 / 30])


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("synthetic://castle", "flat"),
        ("synthetic://flat?colour=red", "unknown setting"),
        ("synthetic://flat?frames=many", "expected int"),
        ("synthetic://flat?agents=0", "1 to 64"),
        ("synthetic://flat?depth_noise=maybe", "expected bool"),
    ],
)
def test_impossible_addresses_are_refused(address, message):
    with pytest.raises(ConfigError, match=message):
        open_dataset(address)


def test_the_camera_of_a_config_needs_no_renderer():
    assert SyntheticConfig().camera.width == 320
