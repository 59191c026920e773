"""Level of detail: as many Gaussians as a browser sorts well, spread over all surfaces."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magic_core.gaussians import GaussianCloud
from magic_core.gaussians.morton import in_morton_order
from magic_core.geometry import se3

_ALPHA_SHOWN = 0.05


def thinned(cloud: GaussianCloud, keep_every: int) -> GaussianCloud:
    """Every k-th Gaussian in Morton order, larger by sqrt(k) so that surfaces stay closed.

    Those fainter than 0.05 are left out; they show nothing and cost as much as the others.
    """
    shown = cloud.select(cloud.opacities > _ALPHA_SHOWN)
    if keep_every <= 1:
        return shown
    kept = in_morton_order(shown).select(np.arange(0, len(shown), keep_every))
    flattest = kept.scales.min(axis=1, keepdims=True)
    wider = np.where(kept.scales > flattest, kept.scales * np.sqrt(keep_every), kept.scales)
    return GaussianCloud.from_arrays(
        kept.means, kept.quaternions, scales=wider, opacities=kept.opacities, colours=kept.colours
    )


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
