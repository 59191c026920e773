"""The order in which the fine stage visits keyframes: every region gets its share."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from magic_core.geometry import se3
from magic_server.globalmap.placement import View

_CELL_M = 0.5
_SAMPLE_STEP = 16  # pixels between the samples that say which cells a view sees


def region_weights(views: Sequence[View], *, cell_m: float = _CELL_M) -> NDArray[np.float64]:
    """Visits (n,) per view, summing to 1, that spread evenly over the space they see.

    Space is cut into cells. A view's weight is the mean over its cells of 1 / (views that see the
    cell): where many keyframes look at one place, each is visited less often.
    """
    cells = [_cells_seen(view, cell_m) for view in views]
    known = [cell for cell in cells if len(cell)]
    if not known:
        return np.full(len(views), 1.0 / max(len(views), 1))
    unique, counts = np.unique(np.concatenate(known, axis=0), axis=0, return_counts=True)
    seen_by = {tuple(cell): count for cell, count in zip(unique.tolist(), counts, strict=True)}
    weights = np.array(
        [np.mean([1.0 / seen_by[tuple(c)] for c in cell.tolist()]) if len(cell) else 0.0
         for cell in cells]
    )  # fmt: skip
    # A view without any depth still has colours to teach; it gets the least weight of the others.
    weights = np.where(weights > 0, weights, weights[weights > 0].min())
    return weights / weights.sum()


def _cells_seen(view: View, cell_m: float) -> NDArray[np.int64]:
    step = _SAMPLE_STEP
    points = view.camera.back_project(view.depth)[step // 2 :: step, step // 2 :: step]
    points = points[points[..., 2] > 0].reshape(-1, 3)
    world = se3.transform_points(view.world_from_camera, points)
    return np.unique(np.floor(world / cell_m).astype(np.int64), axis=0)


class VisitOrder:
    """Deals out views so that each is visited in proportion to its weight, evenly over time.

    Each draw gives every view its weight as credit and takes one whole credit from the richest:
    no view waits much longer than its turn, which independent draws would not promise.
    """

    def __init__(self, weights: NDArray[np.float64], rng: np.random.Generator) -> None:
        self._weights = weights
        self._credit = rng.random(len(weights)) * weights.mean()

    def next(self) -> int:
        """Index of the next view."""
        self._credit += self._weights
        chosen = int(self._credit.argmax())
        self._credit[chosen] -= 1.0
        return chosen
