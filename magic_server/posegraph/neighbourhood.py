"""A bounded part of a pose graph around a new loop, and its adjustment with the rest held still."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Sequence

import numpy as np
from numpy.typing import NDArray

from magic_server.posegraph.arrays import EdgeArrays
from magic_server.posegraph.gnc import RobustGraph

Array = NDArray[np.float64]

SIZE = 24
"""So many vertices may move. A loop's effect fades with distance; the solve of the whole graph that
follows sees to the rest."""
ITERATIONS = 5
TOLERANCE = 1e-5


class Adjacency:
    """Which edges meet at each vertex: all odometry, and the loops that count."""

    def __init__(self) -> None:
        self._odometry: list[list[tuple[int, int]]] = []
        self._loops: list[list[tuple[int, int]]] = []

    def add_vertex(self) -> None:
        """One more vertex, without edges."""
        self._odometry.append([])
        self._loops.append([])

    def add_odometry(self, edge: int, source: int, target: int) -> None:
        """An odometry edge by its number."""
        self._odometry[source].append((target, edge))
        self._odometry[target].append((source, edge))

    def add_loop(self, loop: int, source: int, target: int) -> None:
        """A loop by its number."""
        self._loops[source].append((target, loop))
        self._loops[target].append((source, loop))

    def remove_loop(self, loop: int, source: int, target: int) -> None:
        """A loop that no longer counts."""
        self._loops[source].remove((target, loop))
        self._loops[target].remove((source, loop))

    def around(self, ends: Sequence[int]) -> list[int]:
        """The vertices nearest to the ends in steps, ascending, at most SIZE of them."""
        found, queue = set(ends), deque(ends)
        while queue and len(found) < SIZE:
            vertex = queue.popleft()
            for other, _ in (*self._odometry[vertex], *self._loops[vertex]):
                if other not in found and len(found) < SIZE:
                    found.add(other)
                    queue.append(other)
        return sorted(found)

    def edges_of(self, vertices: Sequence[int]) -> tuple[list[int], list[int]]:
        """Numbers of the odometry edges and of the loops that touch any of some vertices."""
        odometry = {edge for vertex in vertices for _, edge in self._odometry[vertex]}
        loops = {loop for vertex in vertices for _, loop in self._loops[vertex]}
        return sorted(odometry), sorted(loops)


def adjusted(
    inside: Sequence[int],
    odometry: EdgeArrays,
    loops: EdgeArrays,
    poses: Array,
    *,
    fixed: Collection[int],
    limit: float,
) -> Array | None:
    """Poses (k, 4, 4) of the vertices `inside` with these edges; None where an edge contradicts.

    `poses` (n, 4, 4) are those of the whole graph; vertices that the edges reach beyond `inside`,
    and those in `fixed`, hold still. An edge contradicts when its squared Mahalanobis norm at the
    result reaches `limit`.
    """
    reached = np.concatenate([odometry.source, odometry.target, loops.source, loops.target])
    touched = np.union1d(reached, np.array(inside, dtype=np.int64))
    new_number = dict(zip(touched.tolist(), range(len(touched)), strict=True))
    free = set(inside) - set(fixed)
    start = poses[touched]
    anchors = {new: start[new] for old, new in new_number.items() if old not in free}
    lookup = np.zeros(len(poses), dtype=np.int64)
    lookup[touched] = np.arange(len(touched))
    graph = RobustGraph(odometry.renumbered(lookup), loops.renumbered(lookup), anchors)
    ones = np.ones(len(loops))
    found = graph.solve(start, ones, max_iterations=ITERATIONS, tolerance=TOLERANCE)
    for edges in (graph.odometry, graph.loops):
        if (edges.squared_norms(found) >= limit).any():
            return None
    return found[[new_number[vertex] for vertex in inside]]
