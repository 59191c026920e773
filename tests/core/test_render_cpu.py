"""The CPU rasteriser: single splats by hand, robustness, and independence of the thread count."""

import dataclasses

import numpy as np
import pytest

from magic_core.errors import WrongState
from magic_core.gaussians import GaussianCloud
from magic_core.geometry import Camera
from magic_core.render import Rasteriser

CAMERA = Camera(width=53, height=37, fx=50.0, fy=50.0, cx=26.0, cy=18.0)


def one(mean=(0.0, 0.0, 2.0), opacity=0.8, scale=0.05, colour=(1.0, 0.5, 0.25)):
    return GaussianCloud.from_arrays(
        [mean], [[1, 0, 0, 0]], scales=[[scale] * 3], opacities=[opacity], colours=[colour]
    )


def random_cloud(n, seed=0, near=1.0, far=3.0):
    rng = np.random.default_rng(seed)
    z = rng.uniform(near, far, n)
    xy = rng.uniform(-0.7, 0.7, (n, 2)) * z[:, None]
    quaternions = rng.normal(size=(n, 4))
    return GaussianCloud.from_arrays(
        np.column_stack([xy, z]),
        quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True),
        scales=np.exp(rng.uniform(-4.5, -2.0, (n, 3))),
        opacities=rng.uniform(0.05, 0.98, n),
        colours=rng.uniform(0, 1, (n, 3)),
    )


def test_one_gaussian_has_the_analytic_profile():
    view = Rasteriser(1).render(one(), CAMERA, np.eye(4))
    variance = (50.0 * 0.05 / 2.0) ** 2 + 0.3
    x = np.arange(53) - 26.0
    expected = 0.8 * np.exp(-0.5 * x**2 / variance)
    expected[expected < 1 / 255] = 0.0
    np.testing.assert_allclose(view.alpha[18], expected, atol=2e-6)
    np.testing.assert_allclose(view.colour[18, :, 1], 0.5 * expected, atol=2e-6)
    np.testing.assert_allclose(view.depth[18], 2.0 * expected, atol=4e-6)
    np.testing.assert_allclose(view.expected_depth[18][expected > 0], 2.0, rtol=1e-5)
    assert view.visible.tolist() == [True]


def test_the_nearer_gaussian_covers_the_farther():
    cloud = GaussianCloud.concatenate(
        [one((0, 0, 3.0), 0.9, 0.3, (0, 1, 0)), one((0, 0, 1.0), 0.75, 0.3, (1, 0, 0))]
    )
    pixel = Rasteriser(1).render(cloud, CAMERA, np.eye(4)).image[:, 18, 26]
    np.testing.assert_allclose(pixel[:2], [0.75, 0.25 * 0.9], atol=1e-5)
    np.testing.assert_allclose(pixel[4], 1 - 0.25 * 0.1, atol=1e-5)


def test_equal_depths_blend_in_order_of_index():
    cloud = GaussianCloud.concatenate(
        [one(colour=colour, opacity=0.6) for colour in ((1, 0, 0), (0, 1, 0), (0, 0, 1))]
    )
    pixel = Rasteriser(1).render(cloud, CAMERA, np.eye(4)).image[:3, 18, 26]
    np.testing.assert_allclose(pixel, [0.6, 0.24, 0.096], atol=1e-5)


def test_the_camera_pose_moves_the_image_the_other_way():
    world_from_camera = np.eye(4)
    world_from_camera[0, 3] = 0.4  # 0.4 m right at 2 m and fx 50: ten pixels to the left
    view = Rasteriser(1).render(one(), CAMERA, world_from_camera)
    assert np.unravel_index(view.alpha.argmax(), view.alpha.shape) == (18, 16)


def test_an_empty_cloud_gives_black_and_no_gradients():
    rasteriser = Rasteriser(2)
    view = rasteriser.render(GaussianCloud.empty(), CAMERA, np.eye(4))
    assert not view.image.any()
    assert view.visible.shape == (0,)
    gradients = rasteriser.backward(np.ones_like(view.image))
    assert gradients.means.shape == (0, 3)
    assert not gradients.pose.any()


def test_gaussians_behind_the_camera_or_beside_the_image_are_not_drawn():
    cloud = GaussianCloud.concatenate(
        [one((0, 0, -2.0)), one((0, 0, 0.005)), one((9.0, 0, 2.0)), one((0, 0, 0.0))]
    )
    view = Rasteriser(1).render(cloud, CAMERA, np.eye(4))
    assert not view.image.any()
    assert not view.visible.any()
    assert not view.radii.any()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e30])
@pytest.mark.parametrize("field", range(5))
def test_gaussians_that_are_not_finite_are_culled_and_counted(bad, field):
    good = random_cloud(40)
    arrays = [array.copy() for array in good.arrays()]
    for row in (3, 17, 39):
        arrays[field][row] = bad
    rasteriser = Rasteriser(2)
    view = rasteriser.render(GaussianCloud(*arrays), CAMERA, np.eye(4))
    rest = rasteriser.render(good.select(~np.isin(np.arange(40), (3, 17, 39))), CAMERA, np.eye(4))
    assert view.culled_not_finite == 3
    np.testing.assert_array_equal(view.image, rest.image)
    assert not view.visible[[3, 17, 39]].any()


@pytest.mark.parametrize("size", [(1, 1), (3, 2), (16, 16), (17, 15), (33, 1), (1, 40), (64, 48)])
def test_any_image_size_shows_the_same_pixels(size):
    width, height = size
    camera = Camera(width=width, height=height, fx=50.0, fy=50.0, cx=20.0, cy=9.0)
    larger = Camera(width=80, height=64, fx=50.0, fy=50.0, cx=20.0, cy=9.0)
    # All centres on the first pixel: the Jacobian's clamp, which depends on the size, stays idle.
    cloud = random_cloud(60)
    depth = cloud.means[:, 2:]
    cloud = dataclasses.replace(cloud, means=depth * np.array([-0.4, -0.18, 1.0], np.float32))
    small = Rasteriser(1).render(cloud, camera, np.eye(4))
    large = Rasteriser(1).render(cloud, larger, np.eye(4))
    np.testing.assert_allclose(small.image, large.image[:, :height, :width], atol=3e-6)


def test_a_gaussian_is_visible_exactly_if_it_changes_the_image():
    cloud = random_cloud(120, seed=3)
    rasteriser = Rasteriser(1)
    view = rasteriser.render(cloud, CAMERA, np.eye(4))
    assert 0 < view.visible.sum() < len(cloud)
    for index in range(0, len(cloud), 7):
        without = rasteriser.render(cloud.select(np.arange(120) != index), CAMERA, np.eye(4))
        assert view.visible[index] == bool((without.image != view.image).any())


@pytest.mark.parametrize("threads", [2, 5])
def test_results_do_not_depend_on_the_number_of_threads(threads):
    cloud = random_cloud(3000, seed=1)
    gradient = np.random.default_rng(2).normal(size=(5, 37, 53)).astype(np.float32)
    one_thread, many = Rasteriser(1), Rasteriser(threads)
    alone, together = (r.render(cloud, CAMERA, np.eye(4)) for r in (one_thread, many))
    np.testing.assert_array_equal(alone.image, together.image)
    np.testing.assert_array_equal(alone.visible, together.visible)
    first, second = one_thread.backward(gradient), many.backward(gradient)
    for name in ("means", "quaternions", "scales", "opacities", "colours", "pose"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def test_buffers_can_be_used_for_other_sizes_and_clouds():
    rasteriser = Rasteriser(1)
    wide = Camera(width=90, height=20, fx=40.0, fy=40.0, cx=45.0, cy=10.0)
    for n, camera in ((50, CAMERA), (5000, wide), (3, CAMERA), (0, wide), (700, CAMERA)):
        cloud = random_cloud(n, seed=n)
        fresh = Rasteriser(1)
        gradient = np.ones((5, camera.height, camera.width), np.float32)
        np.testing.assert_array_equal(
            rasteriser.render(cloud, camera, np.eye(4)).image,
            fresh.render(cloud, camera, np.eye(4)).image,
        )
        np.testing.assert_array_equal(
            rasteriser.backward(gradient).means, fresh.backward(gradient).means
        )


def test_gradients_need_a_render_first():
    with pytest.raises(WrongState):
        Rasteriser(1).backward(np.zeros((5, 37, 53), np.float32))


def test_a_million_gaussians_render_and_differentiate():
    cloud = random_cloud(1_000_000, seed=6, near=0.5, far=20.0)
    rasteriser = Rasteriser()
    view = rasteriser.render(cloud, CAMERA, np.eye(4))
    gradients = rasteriser.backward(np.ones_like(view.image))
    assert view.alpha.min() > 0.9
    assert np.isfinite(view.image).all()
    for array in (gradients.means, gradients.quaternions, gradients.scales, gradients.opacities):
        assert np.isfinite(array).all()
    assert gradients.means[~view.visible].any() == np.False_
