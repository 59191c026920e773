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
_BACK_OFF = 2.1
_BESIDE_PANEL = 0.3
_EVERY_MEAN = 16


def up_of(view: SessionView, anchors: dict[str, Pose]) -> Vector:
    """Unit (3,) up of a session's picture, from the cameras, which people hold level."""
    return up_direction(np.concatenate([anchors[n] @ view.submaps[n].path for n in anchors]))


def above(points: NDArray, cameras: NDArray, up: Vector) -> NDArray[np.bool_]:
    """(n,) which of (n, 3) points hang above the nearest of (k, 3) cameras; all in one frame."""
    from scipy.spatial import KDTree

    _, nearest = KDTree(cameras).query(points, workers=1)
    return (points - cameras[nearest]) @ up > _ABOVE_M


def outside(view: SessionView, anchors: dict[str, Pose]) -> tuple[Vector, Vector, Vector]:
    """(position, look_at, up) of a view that holds the map and the agents, from above.

    It looks the way the agents looked on average, as far as that is level.
    """
    up = up_of(view, anchors)
    points = np.concatenate(
        [
            part
            for name, pose in anchors.items()
            for part in (
                se3.transform_points(pose, view.submaps[name].cloud.means[::_EVERY_MEAN]),
                (pose @ view.submaps[name].path)[:, :3, 3],
            )
        ]
    )
    centre = np.median(points, axis=0)
    reach = max(1.0, float(np.quantile(np.linalg.norm(points - centre, axis=1), 0.9)))
    ahead = _level(np.stack([pose[:3, 2] for pose in anchors.values()]).mean(axis=0), up)
    away = np.sin(_ELEVATION_RAD) * up - np.cos(_ELEVATION_RAD) * ahead
    # The panel covers the right of the page, so the map is put to the left of its middle.
    target = centre + _BESIDE_PANEL * reach * np.cross(ahead, up)
    return target + _BACK_OFF * reach * away, target, up


def _level(direction: Vector, up: Vector) -> Vector:
    """The unit level part of a direction; any level one where it has none."""
    level = direction - (direction @ up) * up
    if np.linalg.norm(level) < 0.1:
        level = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    return np.asarray(level / np.linalg.norm(level), np.float64)
