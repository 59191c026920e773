"""A pose graph of any size, kept at its optimum as it grows: what is new costs its neighbourhood.

Regions of the graph are condensed onto the separators between them, these onto the separators above
them, and so on (`Dissection`, `Fronts`). A new sub-map or loop has only its own region eliminated
again, and the separators above that one. From the top down, poses are then put in place only below
separators that moved.

Matrices may be older than the poses: they decide how fast the optimum is reached, not where it is.
That is the gradient's part (`Tension`), which is always that of the present poses: what is left
undone for its smallness adds up there until it is worth a step.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magic_server.posegraph import stacked
from magic_server.posegraph.arrays import EdgeArrays
from magic_server.posegraph.dissection import Dissection
from magic_server.posegraph.fronts import REACH, Blocks, Fronts, Step
from magic_server.posegraph.tension import Tension

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]

REGION = 48
"""At most so many sub-maps are condensed at once."""
SMALL_M = 0.01
"""A step that moves something by more is followed by another: it was not quite linear."""
LOCAL_ROUNDS = 3
GOOD_STEP = 0.3
"""A step larger than this share of the one before says that matrices are too old."""
EXACT_SHARE = 0.02
"""After growing by this share, all that small steps left undone is taken in."""
ARRIVED_M = 1e-4
"""Exact steps go on while one moves something by more (or turns it by a third of it)."""
STALE = 0.05
"""Edges whose residual changed by more (m, rad) since their matrices were made get new ones."""
ROUNDS = 8


@dataclass(frozen=True, slots=True)
class Settled:
    """What a settlement did."""

    moved: Numbers
    """Vertices whose poses changed, ascending."""
    strained: Numbers
    """Edges that were looked at again and whose squared norm reaches the limit, ascending."""
    exact: bool
    """Whether all that smaller steps had left undone was taken in."""


class Hierarchy:
    """Owns the condensed regions of a graph; the poses belong to the caller."""

    def __init__(self, poses: Array, edges: EdgeArrays, held: Collection[int]) -> None:
        """All edges count; vertices in `held` stay at their poses, of (n, 4, 4)."""
        self._held = set(held)
        self._tension = Tension()
        self._tension.add_vertices(len(poses))
        self._tension.add(edges)
        self._at: list[list[int]] = [[] for _ in range(len(poses))]
        self._tree = Dissection.of(poses[:, :3, 3], edges.source, edges.target, REGION)
        self._fronts = Fronts(self._tree)
        self._inside: list[set[int]] = [set() for _ in self._tree.nodes]
        self._home = [-1] * len(edges)
        self._stale = set(range(len(self._tree.nodes)))
        """Nodes to eliminate again."""
        self._unanswered = len(edges)
        """Edges added or removed since the gradient was last taken in as a whole."""
        self._changed = set(range(len(edges)))
        """Edges whose poses changed since they were refreshed."""
        for number in range(len(edges)):
            for vertex in edges.ends(number):
                self._at[vertex].append(number)
            self._house(number)

    @property
    def regions(self) -> int:
        """How many regions there are."""
        return self._tree.regions

    @property
    def nbytes(self) -> int:
        """Memory of the condensed matrices."""
        return self._fronts.nbytes

    def add_vertex(self, near: int | None, pose: Array, *, held: bool = False) -> None:
        """The next vertex, into the region of the vertex `near` or of its pose (4, 4)."""
        if held:
            self._held.add(len(self._at))
        self._at.append([])
        self._tension.add_vertices(1)
        self._stale.add(self._tree.add(near, pose[:3, 3]))

    def add_edge(self, edge: EdgeArrays) -> int:
        """One more edge that counts; its number."""
        number = len(self._home)
        self._tension.add(edge)
        self._home.append(-1)
        source, target = edge.ends(0)
        lessened = self._tree.join(source, target)
        self._stale.update(lessened)
        self._at[source].append(number)
        self._at[target].append(number)
        for one in self._at[max(source, target)] if lessened else (number,):
            self._house(one)
        self._changed.add(number)
        self._unanswered += 1
        return number

    def remove_edge(self, number: int) -> None:
        """An edge that no longer counts."""
        for vertex in self._tension.edges.ends(number):
            self._at[vertex].remove(number)
        self._inside[self._home[number]].discard(number)
        self._stale.add(self._home[number])
        self._home[number] = -1
        self._changed.discard(number)
        self._unanswered += 1
        self._tension.release(number)

    def moved(self, vertices: Iterable[int]) -> None:
        """The caller moved some vertices."""
        for vertex in vertices:
            self._changed.update(self._at[vertex])

    def settle(self, poses: Array, *, limit: float, exactly: bool = False) -> Settled:
        """Move poses (n, 4, 4), in place, to where the edges want them.

        `exactly` goes on to the last digit, at the cost of the whole graph; so does a settlement
        once the graph has grown by `EXACT_SHARE`.
        """
        moved: set[int] = set()
        strained = self._refresh(poses, limit, fresh=True)
        if not exactly and self._unanswered < EXACT_SHARE * len(self._at):
            self._eliminate(poses, exactly=False)
            last = np.inf
            for _ in range(LOCAL_ROUNDS):
                step = self._fronts.step(self._tension.fresh, poses, self._held)
                moved.update(self._take(step, poses))
                strained.update(self._refresh(poses, limit, fresh=True))
                size = _size_m(step)
                exactly = size > max(SMALL_M, GOOD_STEP * last)
                if size < SMALL_M or exactly:
                    break
                last = size
            self._tension.forget_fresh()
        else:
            exactly = True
        if exactly:
            moved.update(self._settle_exactly(poses))
            self._changed.update(n for n, home in enumerate(self._home) if home >= 0)
            strained = self._refresh(poses, limit, fresh=False)
        over = [n for n, is_over in strained.items() if is_over and self._home[n] >= 0]
        return Settled(np.array(sorted(moved), np.int64), np.array(sorted(over), np.int64), exactly)

    def _settle_exactly(self, poses: Array) -> set[int]:
        """Steps against all that is left of the gradient, until they are small."""
        moved: set[int] = set()
        self._unanswered = 0
        self._tension.forget_fresh()
        last = np.inf
        for _ in range(ROUNDS):
            self._changed.update(n for n, home in enumerate(self._home) if home >= 0)
            self._refresh(poses, np.inf, fresh=False)
            self._eliminate(poses, exactly=True)
            gradient = dict(enumerate(self._tension.gradient))
            step = self._fronts.step(gradient, poses, self._held)
            moved.update(self._take(step, poses))
            size = _size_m(step)
            if size < ARRIVED_M:
                break
            if size > GOOD_STEP * last:
                self._stale.update(range(len(self._tree.nodes)))
            last = size
        return moved

    def _refresh(self, poses: Array, limit: float, *, fresh: bool) -> dict[int, bool]:
        """Edges whose poses changed pull anew; which of them now reach the limit."""
        numbers = np.array(sorted(self._changed), dtype=np.int64)
        self._changed.clear()
        squared, change = self._tension.refresh(numbers, poses, fresh=fresh)
        self._stale.update(self._home[n] for n in numbers[change > STALE].tolist())
        return dict(zip(numbers.tolist(), (squared >= limit).tolist(), strict=True))

    def _take(self, step: Step, poses: Array) -> set[int]:
        """Move the poses; edges within what moves rigidly are none the wiser."""
        poses[step.vertices] = poses[step.vertices] @ stacked.exp(step.tangents)
        self.moved(step.vertices.tolist())
        moved = set(step.vertices.tolist())
        for vertices, motion in step.rigid:
            poses[vertices] = motion @ poses[vertices]
            moved.update(vertices.tolist())
        return moved

    def _eliminate(self, poses: Array, *, exactly: bool) -> None:
        for node in tuple(self._stale):
            if self._tree.split(node, poses[:, :3, 3], self._neighbours):
                self._divided(node)
        stale, self._stale = self._stale, set()

        def blocks(node: int) -> Blocks:
            numbers = np.array(sorted(self._inside[node]), dtype=np.int64)
            return self._tension.blocks(numbers, poses)

        self._fronts.eliminate(stale, blocks, self._held, exactly=exactly)

    def _divided(self, region: int) -> None:
        """A region became a separator and new regions below it: edges move down."""
        added = range(len(self._inside), len(self._tree.nodes))
        self._inside.extend(set() for _ in added)
        self._stale.update(added)
        for number in tuple(self._inside[region]):
            self._house(number)

    def _house(self, number: int) -> None:
        """An edge lies in the deeper node of its ends."""
        ends = [self._tree.node_of[v] for v in self._tension.edges.ends(number)]
        home = max(ends, key=lambda node: self._tree.nodes[node].depth)
        if self._home[number] >= 0:
            self._inside[self._home[number]].discard(number)
            self._stale.add(self._home[number])
        self._home[number] = home
        self._inside[home].add(number)
        self._stale.add(home)

    def _neighbours(self, vertex: int) -> list[int]:
        ends = [self._tension.edges.ends(number) for number in self._at[vertex]]
        return [b if a == vertex else a for a, b in ends]


def _size_m(step: Step) -> float:
    return float((np.abs(step.tangents) * REACH).max(initial=0.0))
