"""How alike a rendered and a real image are: PSNR, SSIM, MS-SSIM, depth L1."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core.errors import InvalidInput

Image = NDArray[np.uint8] | NDArray[np.float32] | NDArray[np.float64]

_WINDOW = 11
_SIGMA = 1.5
_C1, _C2 = 0.01**2, 0.03**2
_SCALE_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
MS_SSIM_MIN_SIDE = (_WINDOW - 1) * 2 ** (len(_SCALE_WEIGHTS) - 1) + 1


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
    luminance, contrast = _likeness(a, b)
    return float(np.mean(luminance * contrast))


def ms_ssim(rendered: Image, reference: Image) -> float:
    """SSIM over five scales of (h, w, 3) images, uint8 or float 0 to 1.

    Wang et al., "Multi-scale structural similarity" (Asilomar 2003). NaN for images with a side
    below 161 pixels: they have no fifth scale that the window fits into.
    """
    a, b = _both_unit_range(rendered, reference)
    if min(a.shape[:2]) < MS_SSIM_MIN_SIDE:
        return float("nan")
    result = 1.0
    inner = slice(_WINDOW // 2, -(_WINDOW // 2))
    for scale, weight in enumerate(_SCALE_WEIGHTS):
        luminance, contrast = _likeness(a, b)
        if scale == len(_SCALE_WEIGHTS) - 1:
            part = float(np.mean(luminance * contrast))
        else:
            part = float(np.mean(contrast[inner, inner]))
            a, b = _halved(a), _halved(b)
        result *= max(part, 0.0) ** weight
    return result


def _likeness(
    a: NDArray[np.float64], b: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Each pixel's and channel's likeness of luminance, and of contrast and structure."""
    mean_a, mean_b = _window_mean(a), _window_mean(b)
    variance_a = _window_mean(a * a) - mean_a**2
    variance_b = _window_mean(b * b) - mean_b**2
    covariance = _window_mean(a * b) - mean_a * mean_b
    luminance = (2 * mean_a * mean_b + _C1) / (mean_a**2 + mean_b**2 + _C1)
    return luminance, (2 * covariance + _C2) / (variance_a + variance_b + _C2)


def _halved(image: NDArray[np.float64]) -> NDArray[np.float64]:
    """Means of 2 x 2 pixels; an odd last row or column is left out."""
    height, width = (side // 2 * 2 for side in image.shape[:2])
    even = image[:height, :width]
    return even.reshape(height // 2, 2, width // 2, 2, -1).mean(axis=(1, 3))


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
