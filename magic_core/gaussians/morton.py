"""Morton order: Gaussians that are neighbours in space lie near each other in memory.

A renderer that walks the visible ones then reads whole cache lines, and differences between
successive positions are small, which the codec uses.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magic_core.gaussians.cloud import GaussianCloud

BITS = 21
"""Per axis: three axes fill 63 bits."""

_SPREAD = (
    (32, 0x001F00000000FFFF),
    (16, 0x001F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)


def morton_codes(grid: NDArray) -> NDArray[np.uint64]:
    """63-bit Morton codes (n,) of (n, 3) integers from 0 to 2^21 - 1."""
    code = np.zeros(len(grid), np.uint64)
    for axis in range(3):
        x = grid[:, axis].astype(np.uint64)
        for shift, mask in _SPREAD:
            x = (x | (x << np.uint64(shift))) & np.uint64(mask)
        code |= x << np.uint64(axis)
    return code


def in_morton_order(cloud: GaussianCloud) -> GaussianCloud:
    """The same Gaussians (finite means), sorted by the Morton code of their position."""
    return cloud if len(cloud) < 2 else cloud.select(morton_order(cloud))


def morton_order(cloud: GaussianCloud) -> NDArray[np.intp]:
    """(n,) indices that sort Gaussians (finite means) by the Morton code of their position."""
    if len(cloud) < 2:
        return np.arange(len(cloud))
    points = cloud.means.astype(np.float64)
    low = points.min(axis=0)
    step = max(float((points.max(axis=0) - low).max()), 1e-12) / (2**BITS - 1)
    grid = np.rint((points - low) / step).astype(np.int64)
    return np.argsort(morton_codes(grid), kind="stable")
