"""Level of detail: as many Gaussians as a browser sorts well, spread over all surfaces."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magic_core.gaussians import GaussianCloud
from magic_core.gaussians.reduction import reduced
from magic_core.geometry import se3

_ALPHA_SHOWN = 0.05


def thinned(cloud: GaussianCloud, keep_every: int) -> GaussianCloud:
    """A k-th as many Gaussians that show the same: neighbours that are alike are merged.

    Those fainter than 0.05 are left out; they show nothing and cost as much as the others.
    """
    shown = cloud.select(cloud.opacities > _ALPHA_SHOWN)
    return reduced(shown, max(-(-len(shown) // keep_every), 1))


def keep_every(total: int, limit: int) -> int:
    """The power of two by which `total` Gaussians are thinned to at most `limit`."""
    step = 1
    while total > limit * step:
        step *= 2
    return step


def covariances(cloud: GaussianCloud) -> NDArray[np.float32]:
    """(n, 3, 3) covariance matrices, m^2."""
    axes = se3.rotation_from_quaternion(cloud.quaternions) * cloud.scales[:, None, :]
    return np.asarray(axes @ axes.transpose(0, 2, 1), np.float32)
