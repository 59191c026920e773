"""Local SLAM on a small room: tracking, hand-over, what is sent, and what happens when lost."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from magic_agent.mapping import KeyframeConfig, MappingConfig
from magic_agent.slam import FrameResult, LocalSlam
from magic_agent.slam_config import SlamConfig, SubmapConfig
from magic_core.data import Frame
from magic_core.gaussians import GaussianCloud
from magic_core.geometry import Camera, se3
from magic_core.render import Rasteriser
from magic_core.submap import Submap
from tests.small_world import look, render, thumbnail

CAMERA = Camera(width=128, height=96, fx=112.0, fy=112.0, cx=63.5, cy=47.5)
CONFIG = SlamConfig(
    mapping=MappingConfig(iterations=8, anchor_iterations=16, keyframes=KeyframeConfig(max_gap=4)),
    submap=SubmapConfig(frames=10, min_frames=5, max_lost_frames=3),
    threads=1,
)


def walk(count: int, *, start: int = 0) -> list[Frame]:
    """Frames of a gentle walk with exact poses."""
    frames = []
    for index in range(start, start + count):
        pose = look(-0.8 + 0.02 * index, -0.8 + 0.006 * index, 0.012 * index)
        frames.append(Frame(index, index / 30, *render(CAMERA, pose), world_from_camera=pose))
    return frames


def blind(frame: Frame) -> Frame:
    """The frame with the lens covered."""
    return Frame(
        frame.index, frame.timestamp_s, np.zeros_like(frame.colour), np.zeros_like(frame.depth)
    )


def darkened(frame: Frame, gain: float) -> Frame:
    """The frame with less exposure."""
    return replace(frame, colour=(gain * frame.colour).astype(np.uint8))


def run(
    frames: Sequence[Frame], config: SlamConfig = CONFIG, **options
) -> tuple[list[FrameResult], list[Submap]]:
    slam = LocalSlam(CAMERA, config, session="s", agent="a", describe=thumbnail, **options)
    results = [slam.process(frame) for frame in frames]
    submaps = [result.finished for result in results if result.finished is not None]
    last = slam.finish()
    return results, submaps if last is None else [*submaps, last]


@pytest.fixture(scope="module")
def walked() -> tuple[list[Frame], list[FrameResult], list[Submap]]:
    frames = walk(24)
    return frames, *run(frames)


def test_every_frame_is_tracked_to_millimetres_of_its_anchor(walked):
    frames, results, submaps = walked
    assert not any(result.lost for result in results)
    for submap in submaps:
        world_from_anchor = frames[submap.trajectory[0].frame_index].world_from_camera
        for tracked in submap.trajectory:
            truth = se3.inverse(world_from_anchor) @ frames[tracked.frame_index].world_from_camera
            error = se3.log(se3.inverse(truth) @ tracked.anchor_from_camera)
            assert np.linalg.norm(error[:3]) < 0.006
            assert np.degrees(np.linalg.norm(error[3:])) < 0.25


def test_after_an_exposure_jump_the_next_sub_map_is_tracked_at_its_own_exposure():
    frames = [darkened(frame, 0.35 if frame.index >= 7 else 1.0) for frame in walk(14)]
    results, submaps = run(frames)
    assert not any(result.lost for result in results)
    assert [submap.odometry is None for submap in submaps] == [True, False]
    tracked = {r.frame_index: r.tracked for r in results if r.tracked is not None}
    gains = {index: found.gain for index, found in tracked.items()}
    assert gains[8] == pytest.approx(1 / 0.35, rel=0.15)  # against the brighter sub-map
    assert [gains[11], gains[12], gains[13]] == pytest.approx([1.0] * 3, rel=0.05)
    assert not any("relocalisation" in found.stages_ms for found in tracked.values())


def test_sub_maps_partition_the_frames_and_begin_with_their_anchor(walked):
    frames, results, submaps = walked
    assert [submap.index for submap in submaps] == [0, 1, 2]
    indices = [tracked.frame_index for submap in submaps for tracked in submap.trajectory]
    assert indices == [frame.index for frame in frames]
    for submap in submaps:
        first = submap.trajectory[0]
        assert np.array_equal(first.anchor_from_camera, np.eye(4))
        assert submap.anchor.frame_index == first.frame_index
        assert np.array_equal(submap.anchor.anchor_from_camera, np.eye(4))
        assert {k.frame_index for k in submap.keyframes} <= {
            t.frame_index for t in submap.trajectory
        }
    for result, index in zip(results, [0] * 10 + [1] * 10 + [2] * 4, strict=True):
        assert result.submap_index == index


def test_keyframes_reported_are_those_sent(walked):
    _, results, submaps = walked
    reported = [result.frame_index for result in results if result.is_keyframe]
    assert reported == [k.frame_index for submap in submaps for k in submap.keyframes]


def test_odometry_edges_follow_the_true_motion_with_a_valid_information(walked):
    frames, _, submaps = walked
    assert submaps[0].odometry is None
    for before, after in itertools.pairwise(submaps):
        edge = after.odometry
        assert edge is not None
        assert edge.previous_index == before.index
        truth = (
            se3.inverse(frames[before.anchor.frame_index].world_from_camera)
            @ frames[after.anchor.frame_index].world_from_camera
        )
        error = se3.log(se3.inverse(truth) @ edge.previous_from_anchor)
        assert np.linalg.norm(error[:3]) < 0.006
        assert np.allclose(edge.information, edge.information.T)
        assert np.linalg.eigvalsh(edge.information).min() > 0


def test_sent_gaussians_are_valid_and_their_sub_maps_together_show_the_scene(walked):
    frames, _, submaps = walked
    world = []
    for submap in submaps:
        submap.gaussians.validate()
        anchor = frames[submap.anchor.frame_index].world_from_camera
        world.append(submap.gaussians.transformed(anchor))
    merged = GaussianCloud.concatenate(world)
    rasteriser = Rasteriser(1)
    for frame in frames[::5]:
        view = rasteriser.render(merged, CAMERA, frame.world_from_camera)
        assert (view.alpha > 0.9).mean() > 0.9
        error = np.abs(view.colour - frame.colour / 255.0).mean()
        assert error < 0.08


def test_no_gaussian_is_sent_while_the_next_anchor_sees_it(walked):
    _, _, submaps = walked
    rasteriser = Rasteriser(1)
    for before, after in itertools.pairwise(submaps):
        assert after.odometry is not None
        view = rasteriser.render(before.gaussians, CAMERA, after.odometry.previous_from_anchor)
        # Alone they may peek past what occluded them; in front of everything they must not be.
        assert (view.alpha > 0.5).mean() < 0.02


def test_equal_seeds_give_equal_sub_maps():
    frames = walk(6)
    first, second = (run(frames)[1][0] for _ in range(2))
    assert np.array_equal(first.gaussians.means, second.gaussians.means)
    assert np.array_equal(
        first.trajectory[-1].anchor_from_camera, second.trajectory[-1].anchor_from_camera
    )


def test_covered_lens_is_lost_holds_the_pose_and_recovers():
    frames = walk(12)
    shown = [blind(f) if 6 <= f.index < 8 else f for f in frames]
    results, submaps = run(shown)
    assert [r.frame_index for r in results if r.lost] == [6, 7]
    held = results[5].anchor_from_camera
    assert np.array_equal(results[6].anchor_from_camera, held)
    assert [t.frame_index for s in submaps for t in s.trajectory if t.lost] == [6, 7]
    assert submaps[1].odometry is not None


def test_kidnapped_agent_starts_a_sub_map_without_odometry():
    frames = walk(8)
    elsewhere = look(2.0, 1.6, np.pi)  # the opposite corner, looking back
    for index in range(8, 14):
        frames.append(Frame(index, index / 30, *render(CAMERA, elsewhere)))
    results, submaps = run(frames)
    assert [r.lost for r in results[8:]] == [True, True, False, False, False, False]
    assert [s.odometry for s in submaps] == [None, None]
    assert submaps[1].anchor.frame_index == 10
    assert all(t.lost for t in submaps[0].trajectory[8:])


def test_unusable_frames_before_the_first_anchor_belong_to_no_sub_map():
    frames = walk(5)
    shown = [blind(f) if f.index < 2 else f for f in frames]
    results, submaps = run(shown)
    assert [r.lost for r in results] == [True, True, False, False, False]
    assert [t.frame_index for t in submaps[0].trajectory] == [2, 3, 4]


def test_known_start_places_the_first_anchor_alone():
    prior = look(1.0, 2.0, 0.3)
    _, submaps = run(walk(12), world_from_anchor_prior=prior, first_submap_index=7)
    assert [s.index for s in submaps] == [7, 8]
    assert np.array_equal(submaps[0].world_from_anchor_prior, prior)
    assert submaps[1].world_from_anchor_prior is None


def test_without_time_for_mapping_tracking_goes_on_and_keyframes_are_left_out():
    frames = walk(9)
    slam = LocalSlam(CAMERA, CONFIG, session="s", agent="a", describe=thumbnail)
    results = [slam.process(frame, mapping_s=0.0 if frame.index else None) for frame in frames]
    assert [r.is_keyframe for r in results] == [True] + [False] * 8
    assert sum(r.skipped_keyframe for r in results) >= 2  # max_gap is 4
    assert not any(r.lost for r in results)


def test_a_hand_over_without_time_still_starts_a_sub_map_that_can_be_tracked_against():
    frames = walk(24)
    slam = LocalSlam(CAMERA, CONFIG, session="s", agent="a", describe=thumbnail)
    results = [slam.process(frame, mapping_s=0.0 if frame.index else None) for frame in frames]
    assert not any(r.lost for r in results)
    anchors = [r for r in results if r.finished is not None]
    assert [r.frame_index for r in anchors] == [10, 20]
    least, asked = CONFIG.mapping.least_iterations, CONFIG.mapping.anchor_iterations
    for result in anchors:
        assert result.mapped is not None
        assert (result.mapped.iterations, result.mapped.cut_iterations) == (least, asked - least)


def test_what_the_sub_map_does_not_explain_becomes_a_keyframe_even_without_time():
    rule = KeyframeConfig(max_gap=4, urgent_novelty=0.01)
    config = replace(CONFIG, mapping=replace(CONFIG.mapping, keyframes=rule))
    slam = LocalSlam(CAMERA, config, session="s", agent="a", describe=thumbnail)
    results = [slam.process(frame, mapping_s=0.0 if frame.index else None) for frame in walk(9)]
    assert sum(r.is_keyframe for r in results) >= 2
    for result in results[1:]:
        if result.mapped is not None:
            assert result.mapped.iterations == config.mapping.least_iterations


def test_motion_is_predicted_over_frames_that_are_missing():
    step = se3.exp([0.03, 0.01, 0.02, 0.0, 0.03, 0.0])
    poses = [look(-0.8, -0.8, 0.0) @ np.linalg.matrix_power(step, i) for i in range(9)]
    tracking = replace(
        CONFIG.tracking, initialisation="constant_velocity", rotation_prealignment=False
    )
    config = replace(CONFIG, tracking=replace(tracking, window=replace(tracking.window, images=0)))
    slam = LocalSlam(CAMERA, config, session="s", agent="a", describe=thumbnail)
    predicted = []
    slam._tracker._refiner = _Listening(slam._tracker._refiner, predicted)
    for index in (0, 1, 2, 6):
        slam.process(Frame(index, index / 30, *render(CAMERA, poses[index])))
    truth = se3.inverse(poses[0]) @ poses[6]
    # Measured 2.7 cm of 15; one step in place of four would miss by 11.
    assert np.linalg.norm(se3.log(se3.inverse(truth) @ predicted[-1])[:3]) < 0.04


class _Listening:
    """The tracker's own refiner, which also notes where it was told to start."""

    def __init__(self, refiner, starts: list[np.ndarray]) -> None:
        self._refiner, self._starts = refiner, starts

    def refine(self, frame, image, *, anchor_from_camera, **options):
        self._starts.append(anchor_from_camera)
        return self._refiner.refine(frame, image, anchor_from_camera=anchor_from_camera, **options)


def test_nothing_processed_leaves_nothing_to_finish():
    slam = LocalSlam(CAMERA, CONFIG, session="s", agent="a", describe=thumbnail)
    assert slam.finish() is None
