"""Where to stand, which way is up, and what hangs above the cameras and hides the rest."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magic_cli.viewer.model import Pose, SessionView
from magic_core.evaluation.vantage import up_direction
from magic_core.geometry import se3

Vector = NDArray[np.float64]

_ABOVE_M = 0.7
"""Higher than this above the nearest camera, metres: a ceiling, for cameras held by people."""
_ELEVATION_RAD = np.deg2rad(50.0)
FIELD_OF_VIEW_RAD = np.deg2rad(50.0)
"""Vertical, of the page's camera."""
_ASPECT = 1.6
_BESIDE_PANEL = 0.7
"""The share of the page's width that the panel leaves free, at its left."""
_MARGIN = 1.08
_NEAREST_M = 1.0
_SAMPLES = 2000
"""Gaussians of a sub-map that decide where to stand."""


def up_of(view: SessionView, anchors: dict[str, Pose]) -> Vector:
    """Unit (3,) up of a session's picture, from the cameras, which people hold level."""
    return up_direction(np.concatenate([anchors[n] @ view.submaps[n].path for n in anchors]))


def above(points: NDArray, cameras: NDArray, up: Vector) -> NDArray[np.bool_]:
    """(n,) which of (n, 3) points hang above the nearest of (k, 3) cameras; all in one frame."""
    from scipy.spatial import KDTree

    _, nearest = KDTree(cameras).query(points, workers=1)
    return (points - cameras[nearest]) @ up > _ABOVE_M


def outside(view: SessionView, anchors: dict[str, Pose], up: Vector) -> tuple[Vector, Vector]:
    """(position, look_at) of a view from above that holds the map and the agents.

    It looks the way the agents looked on average, as far as that is level, and leaves the right of
    the page to the panel.
    """
    points = _points(view, anchors, up)
    ahead = _level(np.stack([pose[:3, 2] for pose in anchors.values()]).mean(axis=0), up)
    forward = np.cos(_ELEVATION_RAD) * ahead - np.sin(_ELEVATION_RAD) * up
    right = np.asarray(np.cross(ahead, up), np.float64)
    upwards = np.asarray(np.cross(right, forward), np.float64)
    axes = np.stack([right, upwards, forward])
    place, depth = _fitted(points @ axes.T)
    position: Vector = place @ axes
    return position, position + depth * forward


def _points(view: SessionView, anchors: dict[str, Pose], up: Vector) -> Vector:
    """(n, 3) some of what is seen: Gaussians below the ceiling, and where cameras stood."""
    parts = []
    for name, pose in anchors.items():
        submap = view.submaps[name]
        every = max(1, len(submap.cloud) // _SAMPLES)
        some = np.asarray(submap.cloud.means[::every], np.float64)
        path = submap.path[:, :3, 3]
        hidden = above(some, path, pose[:3, :3].T @ up) if len(some) else np.zeros(0, bool)
        parts += [se3.transform_points(pose, p) for p in (some[~hidden], path)]
    return np.concatenate(parts)


def _fitted(points: Vector) -> tuple[Vector, float]:
    """Where to stand to see (n, 3) points, x right, y up, z forward, and how far away most are.

    A point lies within the page's left border if -(x - px) <= left * (z - pz), and so on: with the
    outermost points of each border that gives the position. One in a hundred may lie outside, since
    stray Gaussians would shrink all others.
    """
    x, y, z = points.T
    height = float(np.tan(FIELD_OF_VIEW_RAD / 2)) / _MARGIN
    left, right = _ASPECT * height, _ASPECT * height * (2.0 * _BESIDE_PANEL - 1.0)

    def outermost(across: Vector, slope: float) -> float:
        return float(np.quantile(across - slope * z, 0.99))

    on_the_right, on_the_left = outermost(x, right), outermost(-x, left)
    above_it, below_it = outermost(y, height), outermost(-y, height)
    back = max((on_the_right + on_the_left) / (left + right), (above_it + below_it) / (2 * height))
    back = max(back, _NEAREST_M - float(np.quantile(z, 0.01)))
    across = (on_the_right - right * back + left * back - on_the_left) / 2
    upwards = (above_it - below_it) / 2
    return np.array([across, upwards, -back]), back + float(np.median(z))


def _level(direction: Vector, up: Vector) -> Vector:
    """The unit level part of a direction; any level one where it has none."""
    level = direction - (direction @ up) * up
    if np.linalg.norm(level) < 0.1:
        level = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    return np.asarray(level / np.linalg.norm(level), np.float64)
