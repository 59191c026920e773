"""The pinhole camera: projection, resizing, validation."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from magic_core.errors import InvalidInput
from magic_core.geometry import Camera

CAMERA = Camera(width=64, height=48, fx=55.0, fy=53.0, cx=30.5, cy=24.25)


def test_projection_undoes_back_projection():
    depth = np.random.default_rng(0).uniform(0.3, 5.0, (48, 64)).astype(np.float32)
    pixels, z = CAMERA.project(CAMERA.back_project(depth).reshape(-1, 3))
    u, v = np.meshgrid(np.arange(64), np.arange(48))
    np.testing.assert_allclose(pixels, np.stack([u, v], -1).reshape(-1, 2), atol=2e-4)
    np.testing.assert_allclose(z, depth.ravel(), rtol=1e-7)


def test_axes_are_x_right_y_down_z_forward():
    pixels, _ = CAMERA.project(np.array([[0, 0, 2.0], [0.1, 0, 2.0], [0, 0.1, 2.0]]))
    np.testing.assert_allclose(pixels[0], [CAMERA.cx, CAMERA.cy])
    assert pixels[1, 0] > pixels[0, 0]
    assert pixels[2, 1] > pixels[0, 1]


def test_points_in_the_camera_plane_do_not_divide_by_zero():
    pixels, z = CAMERA.project(np.array([[1.0, 1.0, 0.0]]))
    assert np.isfinite(pixels).all()
    assert z[0] == 0.0


@pytest.mark.parametrize("scale", [0.5, 0.25, 0.37, 2.0])
def test_scaling_keeps_the_rays_of_the_image_borders(scale):
    small = CAMERA.scaled(scale)
    # Pixel centres are integers, so the image's outer borders lie at -0.5 and size - 0.5.
    for camera_u, small_u in ((-0.5, -0.5), (CAMERA.width - 0.5, small.width - 0.5)):
        assert (camera_u - CAMERA.cx) / CAMERA.fx == pytest.approx((small_u - small.cx) / small.fx)
    for camera_v, small_v in ((-0.5, -0.5), (CAMERA.height - 0.5, small.height - 0.5)):
        assert (camera_v - CAMERA.cy) / CAMERA.fy == pytest.approx((small_v - small.cy) / small.fy)
    assert (small.width, small.height) == (round(64 * scale), round(48 * scale))


def test_scaling_by_one_changes_nothing():
    assert CAMERA.scaled(1.0) == CAMERA


def test_a_good_camera_is_valid():
    CAMERA.validate()


@pytest.mark.parametrize(
    ("change", "field"),
    [({"width": 0}, "camera.width"), ({"height": -3}, "camera.width"),
     ({"width": 100_000, "height": 100_000}, "camera.width"), ({"fx": 0.0}, "camera.fx"),
     ({"fy": float("nan")}, "camera.fy"), ({"cx": float("inf")}, "camera.cx")],
)  # fmt: skip
def test_an_impossible_camera_is_refused_by_field(change, field):
    values = {name: getattr(CAMERA, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    with pytest.raises(InvalidInput) as caught:
        Camera(**{**values, **change}).validate()
    assert field in [violation.field for violation in caught.value.violations]


@pytest.mark.parametrize(
    ("field", "value"), [("fx", 1e-6), ("fy", 1e9), ("cx", 1e6), ("cy", -1e5), ("fx", np.nan)]
)
def test_absurd_intrinsics_are_named_with_their_bounds(field, value):
    camera = dataclasses.replace(CAMERA, **{field: value})
    with pytest.raises(InvalidInput) as error:
        camera.validate()
    assert error.value.violations[0].field == f"camera.{field}"
    assert "px" in str(error.value) or "pixels" in str(error.value)


def test_a_crop_beside_the_principal_point_is_a_camera():
    Camera(width=8, height=8, fx=500.0, fy=500.0, cx=-900.0, cy=1200.0).validate()
