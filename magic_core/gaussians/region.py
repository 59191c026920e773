"""A box of space, to ask for a part of a map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magic_core.errors import InvalidInput

Corner = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Region:
    """An axis-aligned box: what lies on its low faces is in it, what lies on its high faces not.

    Regions side by side thus share nothing. A side may be infinite. InvalidInput for NaN and for a
    box that holds nothing.
    """

    low: Corner
    """Lowest x, y, z, metres, in the map's world frame."""
    high: Corner
    """Highest x, y, z."""

    def __post_init__(self) -> None:
        for axis, low, high in zip("xyz", self.low, self.high, strict=True):
            if not low < high:  # true for NaN as well
                raise InvalidInput.field(
                    f"region.low.{axis}",
                    f"{low:g} with a highest {axis} of {high:g}: expected numbers, the lowest "
                    "below the highest, metres",
                )

    def holds(self, points: NDArray) -> NDArray[np.bool_]:
        """(n,) which points (n, 3) lie in it."""
        return np.asarray(((points >= self.low) & (points < self.high)).all(axis=1))
