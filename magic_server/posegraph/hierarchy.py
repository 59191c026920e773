"""A pose graph of any size, kept near its optimum as it grows: what is new costs its neighbourhood.

Regions of the graph are condensed onto the separators between them, these onto the separators above
them, and so on (`Dissection`, `Fronts`). A new sub-map or loop has only its own region eliminated
again, and the separators above that one. From the top down, poses are then put in place only below
separators that moved.

Matrices may be older than the poses: they decide how fast the optimum is reached, not where it is.
That is the gradient's part (`Tension`), which is always that of the present poses. A settlement is
a few steps, each of which makes the graph's error smaller or is taken back; what is left undone is
small, and adds up in the gradient.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from magic_server.posegraph import stacked
from magic_server.posegraph.arrays import EdgeArrays
from magic_server.posegraph.dissection import Dissection
from magic_server.posegraph.fronts import REACH, Blocks, Fronts, Step
from magic_server.posegraph.growing import Rows
from magic_server.posegraph.tension import Tension

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]

REGION = 48
"""At most so many sub-maps are condensed at once."""
SMALL_M = 0.01
"""A step that moves something by more is followed by another: it was not quite linear."""
LOCAL_ROUNDS = 2
SHARES = (1.0, 0.5, 0.25)
"""Of a step that goes too far, a part is tried: the matrices say less than the edges hold."""
STALE = 0.05
"""Edges whose residual changed by more (m, rad) since their matrices were made get new ones."""
RENEWED = 8
"""So many nodes with such edges are eliminated again per settlement."""
LEFT_STALE = 32
"""So many nodes wait for the next settlement to be eliminated again."""
COST_NOISE = 1e-6
"""Errors that differ by less are the same."""


@dataclass(frozen=True, slots=True)
class Settled:
    """What a settlement did."""

    moved: Numbers
    """Vertices whose poses changed, ascending."""
    strained: Numbers
    """Edges that were looked at again and whose squared norm reaches the limit, ascending."""


class Hierarchy:
    """Owns the condensed regions of a graph; the poses belong to the caller."""

    def __init__(self, poses: Array, edges: EdgeArrays, held: Collection[int]) -> None:
        """All edges count; vertices in `held` stay at their poses, of (n, 4, 4).

        Nothing is condensed yet: that is the long part, see `condense`.
        """
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
        """Nodes to eliminate again before a step."""
        self._aged = set[int]()
        """Nodes whose matrices are old; steps may do with them."""
        self._changed = Rows((), np.bool_)
        """Which edges are to be refreshed: their poses changed."""
        self._changed.extend(np.ones(len(edges), dtype=bool))
        self._counts = Rows((), np.bool_)
        self._counts.extend(np.ones(len(edges), dtype=bool))
        for number, ends in enumerate(
            zip(edges.source.tolist(), edges.target.tolist(), strict=True)
        ):
            for vertex in ends:
                self._at[vertex].append(number)
            self._house(number)

    def __len__(self) -> int:
        """How many vertices there are."""
        return len(self._at)

    @property
    def regions(self) -> int:
        """How many regions there are."""
        return self._tree.regions

    @property
    def nbytes(self) -> int:
        """Memory of the condensed matrices."""
        return self._fronts.nbytes

    @property
    def cost(self) -> float:
        """Half the squared Mahalanobis norms of all edges, at the poses of the last settlement."""
        return self._tension.cost

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
        self._changed.append(True)
        self._counts.append(True)
        return number

    def remove_edge(self, number: int) -> None:
        """An edge that no longer counts."""
        for vertex in self._tension.edges.ends(number):
            self._at[vertex].remove(number)
        self._inside[self._home[number]].discard(number)
        self._stale.add(self._home[number])
        self._home[number] = -1
        self._counts.view[number] = False
        self._tension.release(number)

    def moved(self, vertices: Numbers) -> None:
        """The caller moved some vertices."""
        edges, moving = self._tension.edges, np.zeros(len(self), dtype=bool)
        moving[vertices] = True
        self._changed.view[moving[edges.source] | moving[edges.target]] = True

    def condense(self, poses: Array, *, at_most: int) -> bool:
        """Eliminate so many of the nodes that have to be; whether none is left."""
        self._split_large(poses)
        nodes = self._tree.nodes
        deepest = sorted(self._stale, key=lambda node: -nodes[node].depth)[:at_most]
        self._stale.difference_update(deepest)
        self._eliminate(deepest, poses, upwards=False)  # those above are to be, too
        return not self._stale

    def keep_up(self, poses: Array) -> None:
        """Eliminate what has to be, once there is so much of it that the next step would wait."""
        if len(self._stale) > LEFT_STALE:
            self._split_large(poses)
            stale, self._stale = self._stale, set()
            self._eliminate(stale, poses)

    def taken_over(self, poses: Array, *, limit: float) -> Numbers:
        """Poses (n, 4, 4) are those of a solve of everything; the edges beyond the limit."""
        self._changed.view[:] = True
        strained = self._refresh(poses, limit)
        self._tension.forget_fresh()
        return _over(strained)

    def settle(self, poses: Array, *, limit: float, wholly: bool = False) -> Settled:
        """Move poses (n, 4, 4), in place, towards where the edges want them.

        Steps answer what changed since the last settlement; `wholly`, also what that left undone.
        """
        moved: list[Numbers] = []
        strained = self._refresh(poses, limit)
        self._split_large(poses)
        stale, self._stale = self._stale, set()
        stale.update(islice(sorted(self._aged - stale), RENEWED))
        self._eliminate(stale, poses)
        for _ in range(LOCAL_ROUNDS):
            step = self._step(poses, wholly=wholly)
            if not self._goes_down(step, poses, limit, strained):
                break
            moved.append(step.moving)
            if _size_m(step) < SMALL_M:
                break
        self._tension.forget_fresh()
        every = np.unique(np.concatenate(moved)) if moved else np.zeros(0, dtype=np.int64)
        return Settled(every, _over({n: o for n, o in strained.items() if self._home[n] >= 0}))

    def _goes_down(self, step: Step, poses: Array, limit: float, strained: dict[int, bool]) -> bool:
        """Take a step, or a part of it that lowers the cost; False where none does."""
        before, cost = poses[step.moving], self.cost
        for share in SHARES:
            self._take(step.scaled(share), poses)
            strained |= self._refresh(poses, limit)
            if self.cost <= cost + COST_NOISE:
                return True
            poses[step.moving] = before
        self.moved(step.moving)
        strained |= self._refresh(poses, limit)
        return False

    def _step(self, poses: Array, *, wholly: bool) -> Step:
        vertices, gradient = self._tension.fresh
        if wholly:
            vertices, gradient = np.arange(len(self)), self._tension.gradient
        return self._fronts.step(vertices, gradient, poses, self._held)

    def _refresh(self, poses: Array, limit: float) -> dict[int, bool]:
        """Edges whose poses changed pull anew; which of them now reach the limit."""
        numbers = np.flatnonzero(self._changed.view & self._counts.view)
        self._changed.view[:] = False
        squared, change = self._tension.refresh(numbers, poses)
        self._aged.update(self._home[n] for n in numbers[change > STALE].tolist())
        return dict(zip(numbers.tolist(), (squared >= limit).tolist(), strict=True))

    def _take(self, step: Step, poses: Array) -> None:
        """Move the poses; edges within what moves rigidly are none the wiser."""
        poses[step.vertices] = poses[step.vertices] @ stacked.exp(step.tangents)
        self.moved(step.vertices)
        for vertices, motion in step.rigid:
            poses[vertices] = motion @ poses[vertices]

    def _split_large(self, poses: Array) -> None:
        for node in tuple(self._stale):
            if self._tree.split(node, poses[:, :3, 3], self._neighbours):
                self._divided(node)

    def _eliminate(self, stale: Collection[int], poses: Array, *, upwards: bool = True) -> None:
        def blocks(node: int) -> Blocks:
            numbers = np.array(sorted(self._inside[node]), dtype=np.int64)
            return self._tension.blocks(numbers, poses)

        done = self._fronts.eliminate(stale, blocks, self._held, upwards=upwards)
        self._aged -= done

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


def _over(strained: dict[int, bool]) -> Numbers:
    return np.array(sorted(n for n, is_over in strained.items() if is_over), dtype=np.int64)
