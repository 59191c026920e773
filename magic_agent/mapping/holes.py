"""Where a depth image has no reading: a guess, so that what colour shows there is mapped too."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def filled(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """(h, w) depth whose holes take the farther of the nearest readings left and right of them,
    and rows without any reading those of the nearest row. 0 everywhere without a single reading.

    Sensors lose what lies beside a nearer edge, so the farther neighbour is the likelier.
    """
    rows = np.flatnonzero((depth > 0).any(axis=1))
    if len(rows) == 0:
        return depth
    left, right = _carried_on(depth), _carried_on(depth[:, ::-1])[:, ::-1]
    guess = np.where(depth > 0, depth, np.maximum(left, right))
    nearest = rows[np.abs(np.arange(len(depth))[:, None] - rows).argmin(axis=1)]
    return guess[nearest].astype(np.float32)


def _carried_on(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """Each pixel's own reading or the last one before it in its row; 0 before the first."""
    columns = np.where(depth > 0, np.arange(depth.shape[1]), 0)
    last = np.maximum.accumulate(columns, axis=1)
    return np.take_along_axis(depth, last, axis=1)
