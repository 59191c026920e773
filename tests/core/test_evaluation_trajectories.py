"""Trajectory files and trajectory errors."""

from __future__ import annotations

import numpy as np
import pytest

from magic_core.errors import CorruptData, InvalidInput
from magic_core.evaluation import (
    Trajectory,
    ate_rmse,
    joint_ate_rmse,
    read_kitti,
    read_tum,
    relative_pose_error,
    write_kitti,
    write_tum,
)
from magic_core.geometry import se3


def random_walk(n: int = 60, seed: int = 0, start_s: float = 1311868164.363181) -> Trajectory:
    rng = np.random.default_rng(seed)
    poses = [se3.exp(rng.normal(size=6))]
    for _ in range(n - 1):
        poses.append(poses[-1] @ se3.exp(0.1 * rng.normal(size=6)))
    return Trajectory(start_s + np.arange(n) / 30, np.array(poses))


def test_tum_files_keep_poses_and_times(tmp_path):
    walk = random_walk()
    back = read_tum(write_tum(tmp_path / "t.txt", walk))
    np.testing.assert_allclose(back.timestamps_s, walk.timestamps_s, atol=6e-7)
    np.testing.assert_allclose(back.world_from_camera, walk.world_from_camera, atol=1e-8)


def test_tum_files_put_w_last(tmp_path):
    turn = se3.from_rotation_translation(se3.rotation_exp([0, 0, np.pi / 2]), [1, 2, 3])
    write_tum(tmp_path / "t.txt", Trajectory(np.array([1.5]), turn[None]))
    line = (tmp_path / "t.txt").read_text().splitlines()[-1]
    half = np.sqrt(0.5)
    np.testing.assert_allclose([float(v) for v in line.split()], [1.5, 1, 2, 3, 0, 0, half, half],
                               atol=1e-8)  # fmt: skip


def test_kitti_files_keep_poses(tmp_path):
    walk = random_walk()
    back = read_kitti(write_kitti(tmp_path / "k.txt", walk), timestamps_s=walk.timestamps_s)
    np.testing.assert_allclose(back.world_from_camera, walk.world_from_camera, atol=1e-8)
    assert len((tmp_path / "k.txt").read_text().splitlines()[0].split()) == 12
    with pytest.raises(InvalidInput):
        read_kitti(tmp_path / "k.txt", timestamps_s=[0.0])


def test_evo_reads_our_files_and_agrees_on_the_error(tmp_path):
    evo_file = pytest.importorskip("evo.tools.file_interface")
    from evo.core import metrics, sync

    truth = random_walk()
    rng = np.random.default_rng(1)
    drift = np.array([se3.exp(0.01 * rng.normal(size=6)) for _ in range(60)])
    estimate = Trajectory(truth.timestamps_s, truth.world_from_camera @ drift)
    estimate = estimate.transformed(se3.exp([5, -2, 1, 0.3, 0.2, 1.1]))
    theirs = [
        evo_file.read_tum_trajectory_file(str(write_tum(tmp_path / name, trajectory)))
        for name, trajectory in (("truth.txt", truth), ("estimate.txt", estimate))
    ]
    reference, aligned = sync.associate_trajectories(*theirs)
    aligned.align(reference)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((reference, aligned))
    assert ate_rmse(estimate, truth)[0] == pytest.approx(
        ape.get_statistic(metrics.StatisticsType.rmse), rel=1e-6
    )


def test_the_error_does_not_depend_on_the_world_frame():
    truth = random_walk()
    motion = se3.exp([10, -4, 2, 1.0, -0.5, 2.0])
    error, truth_from_estimated = ate_rmse(truth.transformed(motion), truth)
    assert error < 1e-12
    np.testing.assert_allclose(truth_from_estimated, se3.inverse(motion), atol=1e-9)


def test_the_error_is_the_root_mean_square_after_alignment():
    truth = random_walk(n=4000)
    noise = 0.02 * np.random.default_rng(5).normal(size=(4000, 3))
    poses = truth.world_from_camera.copy()
    poses[:, :3, 3] += noise
    error, _ = ate_rmse(Trajectory(truth.timestamps_s, poses), truth)
    assert error == pytest.approx(0.02 * np.sqrt(3), rel=0.03)


def test_scale_is_not_corrected():
    truth = random_walk()
    poses = truth.world_from_camera.copy()
    poses[:, :3, 3] *= 1.1
    spread = np.sqrt(((truth.positions - truth.positions.mean(0)) ** 2).sum(1).mean())
    assert ate_rmse(Trajectory(truth.timestamps_s, poses), truth)[0] == pytest.approx(
        0.1 * spread, rel=1e-9
    )


def test_one_alignment_for_all_shows_agents_that_are_misplaced_to_each_other():
    a, b = random_walk(seed=1), random_walk(seed=2)
    shift = se3.exp([0.5, 0, 0, 0, 0, 0])
    pairs = [(a, a), (b.transformed(shift), b)]
    assert all(ate_rmse(*pair)[0] < 1e-12 for pair in pairs)
    joint, _ = joint_ate_rmse(pairs)
    assert 0.1 < joint <= 0.25 + 1e-9
    assert joint_ate_rmse([(a.transformed(shift), a), (b.transformed(shift), b)])[0] < 1e-12


def test_poses_are_matched_by_time_not_by_line():
    truth = random_walk()
    late = truth.select(np.arange(20, 60, 3))
    shuffled_clock = Trajectory(late.timestamps_s + 0.004, late.world_from_camera)
    assert ate_rmse(shuffled_clock, truth)[0] < 1e-12


def test_different_clocks_are_refused():
    truth = random_walk()
    with pytest.raises(InvalidInput, match="clock"):
        ate_rmse(Trajectory(truth.timestamps_s - 1e9, truth.world_from_camera), truth)


@pytest.mark.parametrize("text", ["1 2 3\n", "a b c d e f g h\n", "0 nan 0 0 0 0 0 1\n"])
def test_spoiled_files_are_refused_by_name(tmp_path, text):
    (tmp_path / "t.txt").write_text(text)
    with pytest.raises(CorruptData, match=r"t\.txt"):
        read_tum(tmp_path / "t.txt")


def test_an_empty_trajectory_is_written_and_read(tmp_path):
    empty = Trajectory.from_poses([])
    assert len(read_tum(write_tum(tmp_path / "t.txt", empty))) == 0
    assert empty.path_length_m == 0.0


def test_relative_error_is_the_drift_over_a_second():
    times = np.arange(90) / 30.0
    truth = Trajectory(times, np.tile(np.eye(4), (90, 1, 1)))
    truth.world_from_camera[:, 0, 3] = times
    drifting = Trajectory(times, truth.world_from_camera.copy())
    for i, time in enumerate(times):  # per second: 3 cm along x, 0.02 rad about z
        drifting.world_from_camera[i] = se3.exp([1.03 * time, 0, 0, 0, 0, 0])
        drifting.world_from_camera[i, :3, :3] = se3.rotation_exp([0, 0, 0.02 * time])
    straight = Trajectory(times, drifting.world_from_camera.copy())
    straight.world_from_camera[:, :3, :3] = np.eye(3)
    error = relative_pose_error(straight, truth)
    assert error.pairs == 60
    assert error.translation_m == pytest.approx(0.03, rel=1e-6)
    assert error.rotation_rad == pytest.approx(0.0, abs=1e-9)
    assert relative_pose_error(drifting, truth).rotation_rad == pytest.approx(0.02, rel=1e-6)
    halved = relative_pose_error(straight, truth, interval_s=0.5)
    assert halved.translation_m == pytest.approx(0.015, rel=1e-6)


def test_relative_error_does_not_depend_on_the_world_frame():
    rng = np.random.default_rng(3)
    times = np.arange(70) / 30.0
    truth = Trajectory.from_poses((t, se3.exp(rng.normal(0, 0.3, 6))) for t in times)
    ours = Trajectory.from_poses(
        (t, pose @ se3.exp(rng.normal(0, 0.01, 6)))
        for t, pose in zip(times, truth.world_from_camera, strict=True)
    )
    here = relative_pose_error(ours, truth)
    there = relative_pose_error(ours.transformed(se3.exp([3, 2, 1, 0.3, 1.0, 2.0])), truth)
    assert there.translation_m == pytest.approx(here.translation_m, rel=1e-9)
    assert there.rotation_rad == pytest.approx(here.rotation_rad, rel=1e-6)


def test_recordings_shorter_than_the_interval_have_no_relative_error():
    short = Trajectory(np.array([0.0, 0.5]), np.tile(np.eye(4), (2, 1, 1)))
    with pytest.raises(InvalidInput, match="1 s apart"):
        relative_pose_error(short, short)
