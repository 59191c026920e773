"""Which parts of a sub-map's surface optimisation has looked at, and how often."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

CELL_SHARE = 0.1
"""Side of a cell as a share of the median depth of the first view."""
_REACH = 1 << 20  # cells per axis, so that three numbers fit into 63 bits


class Coverage:
    """Counts looks at the cells of a grid in space, view by view.

    A view is a set of cells. Views of the same place share cells, so a place that many keyframes
    show does not get more looks than one that a single keyframe shows.
    """

    def __init__(self) -> None:
        self._side_m = 0.0
        self._numbers: dict[int, int] = {}
        self._looks = np.zeros(0)
        self._views: list[NDArray[np.intp]] = []

    def add(self, points: NDArray[np.floating], *, depth_m: float) -> None:
        """Take in a view of surface points (n, 3), anchor frame, at a median depth."""
        if self._side_m == 0.0:
            self._side_m = max(CELL_SHARE * depth_m, 1e-3)
        cells = np.unique(self._keys(points))
        numbers = [self._numbers.setdefault(int(cell), len(self._numbers)) for cell in cells]
        self._looks = np.pad(self._looks, (0, len(self._numbers) - len(self._looks)))
        self._views.append(np.array(numbers, np.intp))

    def remove(self, view: int) -> None:
        """Forget a view; those after it move up. Its cells keep their looks."""
        del self._views[view]

    def most_redundant(self, among: range) -> int:
        """The view, of some, whose cells the most other views show too."""
        shown = np.bincount(np.concatenate(self._views), minlength=len(self._looks))
        return max(among, key=lambda view: _mean(shown[self._views[view]]))

    def look(self, view: int) -> None:
        """Note that a step was made on a view."""
        self._looks[self._views[view]] += 1.0

    def neglect(self, view: int) -> float:
        """Mean over a view's cells of 1 / (1 + looks): 1 where nobody looked, near 0 where many
        did. A view without surface has 1."""
        return _mean(1.0 / (1.0 + self._looks[self._views[view]]))

    def _keys(self, points: NDArray[np.floating]) -> NDArray[np.int64]:
        cells = np.floor(np.asarray(points, np.float64) / self._side_m).astype(np.int64)
        cells = np.clip(cells + _REACH // 2, 0, _REACH - 1)
        return (cells[:, 0] * _REACH + cells[:, 1]) * _REACH + cells[:, 2]


def _mean(values: NDArray[np.floating] | NDArray[np.intp]) -> float:
    return float(np.mean(values)) if len(values) else 1.0
