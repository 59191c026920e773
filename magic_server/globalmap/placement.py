"""Sub-maps put into the world: their Gaussians and keyframes, moved by one transform each."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from magic_core.gaussians import GaussianCloud
from magic_core.gaussians.morton import in_morton_order
from magic_core.geometry import Camera
from magic_core.submap import Submap

Pose = NDArray[np.float64]
Window = tuple[int, int, int, int]
"""Part of an image in pixels: left, top, right and bottom, these two exclusive."""


class PlacedSource(Protocol):
    """A sub-map and where the pose graph put it; its parts are read when they are asked for.

    A merge holds what one block needs and asks again for the next: a map may be larger than memory.
    """

    @property
    def world_from_anchor(self) -> Pose: ...
    @property
    def camera(self) -> Camera: ...
    def gaussians(self) -> GaussianCloud:
        """The Gaussians, in the anchor frame."""
        ...

    def keyframe_poses(self) -> list[Pose]:
        """anchor_from_camera (4, 4) of every keyframe."""
        ...

    def images(self, keyframe: int) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Colour (h, w, 3) and depth (h, w) in metres of one keyframe."""
        ...


@dataclass(frozen=True, slots=True)
class PlacedSubmap:
    """A sub-map in memory and where the pose graph put its anchor."""

    submap: Submap
    world_from_anchor: Pose  # (4, 4)

    @property
    def camera(self) -> Camera:
        """The camera of all its keyframes."""
        return self.submap.camera

    def gaussians(self) -> GaussianCloud:
        """The Gaussians, in the anchor frame."""
        return self.submap.gaussians

    def keyframe_poses(self) -> list[Pose]:
        """anchor_from_camera (4, 4) of every keyframe."""
        return [keyframe.anchor_from_camera for keyframe in self.submap.keyframes]

    def images(self, keyframe: int) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Colour (h, w, 3) and depth (h, w) in metres of one keyframe."""
        chosen = self.submap.keyframes[keyframe]
        return chosen.colour, chosen.depth


@dataclass(frozen=True, slots=True)
class View:
    """A keyframe in the world."""

    camera: Camera
    world_from_camera: Pose  # (4, 4)
    colour: NDArray[np.uint8]  # (h, w, 3) RGB
    depth: NDArray[np.float32]  # (h, w) metres, 0 = no reading
    share: float = 1.0  # of the keyframe's image that this is

    def part(self, window: Window) -> View:
        """A part of it, as a camera with that part for its image sees it."""
        left, top, right, bottom = window
        camera = self.camera
        seen = dataclasses.replace(
            camera, width=right - left, height=bottom - top, cx=camera.cx - left, cy=camera.cy - top
        )
        return View(  # copies, which do not hold the rest
            seen,
            self.world_from_camera,
            self.colour[top:bottom, left:right].copy(),
            self.depth[top:bottom, left:right].copy(),
            self.share * seen.width * seen.height / (camera.width * camera.height),
        )


def placed_gaussians(source: PlacedSource) -> GaussianCloud:
    """A sub-map's Gaussians in the world frame."""
    return source.gaussians().transformed(source.world_from_anchor)


def coarse_merge(sources: Sequence[PlacedSource]) -> GaussianCloud:
    """All Gaussians in the world frame, appended (the paper's coarse stage), in Morton order.

    Agents send each Gaussian once, so no intersection check is needed.
    """
    return in_morton_order(
        GaussianCloud.concatenate([placed_gaussians(source) for source in sources])
    )


def view_of(source: PlacedSource, keyframe: int) -> View:
    """One keyframe, in the world frame."""
    pose = source.world_from_anchor @ source.keyframe_poses()[keyframe]
    return View(source.camera, pose, *source.images(keyframe))


def views_of(sources: Sequence[PlacedSource]) -> list[View]:
    """Every keyframe of every sub-map, in the world frame."""
    return [
        view_of(source, keyframe)
        for source in sources
        for keyframe in range(len(source.keyframe_poses()))
    ]
