"""A cloud's Gaussians as plain coloured points, for tools that know no splats."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magic_core.gaussians.cloud import GaussianCloud
from magic_core.gaussians.ply import write_vertices
from magic_core.geometry import se3

_POINT = [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")] + [
    (name, "u1") for name in ("red", "green", "blue")
]


def write_points(path: Path, cloud: GaussianCloud, *, comment: str = "") -> Path:
    """Write means, normals (the shortest axis, either sign) and 8-bit colours as binary PLY."""
    rows = np.zeros(len(cloud), dtype=_POINT)
    normals = shortest_axes(cloud)
    for column, name in enumerate("xyz"):
        rows[name] = cloud.means[:, column]
        rows[f"n{name}"] = normals[:, column]
    colours = np.clip(np.rint(255.0 * cloud.colours), 0, 255).astype(np.uint8)
    for column, name in enumerate(("red", "green", "blue")):
        rows[name] = colours[:, column]
    comments = ["metres"] + ([comment] if comment else [])
    return write_vertices(path, rows, comments)


def shortest_axes(cloud: GaussianCloud) -> NDArray[np.float64]:
    """(n, 3) unit vectors across each Gaussian's disc."""
    rotations = se3.rotation_from_quaternion(cloud.quaternions)
    shortest = cloud.scales.argmin(axis=1)
    return rotations[np.arange(len(cloud)), :, shortest]
