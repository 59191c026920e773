"""Sub-maps put into the world: their Gaussians and keyframes, moved by one transform each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magic_core.gaussians import GaussianCloud
from magic_core.gaussians.morton import in_morton_order
from magic_core.geometry import Camera
from magic_core.submap import Submap

Pose = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class PlacedSubmap:
    """A sub-map and where the pose graph put its anchor."""

    submap: Submap
    world_from_anchor: Pose  # (4, 4)


@dataclass(frozen=True, slots=True)
class View:
    """A keyframe in the world."""

    camera: Camera
    world_from_camera: Pose  # (4, 4)
    colour: NDArray[np.uint8]  # (h, w, 3) RGB
    depth: NDArray[np.float32]  # (h, w) metres, 0 = no reading


def coarse_merge(submaps: Sequence[PlacedSubmap]) -> GaussianCloud:
    """All Gaussians in the world frame, appended (the paper's coarse stage), in Morton order.

    Agents send each Gaussian once, so no intersection check is needed.
    """
    appended = GaussianCloud.concatenate(
        [placed.submap.gaussians.transformed(placed.world_from_anchor) for placed in submaps]
    )
    return in_morton_order(appended)


def views_of(submaps: Sequence[PlacedSubmap]) -> list[View]:
    """Every keyframe of every sub-map, in the world frame."""
    return [
        View(
            placed.submap.camera,
            placed.world_from_anchor @ keyframe.anchor_from_camera,
            keyframe.colour,
            keyframe.depth,
        )
        for placed in submaps
        for keyframe in placed.submap.keyframes
    ]
