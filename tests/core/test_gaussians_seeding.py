"""Seeding from an RGB-D image: geometry, size and number of the new Gaussians."""

from __future__ import annotations

import numpy as np
import pytest

from magic_core.gaussians.seeding import (
    BlockRule,
    SeedShape,
    pixels_in_need,
    seed_adaptive,
    seed_uniform,
)
from magic_core.gaussians.surface import surface_of
from magic_core.geometry import Camera, se3

CAMERA = Camera(width=64, height=48, fx=50.0, fy=50.0, cx=31.5, cy=23.5)


def plane_depth(normal: np.ndarray, distance: float) -> np.ndarray:
    """Depth (h, w) of the plane normal . p = -distance (normal faces the camera)."""
    return (-distance / (CAMERA.rays() @ normal)).astype(np.float32)


def slanted() -> tuple[np.ndarray, np.ndarray]:
    normal = np.array([0.5, -0.3, -1.0])
    normal /= np.linalg.norm(normal)
    return normal, plane_depth(normal, 2.0)


def grey(value: int = 128) -> np.ndarray:
    return np.full((48, 64, 3), value, np.uint8)


def adaptive(colour, depth, *, need=None, rule=None, shape=None, limit=100_000):
    need = np.ones(depth.shape, bool) if need is None else need
    return seed_adaptive(
        colour,
        depth,
        CAMERA,
        surface=surface_of(depth, CAMERA),
        need=need,
        rule=rule or BlockRule(depth_deviation=1.0),
        shape=shape or SeedShape(),
        limit=limit,
    )


def test_normals_of_a_slanted_plane_are_exact():
    normal, depth = slanted()
    found = surface_of(depth, CAMERA).normals[4:-4, 4:-4]
    assert np.abs(found - normal).max() < 1e-3


def test_normals_face_the_camera():
    _, depth = slanted()
    assert ((surface_of(depth, CAMERA).normals * CAMERA.rays()).sum(axis=-1) < 0).all()


def test_flying_pixels_are_unreliable_and_both_sides_of_the_edge_are_not():
    depth = np.full((48, 64), 1.0, np.float32)
    depth[:, 32:] = 2.0
    depth[:, 31] = 1.4
    reliable = surface_of(depth, CAMERA).reliable
    assert not reliable[:, 31].any()
    assert reliable[:, :31].all()
    assert reliable[:, 32:].all()


def test_a_floor_seen_at_a_grazing_angle_is_reliable_up_to_the_horizon():
    down = CAMERA.rays()[..., 1]
    depth = np.where(down > 0.05, 1.2 / np.maximum(down, 0.05), 0.0).astype(np.float32)
    assert np.array_equal(surface_of(depth, CAMERA).reliable, depth > 0)


def test_missing_readings_are_unreliable():
    depth = np.full((48, 64), 1.0, np.float32)
    depth[10:20, 10:20] = 0.0
    assert not surface_of(depth, CAMERA).reliable[10:20, 10:20].any()


def test_seeds_lie_on_the_surface_and_are_flat_along_its_normal():
    normal, depth = slanted()
    cloud = adaptive(grey(), depth)
    cloud.validate()
    assert np.abs(cloud.means @ normal + 2.0).max() < 0.01
    axes = se3.rotation_from_quaternion(cloud.quaternions)
    assert np.abs(np.abs(axes[:, :, 2] @ normal) - 1.0).max() < 1e-2
    assert (cloud.scales[:, 2] < cloud.scales[:, 1]).all()


def test_even_surface_takes_one_gaussian_per_largest_block():
    depth = np.full((48, 64), 1.5, np.float32)
    assert len(adaptive(grey(), depth)) == (48 // 8) * (64 // 8)


def test_detail_takes_more_gaussians_than_even_surface():
    depth = np.full((48, 64), 1.5, np.float32)
    detailed = grey()
    detailed[:24] = np.random.default_rng(0).integers(0, 255, (24, 64, 3))
    cloud = adaptive(detailed, depth)
    upper = int((cloud.means[:, 1] < 0).sum())
    assert upper == 24 * 64
    assert len(cloud) - upper == (24 // 8) * (64 // 8)


def test_every_wanted_pixel_belongs_to_exactly_one_block():
    rng = np.random.default_rng(1)
    depth = np.full((48, 64), 1.5, np.float32)
    need = rng.random((48, 64)) < 0.7
    need[:24] = True
    cloud = adaptive(grey(), depth, need=need)
    sides = cloud.scales[:, 1] / SeedShape().spread * CAMERA.fx / 1.5
    assert np.isclose((sides**2).sum(), need.sum(), rtol=1e-3)


def test_size_follows_the_footprint_of_the_block():
    near, far = (np.full((48, 64), z, np.float32) for z in (1.0, 3.0))
    ratio = adaptive(grey(), far).scales[0, 1] / adaptive(grey(), near).scales[0, 1]
    assert ratio == pytest.approx(3.0, rel=1e-4)


def test_slant_stretches_the_footprint():
    normal = np.array([np.sin(1.0), 0.0, -np.cos(1.0)])
    cloud = adaptive(grey(), plane_depth(normal, 1.0))
    middle = np.abs(cloud.means[:, 0] / cloud.means[:, 2]).argmin()
    stretch = cloud.scales[middle, 0] / cloud.scales[middle, 1]
    assert stretch == pytest.approx(1.0 / np.cos(1.0), rel=0.15)


def test_only_pixels_in_need_are_seeded():
    depth = np.full((48, 64), 1.5, np.float32)
    need = np.zeros((48, 64), bool)
    need[:, :32] = True
    assert (adaptive(grey(), depth, need=need).means[:, 0] < 0).all()


def test_limit_holds_by_taking_coarser_blocks():
    depth = np.full((48, 64), 1.5, np.float32)
    noise = np.random.default_rng(0).integers(0, 255, (48, 64, 3)).astype(np.uint8)
    cloud = adaptive(noise, depth, limit=600)
    assert 0 < len(cloud) <= 600
    assert np.ptp(cloud.means[:, 1]) > 1.0  # still the whole image, not its first rows


def test_nothing_to_seed_gives_an_empty_cloud():
    depth = np.zeros((48, 64), np.float32)
    assert len(adaptive(grey(), depth)) == 0


def test_uniform_seeds_are_distinct_pixels_sized_by_their_nearest_neighbour():
    depth = np.full((48, 64), 1.5, np.float32)
    cloud = seed_uniform(
        grey(),
        depth,
        CAMERA,
        need=np.ones((48, 64), bool),
        count=48 * 64,
        existing=np.zeros((0, 3), np.float32),
        rng=np.random.default_rng(0),
    )
    assert len(np.unique(cloud.means, axis=0)) == 48 * 64
    assert np.allclose(cloud.scales, 1.5 / 50.0, rtol=1e-3)
    assert (cloud.opacities == 0.5).all()


def test_uniform_seeds_depend_on_the_generator_alone():
    depth = np.full((48, 64), 1.5, np.float32)
    clouds = [
        seed_uniform(
            grey(),
            depth,
            CAMERA,
            need=np.ones((48, 64), bool),
            count=100,
            existing=np.zeros((0, 3), np.float32),
            rng=np.random.default_rng(seed),
        )
        for seed in (3, 3, 4)
    ]
    assert np.array_equal(clouds[0].means, clouds[1].means)
    assert not np.array_equal(clouds[0].means, clouds[2].means)


def test_need_is_low_alpha_or_a_large_depth_error_where_there_is_a_reading():
    depth = np.full((4, 5), 2.0, np.float32)
    depth[3] = 0.0
    alpha = np.ones((4, 5), np.float32)
    alpha[0] = 0.5
    rendered = depth + np.linspace(0.001, 0.002, 20, dtype=np.float32).reshape(4, 5)
    rendered[1, 2] = 3.0
    need = pixels_in_need(alpha, rendered, depth, alpha_threshold=0.98, depth_error_factor=40.0)
    expected = np.zeros((4, 5), bool)
    expected[0] = True
    expected[1, 2] = True
    assert np.array_equal(need, expected)
