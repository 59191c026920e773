"""The optimum of what counts in a graph, found as a whole, and how it meets what came since.

GTSAM solves a large graph faster as a whole than regions do, but it takes seconds, in a worker.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magic_server.posegraph import stacked
from magic_server.posegraph.arrays import EdgeArrays
from magic_server.posegraph.gnc import RobustGraph

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]

ITERATIONS = 20
TOLERANCE = 1e-9


@dataclass(frozen=True, slots=True)
class CountedArrays:
    """What counts in a graph, free of doubt: cheap to hand to a job."""

    edges: EdgeArrays
    held: Numbers  # (k,) vertices that stay
    start: Array  # (n, 4, 4) where the search begins


@dataclass(frozen=True, slots=True)
class Optimum:
    """Where the edges that count want all vertices."""

    poses: Array  # (n, 4, 4)


def settled(graph: CountedArrays) -> Optimum:
    """The optimum; never worse than the start."""
    held = {vertex: graph.start[vertex] for vertex in graph.held.tolist()}
    whole = RobustGraph(graph.edges, EdgeArrays.of([], {}), held)
    found = whole.solve(graph.start, np.zeros(0), max_iterations=ITERATIONS, tolerance=TOLERANCE)
    return Optimum(found)


def carried(poses: Array, before: Array, after: Array, previous: Numbers) -> Array:
    """Poses (m, 4, 4) moved as a solve moved the graph as it was, (n, 4, 4), n <= m.

    What moved since keeps its motion. Newer vertices move with the one that they follow: `previous`
    (m,) says which that is, -1 for none.
    """
    count = len(before)
    result = poses.copy()
    result[:count] = after @ stacked.inverse(before) @ poses[:count]
    for vertex in range(count, len(poses)):
        followed = previous[vertex]
        if followed >= 0:
            motion = result[followed] @ np.linalg.inv(poses[followed])
            result[vertex] = motion @ poses[vertex]
    return stacked.straightened(result)
