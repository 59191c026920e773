"""Image metrics against an independent library."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from magic_core.errors import InvalidInput
from magic_core.evaluation import depth_l1, ms_ssim, psnr, ssim
from tests.core.small_flat import small_frames


def image_pairs():
    real = small_frames(0)[0].colour
    moved = small_frames(0)[4].colour
    noise = np.random.default_rng(0).normal(0, 12, real.shape)
    noisy = np.clip(real + noise, 0, 255).astype(np.uint8)
    return {"moved": (moved, real), "noisy": (noisy, real), "inverted": (255 - real, real)}


@pytest.mark.parametrize("name", ["moved", "noisy", "inverted"])
def test_psnr_and_ssim_agree_with_torchmetrics(name):
    functional = pytest.importorskip("torchmetrics.functional.image")
    import torch

    rendered, real = image_pairs()[name]
    a, b = (torch.tensor(i / 255.0).permute(2, 0, 1)[None] for i in (rendered, real))
    expected = float(functional.peak_signal_noise_ratio(a, b, data_range=1.0))
    assert psnr(rendered, real) == pytest.approx(expected, abs=1e-5)
    expected = float(functional.structural_similarity_index_measure(a, b, data_range=1.0))
    assert ssim(rendered, real) == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("name", ["moved", "noisy"])
def test_ms_ssim_agrees_with_torchmetrics(name):
    functional = pytest.importorskip("torchmetrics.functional.image")
    import torch

    rendered, real = (cv2.resize(i, (322, 241)) for i in image_pairs()[name])
    a, b = (torch.tensor(i / 255.0).permute(2, 0, 1)[None] for i in (rendered, real))
    expected = functional.multiscale_structural_similarity_index_measure(a, b, data_range=1.0)
    assert ms_ssim(rendered, real) == pytest.approx(float(expected), abs=1e-5)


def test_ms_ssim_says_nothing_of_images_too_small_for_five_scales():
    real = small_frames(0)[0].colour
    assert np.isnan(ms_ssim(real[:160, :160], real[:160, :160]))
    large = cv2.resize(real, (161, 161))
    assert ms_ssim(large, large) == pytest.approx(1.0)


def test_equal_images_are_perfect():
    real = small_frames(1)[0].colour
    assert psnr(real, real) == float("inf")
    assert ssim(real, real) == pytest.approx(1.0)


def test_psnr_of_a_known_error():
    a = np.full((20, 20, 3), 0.5)
    assert psnr(a + 0.1, a) == pytest.approx(20.0)


def test_bytes_and_floats_measure_the_same():
    rendered, real = image_pairs()["noisy"]
    assert psnr(rendered / 255.0, real / 255.0) == pytest.approx(psnr(rendered, real))
    assert ssim(rendered.astype(np.float32) / 255, real) == pytest.approx(
        ssim(rendered, real), abs=1e-6
    )


def test_values_outside_the_range_are_clipped_as_a_screen_would():
    a = np.full((20, 20, 3), 1.0)
    assert psnr(a + 3.0, a) == float("inf")


def test_images_of_different_size_are_refused():
    with pytest.raises(InvalidInput, match="shape"):
        psnr(np.zeros((4, 4, 3)), np.zeros((4, 5, 3)))
    with pytest.raises(InvalidInput, match="11"):
        ssim(np.zeros((4, 4, 3)), np.zeros((4, 4, 3)))


def test_depth_error_counts_readings_on_opaque_pixels_only():
    real = np.array([[1.0, 2.0, 0.0, 4.0]], np.float32)
    rendered = np.array([[1.1, 2.0, 9.0, 0.0]], np.float32)
    alpha = np.array([[1.0, 0.9, 1.0, 0.2]], np.float32)
    assert depth_l1(rendered, real, alpha=alpha) == pytest.approx(0.05, rel=1e-5)
    assert depth_l1(rendered, real) == pytest.approx((0.1 + 0 + 4) / 3, rel=1e-5)
    assert np.isnan(depth_l1(rendered, np.zeros_like(real)))
