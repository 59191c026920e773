"""How blocks that were refined apart agree on the Gaussians near their borders.

A block's keyframes show Gaussians of its neighbours, which it refines along with its own: what is
refined beside something that is then thrown away fits nothing else, and the border shows. So a
block hands over what it made of its neighbours' Gaussians near itself, and each becomes the mean of
what its own block and these guests' blocks made of it (local SGD: Stich, ICLR 2019; for blocks of
a map: Chen and Lee, DOGS, NeurIPS 2024). All began at the same values, so that means make sense.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magic_core.errors import CorruptData
from magic_core.gaussians import GaussianCloud, codec
from magic_server.globalmap.blocks import Block

_FEATHER_M = 0.3
"""How far from a block its word counts, falling from one at the border to nothing."""
# Of a scale, an opacity and its distance from one, as the optimiser's; and of a change of opacity:
# what was not drawn is as it was but for the way into logits and back.
_LEAST = 1e-6


@dataclass(frozen=True, slots=True)
class Guests:
    """What a block made of Gaussians that are another's."""

    owner: int
    """Number of the block that they belong to."""
    places: NDArray[np.int64]
    """(n,) their indices among the owner's."""
    weights: NDArray[np.float32]
    """(n,) more than 0, at most 1: how much the block's word counts; the owner's counts 1."""
    cloud: GaussianCloud


def guests_of(
    block: Block, before: GaussianCloud, after: GaussianCloud, *, owner: int, places: NDArray
) -> Guests:
    """What is handed over: those near enough that the block's keyframes showed at all.

    `before` and `after` hold the owner's Gaussians at `places`, in that order.
    """
    outside = np.maximum(np.maximum(block.low - before.means, before.means - block.high), 0.0)
    weights = 1.0 - np.linalg.norm(outside, axis=1) / _FEATHER_M
    fading = np.abs(before.opacities - after.opacities)
    shown = (fading > _LEAST) | (before.means != after.means).any(axis=1)
    chosen = shown & (weights > 0.0)
    return Guests(
        owner,
        np.asarray(places, np.int64)[chosen],
        weights[chosen].astype(np.float32),
        after.select(chosen),
    )


def agreed(own: GaussianCloud, guests: Iterable[Guests]) -> GaussianCloud:
    """A block's Gaussians as it and those who showed them agree, in their order.

    Means are weighted, and taken of the values that are optimised: logarithms of scales, logits of
    opacities, quaternions of one sign.
    """
    sums = [part.astype(np.float64) for part in _optimised(own)]
    total = np.ones(len(own))
    for guest in guests:
        parts = _optimised(guest.cloud)
        opposite = (parts[1] * own.quaternions[guest.places]).sum(axis=1) < 0.0
        parts[1] = np.where(opposite[:, None], -parts[1], parts[1])
        for mean, part in zip(sums, parts, strict=True):
            mean[guest.places] += guest.weights[:, None] * part
        total[guest.places] += guest.weights
    means, quaternions, scales, opacities, colours = (part / total[:, None] for part in sums)
    return GaussianCloud.from_arrays(
        means,
        quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True),
        scales=np.exp(scales),
        opacities=1.0 / (1.0 + np.exp(-opacities[:, 0])),
        colours=colours,
    )


def _optimised(cloud: GaussianCloud) -> list[NDArray]:
    """The five parts, each (n, k), in the values that are optimised."""
    opacities = np.clip(cloud.opacities.astype(np.float64), _LEAST, 1.0 - _LEAST)[:, None]
    return [
        cloud.means,
        cloud.quaternions,
        np.log(np.maximum(cloud.scales, _LEAST)),
        np.log(opacities / (1.0 - opacities)),
        cloud.colours,
    ]


def encode(guests: Iterable[Guests]) -> bytes:
    """All that a block hands over, as bytes."""
    arrays: dict[str, NDArray] = {}
    for guest in guests:
        arrays[f"{guest.owner}/places"] = guest.places
        arrays[f"{guest.owner}/weights"] = guest.weights
        lossless = codec.encode_lossless(guest.cloud)
        arrays[f"{guest.owner}/cloud"] = np.frombuffer(lossless, np.uint8)
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue()


def decode(data: bytes, *, owners: Iterable[int]) -> list[Guests]:
    """What `encode` wrote of the Gaussians of some blocks. Raises CorruptData on anything else."""
    found = []
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
            for owner in owners:
                if f"{owner}/places" in arrays:
                    cloud = codec.decode(arrays[f"{owner}/cloud"].tobytes())
                    places, weights = arrays[f"{owner}/places"], arrays[f"{owner}/weights"]
                    found.append(Guests(owner, places, weights, cloud))
    except (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise CorruptData(f"a file of refined Gaussians is damaged: {error}") from error
    return found
