"""Gradients do not depend on how threads share the tiles."""

from __future__ import annotations

import numpy as np

from magic_core.gaussians import GaussianCloud
from magic_core.geometry import Camera
from magic_core.render import Rasteriser


def test_gradients_are_equal_for_one_and_for_several_threads_every_time():
    # No tile is opaque and no pair is dropped, so that the lists of neighbouring tiles touch: a
    # thread that writes past its own tile spoils another's.
    rng = np.random.default_rng(0)
    camera = Camera(width=96, height=72, fx=84.0, fy=84.0, cx=47.5, cy=35.5)
    n = 4000
    depth = rng.uniform(1.0, 4.0, n)
    pixels = rng.uniform([-0.5, -0.5], [95.5, 71.5], (n, 2))
    means = np.stack(
        [(pixels[:, 0] - 47.5) / 84 * depth, (pixels[:, 1] - 35.5) / 84 * depth, depth], axis=1
    )
    cloud = GaussianCloud.from_arrays(
        means,
        np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
        scales=np.repeat(0.01 * depth[:, None], 3, axis=1),
        opacities=np.full(n, 0.3),
        colours=rng.uniform(0, 1, (n, 3)),
    )
    gradient = rng.normal(size=(5, 72, 96)).astype(np.float32)
    single, several = Rasteriser(1), Rasteriser(3)
    single.render(cloud, camera, np.eye(4))
    expected = single.backward(gradient)
    for _ in range(150):
        several.render(cloud, camera, np.eye(4))
        found = several.backward(gradient)
        assert np.array_equal(found.means, expected.means)
        assert np.array_equal(found.colours, expected.colours)
