"""Resizing and undistorting: colour by area, depth never across edges."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from magic_core.data.images import ImagePreparation, read_colour, read_depth, resize_depth
from magic_core.data.intrinsics import Intrinsics
from magic_core.errors import DataError
from magic_core.geometry import Camera

CAMERA = Camera(width=64, height=48, fx=55.0, fy=55.0, cx=31.5, cy=23.5)
SIZES = [(32, 24), (21, 16), (40, 31)]


@pytest.mark.parametrize("size", SIZES)
def test_depth_never_lies_between_two_surfaces(size):
    rng = np.random.default_rng(0)
    near_or_far = np.where(rng.random((48, 64)) < 0.5, 1.0, 3.0).astype(np.float32)
    near_or_far[rng.random((48, 64)) < 0.2] = 0.0
    small = resize_depth(near_or_far, *size)
    assert small.shape == size[::-1]
    assert set(np.unique(small)) <= {0.0, 1.0, 3.0}


@pytest.mark.parametrize("size", SIZES)
def test_holes_are_filled_by_readings_under_the_pixel_only(size):
    depth = np.zeros((48, 64), np.float32)
    assert (resize_depth(depth, *size) == 0).all()
    depth[::2] = 2.0
    small = resize_depth(depth, 32, 24)
    assert (small == 2.0).all()


@pytest.mark.parametrize("scale", [0.5, 1 / 3, 0.25])
def test_a_slanted_plane_keeps_its_place(scale):
    small_camera = CAMERA.scaled(scale)
    normal = np.array([0.3, 0.4, 1.0])
    depth = (2.0 / (CAMERA.rays() @ normal)).astype(np.float32)
    small = resize_depth(depth, small_camera.width, small_camera.height)
    exact = 2.0 / (small_camera.rays() @ normal)
    bias = float(np.mean(small / exact - 1.0))
    assert abs(bias) < 5e-4  # measured 4e-4 at a quarter; one picked pixel is off by 2e-3
    assert np.abs(small / exact - 1.0).max() < 5e-3


def test_each_pixel_shows_the_majority_of_its_readings():
    depth = np.array([[1.0, 3.0], [3.0, 3.01]], np.float32)
    assert resize_depth(depth, 1, 1)[0, 0] == pytest.approx(np.mean([3.0, 3.0, 3.01]), rel=1e-6)


def test_colour_is_averaged_over_the_pixel_area():
    checker = np.indices((48, 64)).sum(axis=0) % 2
    colour = np.repeat((200 * checker)[..., None], 3, axis=2).astype(np.uint8)
    prepared = ImagePreparation.plan(Intrinsics(CAMERA, 1000.0), 0.5).colour(colour)
    assert prepared.shape == (24, 32, 3)
    assert (prepared == 100).all()


@pytest.mark.parametrize("scale", [0.0, -1.0, 1.5])
def test_impossible_scales_are_refused(scale):
    with pytest.raises(DataError, match="scale"):
        ImagePreparation.plan(Intrinsics(CAMERA, 1000.0), scale)


def test_undistorted_pixels_come_from_where_the_lens_put_them():
    stored = Camera(width=320, height=240, fx=258.0, fy=258.0, cx=159.0, cy=127.0)
    coefficients = (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)
    prepared = ImagePreparation.plan(Intrinsics(stored, 1000.0, coefficients), 1.0)
    # A "depth" image that holds 1 + its own column tells where each pixel was taken from.
    columns = np.broadcast_to(1.0 + np.arange(320, dtype=np.float32), (240, 320)).copy()
    taken = prepared.depth(columns) - 1.0
    assert (taken >= 0).all()  # no empty borders
    rays = prepared.camera.rays().reshape(-1, 3).astype(np.float64)
    pixels, _ = cv2.projectPoints(
        rays, np.zeros(3), np.zeros(3), stored.matrix, np.array(coefficients)
    )
    expected = pixels[:, 0, 0].reshape(240, 320)
    assert np.abs(taken - expected).max() <= 0.55  # nearest neighbour: half a pixel


def test_unreadable_files_are_named_with_what_was_expected(tmp_path):
    with pytest.raises(DataError, match=r"nothing\.jpg.*missing"):
        read_colour(tmp_path / "nothing.jpg")
    (tmp_path / "broken.png").write_bytes(b"not an image")
    with pytest.raises(DataError, match=r"broken\.png.*16-bit"):
        read_depth(tmp_path / "broken.png", 1000.0)
    cv2.imwrite(str(tmp_path / "eight.png"), np.zeros((4, 4), np.uint8))
    with pytest.raises(DataError, match="uint8"):
        read_depth(tmp_path / "eight.png", 1000.0)
