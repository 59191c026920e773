"""How much each Gaussian shows, so that duplicates and hidden ones can go.

Where sub-maps of several agents overlap, the same wall exists more than once. In front-to-back
blending the layer in front takes nearly all weight and the others nearly none: a Gaussian that
shows in no keyframe is a duplicate or lies inside something, and removing it changes no image.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from magic_core.gaussians import GaussianCloud
from magic_core.render import Rasteriser
from magic_server.globalmap.placement import View


def best_contribution(
    cloud: GaussianCloud, views: Sequence[View], *, rasteriser: Rasteriser
) -> NDArray[np.float32]:
    """(n,) largest sum of blending weights, in pixels, that a Gaussian has in any view.

    The image is linear in the Gaussians' colours, and the gradient of the summed red channel by
    a Gaussian's red value is the sum of its weights.
    """
    best = np.zeros(len(cloud), np.float32)
    for view in views:
        image = rasteriser.render(cloud, view.camera, view.world_from_camera).image
        gradient = np.zeros_like(image)
        gradient[0] = 1.0
        np.maximum(best, rasteriser.backward(gradient).colours[:, 0], out=best)
    return best
