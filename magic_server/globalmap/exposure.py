"""Keyframes brought to one exposure while the map learns from them.

Cameras with automatic exposure see one wall in different brightness, and agents with different
cameras in different tints. Each keyframe gets a gain and an offset per channel, fitted in closed
form to what the map shows, and teaches the map its colours with both undone.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magic_server.globalmap.placement import View

_PRIOR = 0.02  # weight of "no change" beside the mean square of the colours
_BOUNDS = (0.4, 2.5)  # gains beyond these are a wrong pose, not a shutter
_OPAQUE = 0.9
_STEP = 4  # every n-th pixel in each direction is enough for six numbers


class ExposureModel:
    """Gain and offset (3,) of each keyframe: seen = gain * map + offset."""

    def __init__(self, count: int) -> None:
        self.gains = np.ones((count, 3))
        self.offsets = np.zeros((count, 3))

    def fit(
        self, index: int, view: View, shown: NDArray[np.float32], alpha: NDArray[np.float32]
    ) -> None:
        """Fit one keyframe to what the map shows: colour (h, w, 3) and alpha (h, w)."""
        solid = alpha[::_STEP, ::_STEP] > _OPAQUE
        if solid.sum() < 50:
            return
        x = shown[::_STEP, ::_STEP][solid].astype(np.float64)
        y = view.colour[::_STEP, ::_STEP][solid] / 255.0
        for channel in range(3):
            a, b = x[:, channel], y[:, channel]
            variance, covariance = a.var(), ((a - a.mean()) * (b - b.mean())).mean()
            gain = (covariance + _PRIOR) / (variance + _PRIOR)
            gain = float(np.clip(gain, *_BOUNDS))
            self.gains[index, channel] = gain
            self.offsets[index, channel] = b.mean() - gain * a.mean()

    def centre(self) -> None:
        """Take out what all keyframes have in common: it belongs to the map."""
        self.offsets -= self.offsets.mean(axis=0)
        self.gains /= np.exp(np.log(self.gains).mean(axis=0))

    def undone(self, index: int, colour: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """A keyframe's colour as the map should show it; saturated values stay as they are."""
        values = (colour / 255.0 - self.offsets[index]) / self.gains[index]
        result = np.clip(np.rint(255.0 * values), 0, 255).astype(np.uint8)
        return np.where((colour == 255).all(axis=-1, keepdims=True), colour, result)
