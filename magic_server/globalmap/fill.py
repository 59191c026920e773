"""Gaussians for what the keyframes saw but the appended sub-maps do not show.

Two sources. Measured surface: pixels with a depth reading where the map is transparent. Unmeasured
surface: pixels with colour alone (beyond the depth sensor's frame, dark, shiny or distant things),
which are put on the plane of the nearest reading. A guess of the second kind is kept only when no
other keyframe saw through the place where it would stand.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core.gaussians import GaussianCloud
from magic_core.gaussians.seeding import BlockRule, SeedShape, pixels_in_need, seed_adaptive
from magic_core.gaussians.surface import Surface, surface_of
from magic_core.geometry import Camera, se3
from magic_core.render import RenderedView
from magic_core.render.backend import Optimiser
from magic_server.globalmap.placement import View

Mask = NDArray[np.bool_]

_DEPTH_ERROR_SHARE = 0.1  # of the depth: less than that is what optimising is for
_SEEN_THROUGH_SHARE = 0.05
_MAX_EXTRAPOLATION = 2.0
_WORTH_FILLING = 0.002  # of a view's pixels: fewer are left as they are


@dataclass(frozen=True, slots=True)
class FillRule:
    """What is filled."""

    measured: bool
    """Surface with a depth reading."""
    unmeasured: bool
    """Surface of which only the colour is known."""
    alpha_threshold: float
    """Rendered alpha below which a pixel counts as not shown."""
    limit: int
    """Most Gaussians of the map."""

    def needs(self, view: View, rendered: RenderedView) -> tuple[Mask, Mask]:
        """The pixels (h, w) to fill with measured, and with continued surface."""
        measured = unmeasured = np.zeros(view.depth.shape, dtype=bool)
        if self.measured:
            measured = pixels_in_need(
                rendered.alpha,
                rendered.expected_depth,
                view.depth,
                alpha_threshold=self.alpha_threshold,
                depth_error_factor=40.0,
                depth_floor=_DEPTH_ERROR_SHARE,
            )
            measured = _without_specks(measured)
        if self.unmeasured and (view.depth > 0).any():
            unmeasured = (view.depth <= 0) & (rendered.alpha < self.alpha_threshold)
        return measured, unmeasured

    def lacks(self, view: View, rendered: RenderedView) -> int:
        """How many pixels of a view are to be filled."""
        return sum(int(np.count_nonzero(mask)) for mask in self.needs(view, rendered))


def _without_specks(mask: Mask) -> Mask:
    """The mask without what is narrower than three pixels: optimising closes that by itself."""
    square = np.ones((3, 3), np.uint8)
    return cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, square).astype(bool)


def fill_holes(
    optimiser: Optimiser, views: Sequence[View], lacking: NDArray[np.int64], *, rule: FillRule
) -> int:
    """Seed where views see what the map does not show; returns how many.

    `lacking` (v,) says how many pixels of each view that is; views with hardly any are left out.
    """
    before = len(optimiser)
    least = [_WORTH_FILLING * view.depth.size for view in views]
    for index in np.flatnonzero(lacking > least).tolist():
        view = views[index]
        rendered = optimiser.render(view.camera, view.world_from_camera)
        measured, unmeasured = rule.needs(view, rendered)
        if measured.any():
            surface = surface_of(view.depth, view.camera)
            _extend(optimiser, view, measured, surface, limit=rule.limit)
        if unmeasured.sum() > least[index]:
            completed = replace(view, depth=completed_depth(view, rendered))
            surface = surface_of(completed.depth, view.camera)
            others = [other for i, other in enumerate(views) if i != index]
            _extend(optimiser, completed, unmeasured, surface, limit=rule.limit, veto=others)
    return len(optimiser) - before


def completed_depth(view: View, rendered: RenderedView) -> NDArray[np.float32]:
    """The view's depth with its gaps closed: by the map where it shows anything, else by planes.

    Each remaining pixel lies on the tangent plane of its nearest known pixel, within a factor of
    two of that pixel's depth.
    """
    known = np.where(
        (view.depth <= 0) & (rendered.alpha > 0.5), rendered.expected_depth, view.depth
    ).astype(np.float32)
    surface = surface_of(known, view.camera)
    solid = surface.reliable & (np.abs(surface.normals).sum(axis=-1) > 0)
    # Normals at the rim of the known are one-sided: take planes from a few pixels further in.
    solid = cv2.erode(solid.astype(np.uint8), np.ones((7, 7), np.uint8)).astype(bool)
    if not solid.any():
        return known
    nearest = _nearest_pixel(solid)
    rays = view.camera.rays().reshape(-1, 3)
    normals = surface.normals.reshape(-1, 3)[nearest]
    points = view.camera.back_project(known).reshape(-1, 3)[nearest]
    facing = (normals * rays).sum(axis=-1)
    plane = (normals * points).sum(axis=-1) / np.where(np.abs(facing) < 1e-3, 1e-3, facing)
    near = points[:, 2]
    plane = np.clip(plane, near / _MAX_EXTRAPOLATION, near * _MAX_EXTRAPOLATION)
    plane = np.where(np.abs(facing) < 0.1, near, plane).reshape(known.shape)
    return np.where(known > 0, known, plane).astype(np.float32)


def _nearest_pixel(solid: NDArray[np.bool_]) -> NDArray[np.int64]:
    """For each pixel, flat, the flat index of its nearest solid pixel."""
    _, labels = cv2.distanceTransformWithLabels(
        (~solid).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    labels = np.asarray(labels, dtype=np.int64)
    index_of_label = np.zeros(int(labels.max()) + 1, np.int64)
    index_of_label[labels[solid]] = np.flatnonzero(solid)
    return index_of_label[labels.reshape(-1)]


def seen_through(means_world: NDArray[np.float32], views: Sequence[View]) -> NDArray[np.bool_]:
    """(n,) whether any view measured surface clearly behind a point, so that it must be empty."""
    result = np.zeros(len(means_world), dtype=bool)
    for view in views:
        points = se3.transform_points(se3.inverse(view.world_from_camera), means_world)
        measured = _depth_at(view.depth, view.camera, points)
        result |= (measured > 0) & (measured > points[:, 2] * (1.0 + _SEEN_THROUGH_SHARE))
    return result


def _depth_at(
    depth: NDArray[np.float32], camera: Camera, points_camera: NDArray[np.float64]
) -> NDArray[np.float32]:
    """The reading (n,) at each point's pixel; 0 outside the image and behind the camera."""
    pixels, z = camera.project(points_camera)
    column, row = np.rint(np.clip(pixels, -1e6, 1e6)).astype(np.int64).T
    inside = (z > 0) & (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
    result = np.zeros(len(z), np.float32)
    result[inside] = depth[row[inside], column[inside]]
    return result


def _extend(
    optimiser: Optimiser,
    view: View,
    need: NDArray[np.bool_],
    surface: Surface,
    *,
    limit: int,
    veto: Sequence[View] = (),
) -> None:
    room = limit - len(optimiser)
    if room <= 0 or not need.any():
        return
    seeds: GaussianCloud = seed_adaptive(
        view.colour,
        view.depth,
        view.camera,
        surface=surface,
        need=need,
        rule=BlockRule(),
        shape=SeedShape(),
        limit=room,
    ).transformed(view.world_from_camera)
    if veto:
        seeds = seeds.select(~seen_through(seeds.means, veto))
    if len(seeds):
        optimiser.extend(seeds)
