"""The mapper: what keyframes do to the sub-map, its bounds, and its split at a hand-over."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from magic_agent.mapping import KeyframeConfig, Mapper, MappingConfig
from magic_core.data import Frame
from magic_core.errors import WrongState
from magic_core.gaussians import GaussianCloud
from magic_core.geometry import Camera, se3
from magic_core.render import Rasteriser
from tests.small_world import look, render

CAMERA = Camera(width=96, height=72, fx=84.0, fy=84.0, cx=47.5, cy=35.5)
CONFIG = MappingConfig(iterations=20, anchor_iterations=40, settle=0.0)
START = look(-0.8, -0.8, 0.2)


def frame_at(pose: np.ndarray, index: int) -> Frame:
    return Frame(index, index / 30, *render(CAMERA, pose))


def begun(config: MappingConfig = CONFIG) -> Mapper:
    mapper = Mapper(CAMERA, config, threads=1)
    mapper.begin(frame_at(START, 0))
    return mapper


def psnr(mapper: Mapper, frame: Frame, pose: np.ndarray) -> float:
    error = mapper.render(pose).colour - frame.colour / 255.0
    return float(-10 * np.log10(np.mean(error**2)))


def test_rendering_before_the_first_frame_is_refused():
    with pytest.raises(WrongState, match="begin"):
        Mapper(CAMERA, CONFIG).render(se3.identity())


@pytest.mark.parametrize("schedule", ["fast", "paper"])
def test_anchor_is_rendered_well_after_its_mapping(schedule):
    config = replace(CONFIG, schedule=schedule)
    mapper = begun(config)
    frame = frame_at(START, 0)
    assert psnr(mapper, frame, se3.identity()) > 20.0
    view = mapper.render(se3.identity())
    assert np.median(np.abs(view.expected_depth - frame.depth)) < 0.02


def test_new_view_is_seeded_only_where_it_shows_something_new():
    mapper = begun()
    same = mapper.insert(frame_at(START, 1), se3.identity())
    turned = START @ se3.exp([0, 0, 0, 0, 0.25, 0])
    other = mapper.insert(frame_at(turned, 2), se3.inverse(START) @ turned)
    assert same.seeded < 0.2 * len(mapper)
    assert other.seeded > same.seeded
    assert psnr(mapper, frame_at(turned, 2), se3.inverse(START) @ turned) > 20.0


def test_mapping_a_second_view_keeps_the_first():
    mapper = begun()

    turned = START @ se3.exp([0.1, 0, 0, 0, 0.2, 0])
    for index in range(1, 4):
        mapper.insert(frame_at(turned, index), se3.inverse(START) @ turned)
    assert psnr(mapper, frame_at(START, 0), se3.identity()) > 23.0


def test_size_of_a_sub_map_is_bounded():
    mapper = begun(replace(CONFIG, max_gaussians=700))
    turned = START @ se3.exp([0, 0, 0, 0, 0.5, 0])
    mapper.insert(frame_at(turned, 1), se3.inverse(START) @ turned)
    assert 0 < len(mapper) <= 700


def test_the_bound_follows_the_size_of_the_image_unless_it_is_given():
    bound, given = CONFIG.gaussian_bound, replace(CONFIG, max_gaussians=700).gaussian_bound
    assert bound(CAMERA.scaled(2.0)) == 4 * bound(CAMERA) > 0
    assert given(CAMERA.scaled(2.0)) == given(CAMERA) == 700


def test_images_kept_are_bounded_and_the_best_covered_makes_room():
    mapper = begun(replace(CONFIG, iterations=2, anchor_iterations=2, max_keyframes=3))
    elsewhere = se3.exp([0, 0, 0, 0, 1.2, 0])
    for index, pose in ((1, elsewhere), (2, se3.exp([0.02, 0, 0, 0, 0, 0]))):
        mapper.insert(frame_at(START @ pose, index), pose)
    last = se3.exp([0, 0.02, 0, 0, 0, 0])
    mapper.insert(frame_at(START @ last, 3), last)
    # Frame 2 shows what the anchor and frame 3 show; nothing else shows what frame 1 does.
    assert [keyframe.frame_index for keyframe in mapper.keyframes] == [0, 1, 3]
    for _ in range(5):
        mapper.insert(frame_at(START @ last, 4), last)
    assert len(mapper.keyframes) == 3
    assert mapper.keyframes[0].frame_index == 0


def test_keyframes_follow_motion_and_keep_their_distance():
    mapper = begun(replace(CONFIG, keyframes=KeyframeConfig(novelty=1.0)))
    near = START @ se3.exp([0.01, 0, 0, 0, 0, 0])
    turned = START @ se3.exp([0, 0, 0, 0, np.deg2rad(8.0), 0])
    pose = {id(p): se3.inverse(START) @ p for p in (near, turned)}
    gaps = CONFIG.keyframes
    assert not mapper.wants(frame_at(near, gaps.min_gap), pose[id(near)])
    assert mapper.wants(frame_at(turned, gaps.min_gap), pose[id(turned)])
    assert not mapper.wants(frame_at(turned, gaps.min_gap - 1), pose[id(turned)])
    assert mapper.wants(frame_at(near, gaps.max_gap), pose[id(near)])


def test_paper_schedule_takes_every_fifth_frame():
    mapper = begun(replace(CONFIG, schedule="paper"))
    wanted = [i for i in range(1, 11) if mapper.wants(frame_at(START, i), se3.identity())]
    assert wanted == [5, 6, 7, 8, 9, 10]  # none was inserted, so all from the fifth on


def test_split_gives_each_gaussian_to_one_side_and_the_next_anchor_loses_nothing():
    mapper = begun()
    pose = se3.exp([0.3, 0, 0.2, 0, 0.4, 0])
    seen_before = mapper.render(pose)
    sent, kept = mapper.split(pose)
    assert len(sent) + len(kept) == len(mapper)
    assert 0 < len(sent) < len(mapper)
    both = np.concatenate([sent.means, kept.transformed(pose).means])
    original = mapper.gaussians().means
    order, expected = (np.lexsort(np.round(a, 3).T) for a in (both, original))
    assert np.allclose(both[order], original[expected], atol=2e-3)
    follower = Mapper(CAMERA, CONFIG, threads=1)
    follower.begin(frame_at(START @ pose, 9), carried=kept)
    seen_after = Rasteriser(1).render(kept, CAMERA, se3.identity())
    assert np.abs(seen_after.image - seen_before.image).max() < 1e-3


def test_faded_and_oversized_gaussians_are_pruned():
    mapper = Mapper(CAMERA, CONFIG, threads=1)
    bad = GaussianCloud.from_arrays(
        [[0.0, 0.0, -5.0]] * 3,  # behind the camera: nothing optimises them
        [[1.0, 0.0, 0.0, 0.0]] * 3,
        scales=[[0.01] * 3, [0.01] * 3, [0.01, 0.01, 5.0]],
        opacities=[0.05, 0.5, 0.5],
        colours=[[0.5] * 3] * 3,
    )
    report = mapper.begin(frame_at(START, 0), carried=bad)
    assert report.pruned >= 2
    behind = mapper.gaussians().means[:, 2] < -4.9
    assert behind.sum() == 1


@pytest.mark.parametrize(("seeding", "floats"), [("adaptive", False), ("uniform", True)])
def test_nothing_is_put_where_depth_floats_over_an_edge(seeding, floats):
    depth = np.full((72, 96), 1.0, np.float32)
    depth[:, 48:] = 2.0
    depth[:, 47] = 1.4
    colour = np.random.default_rng(0).integers(40, 200, (72, 96, 3), dtype=np.uint8)
    mapper = Mapper(CAMERA, replace(CONFIG, seeding=seeding), threads=1)
    mapper.begin(Frame(0, 0.0, colour, depth))
    z = mapper.gaussians().means[:, 2]
    assert bool(((z > 1.2) & (z < 1.8)).any()) is floats  # uniform is the paper's, which knows none


def test_frame_without_depth_seeds_nothing_and_does_not_fail():
    mapper = begun()
    count = len(mapper)
    frame = frame_at(START, 1)
    dark = Frame(1, 1 / 30, frame.colour, np.zeros_like(frame.depth))
    report = mapper.insert(dark, se3.identity())
    assert report.seeded == 0
    assert len(mapper) <= count
