"""Exposure of one image against another, and whether it has jumped.

Alignment estimates gain and bias along with the pose, but a sudden step (lights switched, automatic
exposure that reacts) first looks like motion to it. Between consecutive frames the scene hardly
changes, so neither does the distribution of brightness: a line through the quantiles of the two
images gives the step before anything is aligned. Small differences are left to the alignment.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magic_agent.tracking.pyramid import Pyramid
from magic_core.data import Frame

_QUANTILES = np.linspace(0.05, 0.95, 19)
_SATURATED, _DARK = 0.98, 0.02  # of full scale: what the sensor clipped says nothing
_MIN_CLEAR = 6  # quantiles that a line is put through, at least
_MIN_SPREAD = 0.02  # of full scale: a flat image does not determine a gain
_NEWS = 0.12  # a smaller change of gain, or of brightness, is no jump
_MAX_GAIN = 4.0


@dataclass(frozen=True, slots=True)
class Exposure:
    """What makes an image as bright as a reference: gain * image + bias, full scale is 1."""

    gain: float = 1.0
    bias: float = 0.0

    def after(self, first: Exposure) -> Exposure:
        """This correction applied to what `first` has corrected."""
        return Exposure(self.gain * first.gain, self.gain * first.bias + self.bias)

    def corrected(self, frame: Frame) -> Frame:
        """The frame with its colours as bright as the reference's."""
        colour = self.gain * frame.colour.astype(np.float32) + 255.0 * self.bias
        return replace(frame, colour=np.clip(colour, 0.0, 255.0).astype(np.uint8))


SAME = Exposure()


def exposure_jump(previous: Pyramid, current: Pyramid) -> Exposure:
    """The correction of the current image to the previous one's exposure if that has jumped;
    no correction otherwise. Looks at the coarsest level."""
    return matched(_brightness(previous), _brightness(current))


def matched(reference: NDArray[np.float32], image: NDArray[np.float32]) -> Exposure:
    """The correction of brightness values (any number) to the distribution of the reference's, if
    they differ by more than a moving camera explains; none where that cannot be told."""
    if min(reference.size, image.size) < len(_QUANTILES):
        return SAME
    target, seen = np.quantile(reference, _QUANTILES), np.quantile(image, _QUANTILES)
    low, high = np.minimum(target, seen), np.maximum(target, seen)
    clear = (low > _DARK) & (high < _SATURATED)
    if clear.sum() < _MIN_CLEAR or np.ptp(seen[clear]) < _MIN_SPREAD:
        return SAME
    gain, bias = np.polyfit(seen[clear], target[clear], 1)
    if not 1.0 / _MAX_GAIN < gain < _MAX_GAIN:
        return SAME
    change = float(np.abs((gain - 1.0) * seen + bias).mean())
    jumped = max(abs(np.log(gain)), change / max(float(target.mean()), _DARK)) > _NEWS
    return Exposure(float(gain), float(bias)) if jumped else SAME


def _brightness(pyramid: Pyramid) -> NDArray[np.float32]:
    return pyramid.levels[-1][..., :3].mean(axis=-1)
