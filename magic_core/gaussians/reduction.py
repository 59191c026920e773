"""Fewer Gaussians that still show the whole picture: neighbours that are alike become one.

Leaving out the least important half of a map tears holes into every surface. Here two neighbours
are replaced by the Gaussian with their moments (mean, covariance, mean colour) and as much opacity
times area as both, wider where it would be more than opaque. The cheapest pairs go first, what is
not merged stays bit for bit. The measure of "cheap" is Ward's: how far colour and place of a pair
are from their mean, weighted by what shows.
Figures are in benchmarks/results/global-map.md.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from magic_core.gaussians.cloud import GaussianCloud
from magic_core.gaussians.morton import BITS, morton_codes
from magic_core.geometry import se3

Float64 = NDArray[np.float64]

_COLOUR_DISTANCE_M = 0.2
"""Metres between two Gaussians that matter as much as black beside white in one channel."""
_MOST_PER_ROUND = 0.25  # of all Gaussians that are merged away before neighbours are looked up anew
_LEAST_PER_ROUND = 0.0625  # of all pairs, so that no cloud takes a round for each Gaussian
_MAX_OPACITY = 0.999
_MOST_SURPLUS = 2.0  # two opaque Gaussians in one place
_MIN_SCALE_M, _MAX_SCALE_M = 1e-9, float(np.finfo(np.float32).max)
_LEAST_WEIGHT = 1e-30  # of what shows nothing, so that a mean of two such is one all the same


def reduced(cloud: GaussianCloud, count: int) -> GaussianCloud:
    """At most `count` (1 or more) Gaussians in the same frame, exactly so many of a larger cloud.

    Those of a larger cloud come in Morton order. Deterministic.
    """
    if len(cloud) <= count:
        return cloud
    moments = _Moments.of(cloud)
    while (excess := len(moments.weights) - count) > 0:
        moments = _with_pairs_merged(_in_order(moments), excess)
    return _in_order(moments).cloud(cloud)


@dataclass(frozen=True, slots=True)
class _Moments:
    """Gaussians by what is preserved when two become one."""

    origins: NDArray[np.int64]
    """(n,) index in the cloud of one that was not merged, else -1."""
    means: Float64  # (n, 3) metres
    covariances: Float64  # (n, 3, 3) metres^2
    colours: Float64  # (n, 3)
    weights: Float64
    """(n,) opacity times area, metres^2."""

    @classmethod
    def of(cls, cloud: GaussianCloud) -> _Moments:
        rotations = se3.rotation_from_quaternion(cloud.quaternions.astype(np.float64))
        variances = cloud.scales.astype(np.float64) ** 2
        covariances = np.einsum("nij,nj,nkj->nik", rotations, variances, rotations)
        weights = cloud.opacities * _areas(variances)
        return cls(
            np.arange(len(cloud)),
            cloud.means.astype(np.float64),
            covariances,
            cloud.colours.astype(np.float64),
            np.maximum(weights, _LEAST_WEIGHT),
        )

    def select(self, index: NDArray) -> _Moments:
        return _Moments(*(getattr(self, field.name)[index] for field in fields(self)))

    def followed_by(self, other: _Moments) -> _Moments:
        names = [field.name for field in fields(self)]
        return _Moments(*(np.concatenate([getattr(self, n), getattr(other, n)]) for n in names))

    def cloud(self, original: GaussianCloud) -> GaussianCloud:
        """As Gaussians; those that were not merged are taken from the original."""
        merged = np.flatnonzero(self.origins < 0)
        found = original.select(np.maximum(self.origins, 0))
        columns = _gaussians(self.select(merged)).arrays()
        for column, new in zip(found.arrays(), columns, strict=True):
            column[merged] = new
        return found


def _in_order(moments: _Moments) -> _Moments:
    """Along a Morton curve, on which most neighbours in space are neighbours."""
    low = moments.means.min(axis=0)
    span = max(float((moments.means.max(axis=0) - low).max()), 1e-12)
    grid = np.rint((moments.means - low) / span * (2**BITS - 1)).astype(np.int64)
    return moments.select(np.argsort(morton_codes(grid), kind="stable"))


def _with_pairs_merged(moments: _Moments, excess: int) -> _Moments:
    """The cheapest pairs of neighbours merged, `excess` at most and at least one."""
    cost = _costs(moments)
    # A pair that costs less than those which share a Gaussian with it: no two pairs overlap.
    before, after = np.append(np.inf, cost[:-1]), np.append(cost[1:], np.inf)
    pairs = np.flatnonzero((cost <= before) & (cost < after))
    most = min(excess, max(1, int(_MOST_PER_ROUND * len(moments.weights))))
    if len(pairs) < min(most, _LEAST_PER_ROUND * len(cost)):
        # Costs that are equal, or grow along the curve, have hardly such pairs: every other one.
        pairs = np.arange(0, len(cost), 2)
    chosen = pairs[np.argsort(cost[pairs], kind="stable")[:most]]
    alone = np.ones(len(moments.weights), dtype=bool)
    alone[chosen] = alone[chosen + 1] = False
    return moments.select(alone).followed_by(
        _merged(moments.select(chosen), moments.select(chosen + 1))
    )


def _costs(moments: _Moments) -> Float64:
    """(n - 1,) Ward's cost of merging each with the next."""
    first, second = moments.weights[:-1], moments.weights[1:]
    apart = (np.diff(moments.means, axis=0) ** 2).sum(axis=1) / _COLOUR_DISTANCE_M**2
    unlike = (np.diff(moments.colours, axis=0) ** 2).sum(axis=1)
    return first * (second / (first + second)) * (apart + unlike)


def _merged(first: _Moments, second: _Moments) -> _Moments:
    """Each pair as one."""
    together = first.weights + second.weights
    share = second.weights / together
    apart = second.means - first.means
    column, block = share[:, None], share[:, None, None]
    spread = (share * (1.0 - share))[:, None, None] * (apart[:, :, None] * apart[:, None, :])
    covariances = first.covariances + block * (second.covariances - first.covariances) + spread
    variances = np.asarray(np.linalg.eigvalsh(covariances), np.float64)
    opaque = np.maximum(_MAX_OPACITY * _areas(variances), _LEAST_WEIGHT)
    # What is more than opaque lay one behind the other, or side by side: half of it is taken as
    # each, so that surfaces close. Widening by all or none of it shows less.
    wider = np.sqrt(np.clip(together / opaque, 1.0, _MOST_SURPLUS))
    return _Moments(
        np.full(len(share), -1),
        first.means + column * apart,
        wider[:, None, None] * covariances,
        first.colours + column * (second.colours - first.colours),
        np.maximum(np.minimum(together, wider * opaque), _LEAST_WEIGHT),
    )


def _gaussians(moments: _Moments) -> GaussianCloud:
    from scipy.spatial.transform import Rotation

    if not len(moments.weights):
        return GaussianCloud.empty()
    variances, axes = np.linalg.eigh(moments.covariances)
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]  # a rotation, no mirror
    areas = np.maximum(_areas(variances), _LEAST_WEIGHT)
    return GaussianCloud.from_arrays(
        moments.means,
        Rotation.from_matrix(axes).as_quat(scalar_first=True),
        scales=np.clip(np.sqrt(np.maximum(variances, 0.0)), _MIN_SCALE_M, _MAX_SCALE_M),
        opacities=np.minimum(moments.weights / areas, _MAX_OPACITY),
        colours=moments.colours,
    )


def _areas(variances: Float64) -> Float64:
    """(n,) product of the two largest standard deviations of (n, 3) variances, metres^2."""
    ordered = np.sort(np.maximum(variances, 0.0), axis=1)
    return np.sqrt(ordered[:, 1] * ordered[:, 2])
