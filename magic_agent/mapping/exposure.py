"""Exposure of a keyframe against the sub-map, and its removal.

When lights are switched or automatic exposure jumps, images of both exposures mapped as they are
smear each other's colours. A keyframe beyond the jump is therefore brought to the exposure of the
sub-map, and at a hand-over the Gaussians that move on are brought to that of the new anchor. Small
differences are left alone: following a slow drift by fits to the map loses more than it gains.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_STEP = 4  # every so many pixels are looked at
_MIN_ALPHA = 0.95
_MIN_PIXELS = 200
_CLEAR = (0.03, 0.97)  # of full scale: what the sensor clipped says nothing
_MIN_SPREAD = 0.02  # of full scale: a flat image does not determine a gain
_ROUNDS = 3
_OUTLIER = 2.5  # robust standard deviations
_MAX_GAIN = 4.0


@dataclass(frozen=True, slots=True)
class Exposure:
    """image = gain * sub-map + bias, per colour channel; full scale is 1."""

    gain: NDArray[np.float64]  # (3,)
    bias: NDArray[np.float64]  # (3,)

    @property
    def difference(self) -> float:
        """Largest change of any channel between black and white."""
        return float(np.maximum(np.abs(self.bias), np.abs(self.gain - 1.0 + self.bias)).max())

    def applied(self, colours: NDArray[np.float32]) -> NDArray[np.float32]:
        """(n, 3) colours of the sub-map as this exposure shows them."""
        return np.clip(self.gain * colours + self.bias, 0.0, 1.0).astype(np.float32)

    def removed(self, colour: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """(h, w, 3) the image as the sub-map's exposure would have shown it."""
        levels = np.arange(256)[:, None]
        table = np.clip(np.rint((levels - 255.0 * self.bias) / self.gain), 0, 255).astype(np.uint8)
        return np.stack([table[colour[..., channel], channel] for channel in range(3)], axis=-1)


def exposure_of(
    colour: NDArray[np.uint8], rendered: NDArray[np.float32], alpha: NDArray[np.float32]
) -> Exposure | None:
    """Exposure of an image (h, w, 3) against the sub-map rendered at its pose.

    None where too little of the image shows mapped surface to tell.
    """
    seen = alpha[::_STEP, ::_STEP] > _MIN_ALPHA
    images = colour[::_STEP, ::_STEP][seen] / 255.0
    maps = rendered[::_STEP, ::_STEP][seen].astype(np.float64)
    lines = [_line(maps[:, channel], images[:, channel]) for channel in range(3)]
    found = [line for line in lines if line is not None]
    if len(found) < 3:
        return None
    gain, bias = np.array(found).T
    return Exposure(gain, bias)


def _line(x: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[float, float] | None:
    """(gain, bias) of y = gain * x + bias without outliers; None where it is not determined.

    Both are noisy, so the gain is the ratio of their spreads: least squares would find it too
    small.
    """
    low, high = _CLEAR
    clear = (np.minimum(x, y) > low) & (np.maximum(x, y) < high)
    x, y = x[clear], y[clear]
    if len(x) < _MIN_PIXELS or min(np.std(x), np.std(y)) < _MIN_SPREAD:
        return None
    gain = _median_slope(x, y)
    bias = float(np.median(y - gain * x))
    for _ in range(_ROUNDS):
        error = np.abs(y - gain * x - bias)
        inside = error <= _OUTLIER * 1.4826 * max(float(np.median(error)), 1e-3)
        gain = float(np.std(y[inside]) / max(np.std(x[inside]), 1e-6))
        bias = float(np.mean(y[inside]) - gain * np.mean(x[inside]))
    return (gain, bias) if 1.0 / _MAX_GAIN < gain < _MAX_GAIN else None


def _median_slope(x: NDArray[np.float64], y: NDArray[np.float64]) -> float:
    """The median slope between pixels of the darker and of the brighter half, a quick Theil-Sen."""
    order, half = np.argsort(x, kind="stable"), len(x) // 2
    low, high = order[:half], order[-half:]
    return float(np.median((y[high] - y[low]) / np.maximum(x[high] - x[low], 1e-6)))
