"""What each Gaussian shows, so that duplicates and hidden ones can go; what each view lacks.

Where sub-maps of several agents overlap, the same wall exists more than once. In front-to-back
blending the layer in front takes nearly all weight and the others nearly none: a Gaussian that
shows in no keyframe is a duplicate or lies inside something, and removing it changes no image.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magic_core.gaussians import GaussianCloud
from magic_core.render import Rasteriser, RenderedView
from magic_server.globalmap.placement import View


@dataclass(frozen=True, slots=True)
class Survey:
    """A cloud seen from all views."""

    best: NDArray[np.float32]
    """(n,) largest sum of blending weights, in pixels, that a Gaussian has in any view."""
    lacking: NDArray[np.int64]
    """(v,) pixels of each view that the cloud does not show."""


def survey(
    cloud: GaussianCloud,
    views: Sequence[View],
    *,
    rasteriser: Rasteriser,
    lacks: Callable[[View, RenderedView], int] | None = None,
) -> Survey:
    """Render every view once; `lacks` counts the pixels that it finds not shown.

    The image is linear in the Gaussians' colours, and the gradient of the summed red channel by
    a Gaussian's red value is the sum of its weights.
    """
    best = np.zeros(len(cloud), np.float32)
    lacking = np.zeros(len(views), np.int64)
    for number, view in enumerate(views):
        rendered = rasteriser.render(cloud, view.camera, view.world_from_camera)
        gradient = np.zeros_like(rendered.image)
        gradient[0] = 1.0
        np.maximum(best, rasteriser.backward(gradient).colours[:, 0], out=best)
        lacking[number] = 0 if lacks is None else lacks(view, rendered)
    return Survey(best, lacking)
