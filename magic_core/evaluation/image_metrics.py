"""How alike a rendered and a real image are: PSNR, SSIM, depth L1."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core.errors import InvalidInput

Image = NDArray[np.uint8] | NDArray[np.float32] | NDArray[np.float64]

_WINDOW = 11
_SIGMA = 1.5
_C1, _C2 = 0.01**2, 0.03**2


def psnr(rendered: Image, reference: Image) -> float:
    """Peak signal-to-noise ratio in dB of (h, w, 3) images, uint8 or float 0 to 1."""
    a, b = _both_unit_range(rendered, reference)
    mean_squared = float(np.mean((a - b) ** 2))
    return float("inf") if mean_squared == 0 else -10.0 * float(np.log10(mean_squared))


def ssim(rendered: Image, reference: Image) -> float:
    """Structural similarity of (h, w, 3) images, uint8 or float 0 to 1, averaged over channels.

    Wang et al., "Image Quality Assessment" (TIP 2004): Gaussian window of 11 pixels and sigma
    1.5, images mirrored at their borders.
    """
    a, b = _both_unit_range(rendered, reference)
    if min(a.shape[:2]) < _WINDOW:
        raise InvalidInput.field("rendered", f"{a.shape[:2]}: SSIM needs at least 11x11 pixels")
    mean_a, mean_b = _window_mean(a), _window_mean(b)
    variance_a = _window_mean(a * a) - mean_a**2
    variance_b = _window_mean(b * b) - mean_b**2
    covariance = _window_mean(a * b) - mean_a * mean_b
    likeness = (2 * mean_a * mean_b + _C1) * (2 * covariance + _C2)
    norm = (mean_a**2 + mean_b**2 + _C1) * (variance_a + variance_b + _C2)
    return float(np.mean(likeness / norm))


def depth_l1(
    rendered: NDArray[np.float32],
    reference: NDArray[np.float32],
    *,
    alpha: NDArray[np.float32] | None = None,
    min_alpha: float = 0.5,
) -> float:
    """Mean absolute difference of (h, w) depths in metres; NaN where no pixel counts.

    A pixel counts where the sensor has a reading and, if `alpha` is given, the map is opaque.
    """
    counts = reference > 0
    if alpha is not None:
        counts &= alpha > min_alpha
    if not counts.any():
        return float("nan")
    return float(np.abs(rendered[counts] - reference[counts]).mean())


def _both_unit_range(
    rendered: Image, reference: Image
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    if rendered.shape != reference.shape:
        raise InvalidInput.field("rendered", f"shape {rendered.shape} against {reference.shape}")
    return _unit_range(rendered), _unit_range(reference)


def _unit_range(image: Image) -> NDArray[np.float64]:
    values = np.empty(image.shape, np.float64)
    np.divide(image, 255.0 if image.dtype == np.uint8 else 1.0, out=values)
    np.clip(values, 0.0, 1.0, out=values)
    return values


def _window_mean(image: NDArray[np.float64]) -> NDArray[np.float64]:
    blurred = cv2.GaussianBlur(np.ascontiguousarray(image), (_WINDOW, _WINDOW), _SIGMA)
    return np.asarray(blurred, np.float64)
