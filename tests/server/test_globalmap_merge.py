"""Merging placed sub-maps of a small room into one map."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from magic_core.errors import ConfigError, InvalidInput
from magic_core.gaussians import GaussianCloud
from magic_core.gaussians.seeding import BlockRule, SeedShape, seed_adaptive
from magic_core.gaussians.surface import surface_of
from magic_core.geometry import Camera, se3
from magic_core.render import Rasteriser, RenderedView
from magic_core.submap import Keyframe, Submap, TrackedFrame
from magic_server.globalmap import GlobalMap, MergeConfig, PlacedSubmap, build_global_map
from magic_server.globalmap.contribution import survey
from magic_server.globalmap.fill import FillRule, completed_depth, seen_through
from magic_server.globalmap.placement import View, coarse_merge, views_of
from magic_server.globalmap.refine import rates
from tests.small_world import look, render, thumbnail

CAMERA = Camera(width=96, height=72, fx=84.0, fy=84.0, cx=47.5, cy=35.5)
CONFIG = MergeConfig(iterations=150, threads=1)


@functools.cache
def submap(index: int, x: float, yaw: float, *, hole: bool = False) -> PlacedSubmap:
    """A sub-map of two keyframes, seeded from its anchor alone; with `hole`, left half missing."""
    world_from_anchor = look(x, -0.8, yaw)
    colour, depth = render(CAMERA, world_from_anchor)
    need = np.ones(depth.shape, bool)
    if hole:
        need[:, : CAMERA.width // 2] = False
    gaussians = seed_adaptive(
        colour,
        depth,
        CAMERA,
        surface=surface_of(depth, CAMERA),
        need=need,
        rule=BlockRule(),
        shape=SeedShape(),
        limit=100_000,
    )
    step = se3.exp([0.05, 0.0, 0.0, 0.0, 0.06, 0.0])
    second = Keyframe(1, 1 / 30, step, *render(CAMERA, world_from_anchor @ step))
    placed = Submap(
        session="s",
        agent="a",
        index=index,
        camera=CAMERA,
        gaussians=gaussians,
        keyframes=(Keyframe(0, 0.0, np.eye(4), colour, depth), second),
        trajectory=(TrackedFrame(0, 0.0, np.eye(4)), TrackedFrame(1, 1 / 30, step)),
        descriptor=thumbnail(colour),
    )
    return PlacedSubmap(placed, world_from_anchor)


def merge(submaps: list[PlacedSubmap], config: MergeConfig = CONFIG) -> GlobalMap:
    return build_global_map(submaps, config, progress=lambda share, text: None)


def psnr(cloud: GaussianCloud, pose: np.ndarray) -> float:
    colour, _ = render(CAMERA, pose)
    error = Rasteriser(1).render(cloud, CAMERA, pose).colour - colour / 255.0
    return float(-10 * np.log10(np.mean(error**2)))


def test_coarse_merge_is_the_sub_maps_moved_to_their_places():
    placed = [submap(0, -0.5, 0.0), submap(1, 0.5, 0.3)]
    cloud = merge(placed, replace(CONFIG, refine=False)).cloud
    expected = np.concatenate(
        [se3.transform_points(p.world_from_anchor, p.submap.gaussians.means) for p in placed]
    )
    assert len(cloud) == len(expected)
    distance, nearest = cKDTree(expected).query(cloud.means)
    assert distance.max() < 1e-5
    assert len(np.unique(nearest)) == len(expected)


def test_fine_stage_improves_keyframes_and_views_between_them():
    placed = [submap(0, -0.5, 0.0), submap(1, 0.5, 0.3)]
    result = merge(placed)
    assert result.summary.psnr_fine_db > result.summary.psnr_coarse_db + 2.0
    between = placed[0].world_from_anchor @ se3.exp([0.025, 0.0, 0.0, 0.0, 0.03, 0.0])
    assert psnr(result.cloud, between) > psnr(coarse_merge(placed), between)
    result.cloud.validate()


def test_what_keyframes_saw_but_no_sub_map_holds_is_filled():
    placed = [submap(0, 0.0, 0.0, hole=True)]
    without = merge(placed, replace(CONFIG, fill=False, fill_unmeasured=False))
    result = merge(placed)
    assert result.summary.filled > 100
    pose = placed[0].world_from_anchor
    assert psnr(result.cloud, pose) > psnr(without.cloud, pose) + 5.0
    depth = Rasteriser(1).render(result.cloud, CAMERA, pose).expected_depth
    assert np.median(np.abs(depth - render(CAMERA, pose)[1])) < 0.02


def test_the_same_surface_mapped_twice_becomes_one_layer():
    placed = [submap(0, 0.0, 0.0), submap(1, 0.0, 0.0)]
    once, twice = len(placed[0].submap.gaussians), merge(placed)
    assert twice.summary.coarse_gaussians == 2 * once
    assert twice.summary.pruned > 0.5 * once
    assert psnr(twice.cloud, placed[0].world_from_anchor) > 20.0


def test_gaussians_that_no_keyframe_sees_are_dropped():
    placed = submap(0, 0.0, 0.0)
    behind = placed.submap.gaussians.transformed(se3.exp([0, 0, 0, 0, np.pi, 0]))
    both = GaussianCloud.concatenate([placed.submap.gaussians, behind])
    cloud = merge([PlacedSubmap(replace(placed.submap, gaussians=both), np.eye(4))]).cloud
    assert cloud.means[:, 2].min() > 0.0


def test_equal_seeds_give_equal_maps_whatever_the_threads():
    placed = [submap(0, -0.5, 0.0), submap(1, 0.5, 0.3)]
    quick = replace(CONFIG, iterations=30)
    first = merge(placed, quick).cloud
    again = merge(placed, replace(quick, threads=2)).cloud
    assert np.array_equal(first.means, again.means)
    assert np.array_equal(first.colours, again.colours)


def test_it_stops_when_the_loss_has_settled():
    result = merge(
        [submap(0, 0.0, 0.0)], replace(CONFIG, iterations=5000, passes=100, converged=0.15)
    )
    assert result.summary.converged
    assert 100 < result.summary.iterations < 2500


def test_progress_rises_to_one():
    heard: list[float] = []
    build_global_map(
        [submap(0, 0.0, 0.0)],
        replace(CONFIG, iterations=60),
        progress=lambda share, text: heard.append(share),
    )
    assert heard == sorted(heard)
    assert heard[-1] == 1.0


def test_moving_the_world_moves_the_map_with_it():
    placed = [submap(0, -0.5, 0.0), submap(1, 0.5, 0.3)]
    moved_from_world = se3.exp([3.0, -1.0, 2.0, 0.1, 0.7, -0.2])
    moved = [PlacedSubmap(p.submap, moved_from_world @ p.world_from_anchor) for p in placed]
    here = psnr(merge(placed).cloud, placed[0].world_from_anchor)
    there = merge(moved).cloud.transformed(se3.inverse(moved_from_world))
    assert psnr(there, placed[0].world_from_anchor) == pytest.approx(here, abs=0.7)


def test_nothing_to_merge_is_refused():
    with pytest.raises(InvalidInput, match="submaps"):
        merge([])


def test_values_out_of_range_are_named():
    with pytest.raises(ConfigError, match=r"merge\.alpha_threshold"):
        merge([submap(0, 0.0, 0.0)], replace(CONFIG, alpha_threshold=2.0))


def test_learning_rates_fall_in_a_straight_line():
    config = MergeConfig(means_rate_m=1e-3, final_rate=0.2)
    assert [rates(config, t).means for t in (0.0, 0.5, 1.0)] == pytest.approx([1e-3, 6e-4, 2e-4])
    assert rates(config, 1.0).colours == pytest.approx(0.2 * rates(config, 0.0).colours)


RULE = FillRule(measured=True, unmeasured=True, alpha_threshold=0.8, limit=1000)


def test_holes_are_filled_and_specks_are_left_to_optimising():
    colour, depth = render(CAMERA, np.eye(4))
    depth = np.full_like(depth, 2.0)
    alpha = np.ones_like(depth)
    alpha[10, 10] = alpha[20, 30] = 0.0  # specks
    alpha[40:48, 50:60] = 0.0  # a hole
    depth[60:64, 5:9], alpha[60:64, 5:9] = 0.0, 0.0  # seen in colour alone
    image = np.stack([*colour.transpose(2, 0, 1) / 255.0, alpha * depth, alpha]).astype(np.float32)
    shown = RenderedView(image, np.zeros(0, bool), np.zeros(0, np.float32), 0)
    view = View(CAMERA, np.eye(4), colour, depth)
    measured, unmeasured = RULE.needs(view, shown)
    assert measured[40:48, 50:60].all()
    assert measured.sum() == 80
    assert unmeasured.sum() == 16
    assert RULE.lacks(view, shown) == 96
    assert replace(RULE, measured=False, unmeasured=False).lacks(view, shown) == 0


def test_a_survey_finds_what_shows_and_which_keyframes_lack_anything():
    whole, holed = submap(0, 0.0, 0.0), submap(0, 0.0, 0.0, hole=True)
    behind = whole.submap.gaussians.transformed(se3.exp([0, 0, 0, 0, np.pi, 0]))
    cloud = GaussianCloud.concatenate([whole.submap.gaussians, behind])
    views = views_of([PlacedSubmap(whole.submap, np.eye(4))])
    found = survey(cloud, views, rasteriser=Rasteriser(1), lacks=RULE.lacks)
    count = len(whole.submap.gaussians)
    assert (found.best[count:] == 0).all()
    assert found.best[:count].sum() > 0.5 * CAMERA.width * CAMERA.height
    half = survey(holed.submap.gaussians, views, rasteriser=Rasteriser(1), lacks=RULE.lacks)
    assert half.lacking[0] > found.lacking[0] + 0.3 * CAMERA.width * CAMERA.height


def test_completed_depth_continues_the_plane_of_the_nearest_reading():
    rays = CAMERA.rays()
    floor = np.where(rays[..., 1] > 0.02, 1.2 / np.maximum(rays[..., 1], 0.02), 0.0)
    full = np.where(floor > 0, floor, 0.0).astype(np.float32)
    cut = full.copy()
    cut[-12:] = 0.0  # the sensor's image ends above the bottom of the colour image
    pose = np.eye(4)
    view = View(CAMERA, pose, np.zeros((72, 96, 3), np.uint8), cut)
    empty = Rasteriser(1).render(GaussianCloud.empty(), CAMERA, pose)
    completed = completed_depth(view, empty)
    assert np.abs(completed[-12:] - full[-12:]).max() < 0.03


def test_points_in_space_that_a_view_saw_through_are_known():
    placed = submap(0, 0.0, 0.0)
    view = views_of([placed])[0]
    rays = CAMERA.rays()[::8, ::8].reshape(-1, 3)
    depth = view.depth[::8, ::8].reshape(-1, 1)
    floating, on_it, behind = (
        se3.transform_points(view.world_from_camera, rays * depth * share)
        for share in (0.7, 1.0, 1.3)
    )
    assert seen_through(floating, [view]).all()
    assert not seen_through(on_it, [view]).any()
    assert not seen_through(behind, [view]).any()
