"""Runs of successive vertices as single rigid bodies: a graph a fraction as large.

Annealing many straightened chains against each other needs a dozen solves, whose only outcome is
which loops fit. There a run of a few vertices may move as one body: what its shape is unsure about
goes into the covariance of the loops at its ends.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magic_server.posegraph import stacked
from magic_server.posegraph.arrays import EdgeArrays, safe_inverse
from magic_server.posegraph.chains import Chains

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Bodies:
    """Which body each of n vertices belongs to, and where it sits in it."""

    body: NDArray[np.int64]  # (n,)
    first: NDArray[np.int64]  # (b,) the vertex whose frame is the body's
    body_from_vertex: Array  # (n, 4, 4)
    odometry: EdgeArrays
    """Between bodies."""
    loops: EdgeArrays
    """All m loops between bodies; those inside one count for nothing there."""

    def held(self, anchors: dict[int, Array]) -> dict[int, Array]:
        """Poses of bodies that hold vertices still."""
        found = {}
        for vertex, pose in anchors.items():
            inverse = stacked.inverse(self.body_from_vertex[vertex][None])[0]
            found.setdefault(int(self.body[vertex]), pose @ inverse)
        return found

    def spread(self, poses: Array) -> Array:
        """Poses (n, 4, 4) of all vertices, given those (b, 4, 4) of the bodies."""
        return poses[self.body] @ self.body_from_vertex


def bodies_of(
    odometry: EdgeArrays, loops: EdgeArrays, chains: Chains, length: int
) -> Bodies | None:
    """Cut each chain into bodies of `length` vertices; None where a chain is no simple path."""
    place = chains.chain * (len(chains.chain) + 1) + chains.step
    if len(np.unique(place)) < len(place):
        return None
    _, first, body = np.unique(place - chains.step % length, return_index=True, return_inverse=True)
    offset = stacked.inverse(chains.poses[first[body]]) @ chains.poses
    variance = [
        np.abs(drift - drift[first[body]]) for drift in (chains.drift_m2, chains.drift_rad2)
    ]
    between = np.flatnonzero(body[odometry.source] != body[odometry.target])
    return Bodies(
        body=body,
        first=first,
        body_from_vertex=offset,
        odometry=_moved(odometry.select(between), body, offset, variance),
        loops=_moved(loops, body, offset, variance),
    )


def _moved(
    edges: EdgeArrays, body: NDArray[np.int64], offset: Array, variance: list[Array]
) -> EdgeArrays:
    """The edges between the bodies' frames, less certain by what bends within the bodies."""
    source, target = edges.source, edges.target
    lever_m2 = sum((offset[end][:, :3, 3] ** 2).sum(axis=1) for end in (source, target))
    bend_m2, bend_rad2 = (of[source] + of[target] for of in variance)
    added = np.stack([bend_m2 + bend_rad2 / 3.0 * lever_m2, bend_rad2], axis=1)
    covariance = safe_inverse(edges.information)
    covariance[:, range(6), range(6)] += np.repeat(added, 3, axis=1)
    # A residual at the target vertex is seen from the body's frame: the adjoint of its offset.
    to_vertex = stacked.adjoint(stacked.inverse(offset[target]))
    information = to_vertex.swapaxes(1, 2) @ np.linalg.inv(covariance) @ to_vertex
    return EdgeArrays(
        body[source],
        body[target],
        offset[source] @ edges.source_from_target @ stacked.inverse(offset[target]),
        0.5 * (information + information.swapaxes(1, 2)),
    )
