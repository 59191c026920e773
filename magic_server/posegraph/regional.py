"""A growing graph's condensed regions: made from a copy elsewhere, then kept up with the graph.

The graph numbers its loops; those that count are edges of a `Hierarchy`. To condense a whole graph
takes a while, so that it goes on in the meantime: what came since is added when the regions are
taken into use.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magic_server.posegraph.arrays import EdgeArrays
from magic_server.posegraph.hierarchy import Hierarchy

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]

CONDENSED_AT_ONCE = 64
"""Nodes of a step of condensing: some tenths of a second."""
OUTGROWN_SHARE = 0.1
"""Separators only grow; after so much more in the graph all of it is cut anew."""


@dataclass(frozen=True, slots=True)
class Outline:
    """What is to be condensed: a copy, which belongs to who asked for it."""

    poses: Array  # (n, 4, 4)
    odometry: EdgeArrays
    loops: EdgeArrays
    numbers: Numbers  # (m,) of the loops in the graph
    loop_count: int
    """How many loops the graph has, with those that do not count."""
    held: frozenset[int]

    def begin(self) -> Regions:
        """Regions that are cut but not condensed yet: call `go_on` until it says so."""
        return Regions(self)

    def condensed(self) -> Regions:
        """The regions."""
        regions = self.begin()
        while not regions.go_on():
            pass
        return regions


@dataclass(frozen=True, slots=True)
class Regional:
    """What a settlement by regions did."""

    moved: Numbers
    """Vertices whose poses changed, ascending."""
    strained: bool
    """Whether an edge is beyond its limit that was not before."""


class Regions:
    """Condensed regions of a graph at some time, and what came to it since."""

    def __init__(self, outline: Outline) -> None:
        self.held = outline.held
        """Vertices that were held when it was begun."""
        self.loop_count = outline.loop_count
        """How many loops the graph had then."""
        self._poses = outline.poses
        edges = EdgeArrays.joined([outline.odometry, outline.loops])
        self._hierarchy = Hierarchy(outline.poses, edges, outline.held)
        first, self._begun_with = len(outline.odometry), len(edges) + len(outline.poses)
        self._edge_of = {n: first + i for i, n in enumerate(outline.numbers.tolist())}
        """Of each loop that counts: its number in the hierarchy."""
        self._added = 0
        self._strained = set[int]()
        """Edges that are known to be beyond their limit."""

    def __len__(self) -> int:
        """How many vertices it knows."""
        return len(self._hierarchy)

    @property
    def count(self) -> int:
        """How many regions there are."""
        return self._hierarchy.regions

    @property
    def nbytes(self) -> int:
        """Memory of the condensed matrices."""
        return self._hierarchy.nbytes

    @property
    def cost(self) -> float:
        """Half the squared Mahalanobis norms of all edges when it last looked at poses."""
        return self._hierarchy.cost

    @property
    def loops(self) -> set[int]:
        """The loops that count here."""
        return set(self._edge_of)

    @property
    def is_outgrown(self) -> bool:
        """Whether so much came that all should be condensed anew."""
        return self._added > OUTGROWN_SHARE * self._begun_with

    def go_on(self) -> bool:
        """Condense some more; whether all is. Not again after that."""
        done = self._hierarchy.condense(self._poses, at_most=CONDENSED_AT_ONCE)
        if done:
            self._poses = self._poses[:0]
        return done

    def add_vertex(
        self, near: int | None, poses: Array, odometry: EdgeArrays, *, held: bool
    ) -> None:
        """The next vertex, and the odometry (one edge or none) that it hangs on.

        Its pose is among those of the graph (n, 4, 4); `near` is one that it is near to.
        """
        self._hierarchy.add_vertex(near, poses[len(self)], held=held)
        self._added += 1
        if len(odometry):
            self._hierarchy.add_edge(odometry)
        self._hierarchy.keep_up(poses[: len(self)])

    def count_loop(self, number: int, edge: EdgeArrays) -> None:
        """A loop that counts now."""
        self._edge_of[number] = self._hierarchy.add_edge(edge)
        self._added += 1

    def discount_loop(self, number: int) -> None:
        """A loop that no longer counts."""
        edge = self._edge_of.pop(number)
        self._hierarchy.remove_edge(edge)
        self._strained.discard(edge)

    def take_over(self, poses: Array, limit: float) -> None:
        """Poses (n, 4, 4) are new, and as good as they get without a settlement."""
        self._strained = set(self._hierarchy.taken_over(poses, limit=limit).tolist())

    def settle(self, poses: Array, limit: float, *, wholly: bool = False) -> Regional:
        """Bring poses (n, 4, 4) near the optimum, see `Hierarchy.settle`."""
        settled = self._hierarchy.settle(poses, limit=limit, wholly=wholly)
        strained = set(settled.strained.tolist()) - self._strained
        # What fitted when it was taken up may contradict what came since.
        self._strained |= strained
        return Regional(settled.moved, bool(strained))

    def put_back(self, vertices: Numbers, before: Array, poses: Array, limit: float) -> None:
        """Undo a settlement: some vertices (k,) are at (k, 4, 4) again."""
        poses[vertices] = before
        self.take_over(poses, limit)
