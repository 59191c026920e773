"""Regions and the separators between them: nested dissection of a pose graph, kept up as it grows.

A region too large is cut in two by a plane; the fewest vertices that part the halves (a minimum
vertex cover of the edges across) become the separator between them, and so on in each half. An
edge then joins vertices of one region, or of a region and a separator above it, never of two
regions side by side. A new edge that would do so moves one of its ends up into the separator.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import maximum_bipartite_matching

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]

Neighbours = Callable[[int], Iterable[int]]
"""The vertices that edges join with one."""


@dataclass(slots=True)
class Node:
    """A region (no children) or the separator between what lies below its two children."""

    parent: int
    depth: int
    own: list[int] = field(default_factory=list)
    children: tuple[int, ...] = ()
    axis: int = 0
    border: float = 0.0
    """Where the plane across `axis` cuts; what lies beyond belongs to the second child."""


class Dissection:
    """The tree of regions and separators; node 0 is the root."""

    def __init__(self, size: int) -> None:
        self._size = size
        self.nodes: list[Node] = [Node(-1, 0)]
        self.node_of: list[int] = []

    @classmethod
    def of(cls, positions: Array, source: Numbers, target: Numbers, size: int) -> Dissection:
        """Dissect a graph at positions (n, 3) with edges (m,) into regions of at most `size`."""
        tree = cls(size)
        count = len(positions)
        tree.node_of = [0] * count
        tree._cut(0, np.arange(count), positions, source, target)
        return tree

    @property
    def regions(self) -> int:
        """How many regions there are."""
        return sum(not node.children for node in self.nodes)

    def path(self, node: int) -> list[int]:
        """A node and all above it, upwards."""
        found = []
        while node >= 0:
            found.append(node)
            node = self.nodes[node].parent
        return found

    def add(self, near: int | None, position: Array) -> int:
        """A new vertex, into the region of the vertex `near` or below its separator; its node."""
        node = 0 if near is None else self.node_of[near]
        while self.nodes[node].children:
            beyond = position[self.nodes[node].axis] > self.nodes[node].border
            node = self.nodes[node].children[int(beyond)]
        self.nodes[node].own.append(len(self.node_of))
        self.node_of.append(node)
        return node

    def join(self, a: int, b: int) -> list[int]:
        """Make room for an edge between two vertices; nodes from which one was taken away.

        The newer vertex is the one that moves up into the separator.
        """
        left, right = self.node_of[a], self.node_of[b]
        above = set(self.path(left))
        common = next(node for node in self.path(right) if node in above)
        if common in (left, right):
            return []
        moving = max(a, b)
        old = self.node_of[moving]
        self.nodes[old].own.remove(moving)
        self.nodes[common].own.append(moving)
        self.node_of[moving] = common
        return self.path(old)[: self.nodes[old].depth - self.nodes[common].depth]

    def split(self, region: int, positions: Array, neighbours: Neighbours) -> bool:
        """Cut a region that has grown to twice its size; whether it was."""
        own = self.nodes[region].own
        if self.nodes[region].children or len(own) <= 2 * self._size:
            return False
        inside = set(own)
        pairs = [(v, other) for v in own for other in neighbours(v) if v < other]
        edges = np.array([p for p in pairs if p[1] in inside], dtype=np.int64).reshape(-1, 2)
        self._cut(region, np.array(own), positions, edges[:, 0], edges[:, 1])
        return True

    def _cut(
        self, node: int, vertices: Numbers, positions: Array, source: Numbers, target: Numbers
    ) -> None:
        """Make `node` the root of the dissection of some vertices and the edges among them."""
        stack = [(node, vertices, source, target)]
        side = np.zeros(len(positions), dtype=np.int8)
        while stack:
            node, vertices, source, target = stack.pop()
            if len(vertices) <= self._size:
                self._give(node, vertices)
                continue
            at = positions[vertices]
            axis = int(np.ptp(at, axis=0).argmax())
            order = vertices[np.argsort(at[:, axis], kind="stable")]
            half = len(order) // 2
            side[order[:half]], side[order[half:]] = 0, 1
            across = side[source] != side[target]
            separator = _cover(source[across], target[across], side)
            side[separator] = 2
            self._give(node, separator)
            this = self.nodes[node]
            this.axis, this.border = axis, float(positions[order[half - 1], axis])
            this.children = (len(self.nodes), len(self.nodes) + 1)
            for half_side, child in enumerate(this.children):
                self.nodes.append(Node(node, this.depth + 1))
                inside = (side[source] == half_side) & (side[target] == half_side)
                members = order[side[order] == half_side]
                stack.append((child, members, source[inside], target[inside]))

    def _give(self, node: int, vertices: Numbers) -> None:
        self.nodes[node].own = vertices.tolist()
        for vertex in self.nodes[node].own:
            self.node_of[vertex] = node


def _cover(source: Numbers, target: Numbers, side: NDArray[np.int8]) -> Numbers:
    """The fewest vertices that touch all edges between side 0 and side 1 (theorem of Koenig)."""
    low = np.where(side[source] == 0, source, target)
    high = np.where(side[source] == 0, target, source)
    left, row = np.unique(low, return_inverse=True)
    right, column = np.unique(high, return_inverse=True)
    if not len(left):
        return left
    graph = csr_matrix((np.ones(len(row)), (row, column)), shape=(len(left), len(right)))
    partner = maximum_bipartite_matching(graph, perm_type="column")
    matched_left = np.full(len(right), -1)
    matched_left[partner[partner >= 0]] = np.flatnonzero(partner >= 0)
    seen_left, seen_right = partner < 0, np.zeros(len(right), dtype=bool)
    queue: Sequence[int] = np.flatnonzero(seen_left).tolist()
    while queue:
        reached = np.unique(
            np.concatenate([graph.indices[graph.indptr[v] : graph.indptr[v + 1]] for v in queue])
        )
        reached = reached[~seen_right[reached]]
        seen_right[reached] = True
        onward = matched_left[reached]
        onward = onward[(onward >= 0) & ~seen_left[onward]]
        seen_left[onward] = True
        queue = onward.tolist()
    return np.sort(np.concatenate([left[~seen_left], right[seen_right]]))
