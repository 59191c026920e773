"""Odometry across deleted sub-maps: what was tracked stays known when images and Gaussians go."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from magic_core.geometry import se3
from magic_core.submap import OdometryEdge
from magic_core.wire import names
from magic_server.store import GraphVertex, RemovedSubmap

Array = NDArray[np.float64]


def joined(first: OdometryEdge, second: OdometryEdge) -> OdometryEdge:
    """Two edges one after the other: a_from_b, then b_from_c, make a_from_c.

    Perturbed on the right, a_from_b exp(x) b_from_c exp(y) is a_from_c exp(Ad(c_from_b) x) exp(y):
    the covariances add up in c's frame.
    """
    carried = se3.adjoint(se3.inverse(second.previous_from_anchor))
    covariance = carried @ np.linalg.inv(first.information) @ carried.T
    covariance += np.linalg.inv(second.information)
    information = np.linalg.inv(covariance)
    return OdometryEdge(
        previous_index=first.previous_index,
        previous_from_anchor=first.previous_from_anchor @ second.previous_from_anchor,
        information=0.5 * (information + information.T),
    )


def bridged(
    vertex: GraphVertex, removed: Mapping[str, RemovedSubmap]
) -> tuple[OdometryEdge | None, Array | None]:
    """A sub-map's odometry edge to the nearest stored one before it, and its known start.

    Where the deleted ones before it began their chain, it begins the chain now, and takes over a
    known start that they had.
    """
    session, agent, _ = names.parse_submap(vertex.name)
    edge, prior = vertex.odometry, vertex.prior
    while edge is not None:
        gone = removed.get(names.submap_name(session, agent, edge.previous_index))
        if gone is None:
            break
        if prior is None and gone.prior is not None:
            prior = gone.prior @ edge.previous_from_anchor
        edge = None if gone.odometry is None else joined(gone.odometry, edge)
    return edge, prior
