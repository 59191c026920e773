"""Seeding as the mapping settings ask for it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from magic_agent.mapping.config import MappingConfig
from magic_agent.mapping.holes import filled
from magic_core.data import Frame
from magic_core.gaussians import GaussianCloud
from magic_core.gaussians.seeding import (
    BlockRule,
    SeedShape,
    pixels_in_need,
    seed_adaptive,
    seed_uniform,
)
from magic_core.gaussians.surface import surface_of
from magic_core.geometry import Camera
from magic_core.render import RenderedView

_NOISE_SHARE = 0.03
"""Depth errors below this share of the depth are the sensor's and seed nothing (adaptive)."""


class Seeder:
    """Finds the pixels of a frame that need Gaussians and makes them, in the camera frame."""

    def __init__(self, camera: Camera, config: MappingConfig, rng: np.random.Generator) -> None:
        self._camera = camera
        self._config = config
        self._rng = rng
        self._rule = BlockRule(colour_deviation=config.seed_colour_deviation)
        self._shape = SeedShape(spread=config.seed_spread, opacity=config.seed_opacity)

    def need(self, frame: Frame, view: RenderedView) -> NDArray[np.bool_]:
        """(h, w) pixels that the sub-map does not explain."""
        adaptive = self._config.seeding == "adaptive"
        need = pixels_in_need(
            view.alpha,
            view.expected_depth,
            frame.depth,
            alpha_threshold=self._config.alpha_threshold,
            depth_error_factor=self._config.depth_error_factor,
            depth_floor=_NOISE_SHARE if adaptive else 0.0,
        )
        return need

    def without_flying_pixels(self, frame: Frame) -> Frame:
        """The frame as optimisation compares with it: readings that float over an edge removed."""
        if self._config.seeding == "uniform":  # the paper believes every reading
            return frame
        reliable = surface_of(frame.depth, self._camera).reliable
        return replace(frame, depth=np.where(reliable, frame.depth, np.float32(0.0)))

    def seeds(
        self,
        frame: Frame,
        view: RenderedView | None,
        *,
        limit: int,
        existing: NDArray[np.float32],
    ) -> GaussianCloud:
        """New Gaussians, at most `limit`; a view of None means that the sub-map is empty."""
        need = frame.depth > 0 if view is None else self.need(frame, view)
        depth = frame.depth
        if self._config.fill_holes:
            unseen = True if view is None else view.alpha < self._config.alpha_threshold
            need, depth = need | ((depth <= 0) & unseen), filled(depth)
        limit = min(limit, self._config.seeds_per_keyframe)
        if not need.any():
            return GaussianCloud.empty()
        if self._config.seeding == "uniform":
            return seed_uniform(
                frame.colour,
                frame.depth,
                self._camera,
                need=need,
                count=limit,
                existing=existing,
                rng=self._rng,
                opacity=self._config.seed_opacity,
            )
        return seed_adaptive(
            frame.colour,
            depth,
            self._camera,
            surface=surface_of(depth, self._camera),
            need=need,
            rule=self._rule,
            shape=self._shape,
            limit=limit,
        )
