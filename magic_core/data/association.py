"""Pairing measurements of two sensors by time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def associate(
    first_s: NDArray[np.float64], second_s: NDArray[np.float64], *, max_difference_s: float
) -> NDArray[np.intp]:
    """(k, 2) index pairs of nearest times, each index used once, closest pairs first served."""
    if not len(first_s) or not len(second_s):
        return np.zeros((0, 2), np.intp)
    order = np.argsort(second_s, kind="stable")
    right = np.searchsorted(second_s[order], first_s)
    candidates = []
    for shift in (-1, 0):
        j = order[np.clip(right + shift, 0, len(order) - 1)]
        difference = np.abs(second_s[j] - first_s)
        candidates += [(d, i, int(j[i])) for i, d in enumerate(difference) if d <= max_difference_s]
    taken: dict[int, int] = {}
    used: set[int] = set()
    for _, i, j in sorted(candidates):
        if i not in taken and j not in used:
            taken[i] = j
            used.add(j)
    return np.array(sorted(taken.items()), dtype=np.intp).reshape(-1, 2)
