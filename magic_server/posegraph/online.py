"""A pose graph that grows: the new is placed at once, its neighbourhood adjusted, the rest later.

A new sub-map hangs on one odometry edge: the optimum is where that edge puts it, and nothing else
moves. An accepted loop that agrees with the estimate moves a neighbourhood of bounded size
(`adjusted`), so that a revision takes as long in a graph of ten thousand sub-maps as in one of a
hundred. A loop that does not agree, that would join two components or move a sub-map far, is in
doubt: it counts once a solve of the whole graph (`solve_arrays`, elsewhere and robust) has taken it
up. Such a solve is adopted whenever it comes; what arrived meanwhile is placed again on top of it.

A large graph is condensed by regions (`Hierarchy`): loops that are taken up then bring all poses to
the optimum at once, and a solve of the whole graph is asked for by doubt alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magic_server.posegraph.arrays import ArraySolution, EdgeArrays, GraphArrays
from magic_server.posegraph.growing import EdgeRows, Rows
from magic_server.posegraph.hierarchy import Hierarchy
from magic_server.posegraph.neighbourhood import Adjacency, adjusted
from magic_server.posegraph.problem import Edge, PoseGraphConfig

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]

NOTICEABLE_M = 1e-5
NOTICEABLE_RAD = 1e-6
"""A pose that moved by less is not news."""
ROUGHLY_NOTICEABLE = 1000.0
"""Where the graph is condensed by regions, a loop moves much by little: only moves that are larger
by this are news (a centimetre, a milliradian)."""
EXACTLY_NOTICEABLE = 100.0
"""The same after a settlement that took in everything."""
TRIED_PER_STEP = 8
"""Loops that a step tries to take up; more than that wait for the solve of the whole graph."""


@dataclass(frozen=True, slots=True)
class NewVertex:
    """A sub-map that joins the graph."""

    name: str
    odometry: Edge | None = None
    """From the sub-map before it, which must be known."""
    prior: Array | None = None
    """world_from_anchor (4, 4) where it is known."""
    group: str = ""
    """Whose it is; components are counted by it."""


@dataclass(frozen=True, slots=True)
class Change:
    """What a step changed."""

    vertices: Numbers
    """Numbers of those whose pose or component is not what was told before, ascending."""
    taken_up: Numbers
    """Numbers of the loops that now count."""
    dropped: Numbers
    """Numbers of the loops that no longer do."""
    largest_move_m: float
    """How far the farthest of them moved; new ones do not count."""

    def __bool__(self) -> bool:
        return bool(len(self.vertices) or len(self.taken_up) or len(self.dropped))


class OnlineGraph:
    """Vertices are numbered in order of arrival. Not thread-safe: one owner."""

    def __init__(self, config: PoseGraphConfig) -> None:
        self._config = config
        self._limit = config.squared_norm_limit
        self.names: list[str] = []
        self.number: dict[str, int] = {}
        self._odometry: list[Edge] = []
        self._odometry_of: dict[int, int] = {}
        self._loops: list[Edge] = []
        self._widened = EdgeRows()
        self._loop_edges = EdgeRows()
        self._hierarchy: Hierarchy | None = None
        self._condensed: dict[int, int] = {}
        """Of each loop that counts: its number in the hierarchy."""
        self._was_exact = False
        """Whether a settlement since the last news took in everything."""
        self._strained: set[int] = set()
        """Edges of the hierarchy that are known to be beyond their limit."""
        self._adjacency = Adjacency()
        self._priors: dict[int, Array] = {}
        self._poses, self._told = Rows((4, 4)), Rows((4, 4))
        self._component, self._told_component = Rows((), np.int64), Rows((), np.int64)
        self._kept, self._told_kept = Rows((), np.bool_), Rows((), np.bool_)
        self._groups: list[str] = []
        self.members: dict[int, dict[str, int]] = {}
        """Of each component, by its oldest vertex: how many vertices each group has in it."""
        self._touched: set[int] = set()
        self.unsettled = False
        """Whether a solve of the whole graph would change something, or may."""

    def __len__(self) -> int:
        return len(self.names)

    @property
    def poses(self) -> Array:
        """(n, 4, 4), each in the frame of its component."""
        return self._poses.view

    @property
    def component(self) -> Numbers:
        """(n,) the number of the oldest vertex of its component."""
        return self._component.view

    @property
    def kept(self) -> NDArray[np.bool_]:
        """(m,) which loops count."""
        return self._kept.view

    @property
    def loop_count(self) -> int:
        """Accepted loops, kept or not."""
        return len(self._loops)

    def loop(self, number: int) -> Edge:
        """A loop by its number, in order of arrival."""
        return self._loops[number]

    def odometry_of(self, name: str) -> Edge | None:
        """The edge that a vertex hangs on, None where it begins a chain."""
        number = self._odometry_of.get(self.number[name])
        return None if number is None else self._odometry[number]

    def restore(
        self,
        vertices: Sequence[NewVertex],
        loops: Sequence[Edge],
        *,
        poses: Mapping[str, tuple[str, Array]],
        kept: Iterable[int],
        settled: bool,
    ) -> None:
        """Take up what was told before: (component, world_from_anchor) of vertices, loops kept.

        `settled` says that a solve of the whole graph stands behind it.
        """
        for vertex in vertices:
            self._add_vertex(vertex)
        for loop in loops:
            self._add_loop(loop)
        for name, (component, pose) in poses.items():
            if name in self.number and component in self.number:
                number = self.number[name]
                self.poses[number] = self._told.view[number] = pose
                self.component[number] = self.number[component]
                self._told_component.view[number] = self.number[component]
        for number in kept:
            self._keep(number)
            self._told_kept.view[number] = True
        self._touched = set(np.flatnonzero(np.isnan(self._told.view[:, 0, 0])).tolist())
        self._count_members()
        self.unsettled = bool(vertices) and not settled

    def advance(
        self,
        vertices: Sequence[NewVertex],
        loops: Sequence[Edge],
        solution: ArraySolution | None = None,
    ) -> Change:
        """Place new sub-maps and take up new loops, as far as that is certain.

        A `solution` of the graph as `arrays` gave it is adopted first.
        """
        touched, self._touched = self._touched, set()
        again = self._adopt(solution) if solution is not None else ()
        for vertex in vertices:
            touched.add(self._add_vertex(vertex))
        waiting = [*again, *(self._add_loop(loop) for loop in loops)]
        if self._hierarchy is None and self._config.is_hierarchical(len(self)):
            touched |= self._condense()
        if self._hierarchy is not None:
            # Without a loop, odometry has put the new where the optimum is.
            touched |= self._settled_with(waiting) if waiting else set()
        else:
            for number in waiting[-TRIED_PER_STEP:]:
                touched |= self._tried(number)
            self.unsettled |= bool(waiting)
        every = np.arange(len(self)) if solution is not None else None
        return self._news(np.array(sorted(touched), dtype=np.int64) if every is None else every)

    def arrays(self) -> GraphArrays:
        """Everything, for a solve of the whole graph from the present estimate."""
        self.unsettled = False
        return GraphArrays(
            count=len(self),
            odometry=EdgeArrays.of(self._odometry, self.number),
            loops=EdgeArrays.of(self._loops, self.number),
            priors=dict(self._priors),
            initial=self.poses.copy(),
        )

    def _adopt(self, solution: ArraySolution) -> list[int]:
        """Take over a solve of the graph as it was; sub-maps that came since are placed on top.

        Returns the loops that came since, of which none counts any more.
        """
        count, loops = len(solution.poses), len(solution.kept)
        self._hierarchy = None
        self.poses[:count] = solution.poses
        self.component[:count] = solution.component
        for number in np.flatnonzero(solution.kept != self.kept[:loops]).tolist():
            self._keep(number, bool(solution.kept[number]))
        for number in range(count, len(self)):
            self._place(number)
        self._count_members()
        since = list(range(loops, len(self._loops)))
        for number in since:
            self._keep(number, False)
        return since

    # Adding

    def _add_vertex(self, vertex: NewVertex) -> int:
        number = len(self.names)
        self.names.append(vertex.name)
        self.number[vertex.name] = number
        self._adjacency.add_vertex()
        if vertex.prior is not None:
            self._priors[number] = vertex.prior
        if vertex.odometry is not None:
            self._odometry_of[number] = len(self._odometry)
            self._odometry.append(vertex.odometry)
            edge = EdgeArrays.of([vertex.odometry], self.number)
            added = self._widened.add(edge.with_odometry_floor(self._config))
            self._adjacency.add_odometry(added, *edge.ends(0))
        self._poses.append(np.eye(4))
        self._component.append(number)
        self._told.append(np.nan)
        self._told_component.append(-1)
        self._place(number)
        if self._hierarchy is not None:
            self._condense_vertex(number)
        self._groups.append(vertex.group)
        self._count(number)
        return number

    def _place(self, number: int) -> None:
        """Where odometry or a known start puts a vertex, and in which component."""
        if number in self._priors:
            self.poses[number] = self._priors[number]
            self.component[number] = self.component[min(self._priors)]
        elif number in self._odometry_of:
            edge = self._odometry[self._odometry_of[number]]
            before = self.number[edge.source]
            self.poses[number] = self.poses[before] @ edge.source_from_target
            self.component[number] = self.component[before]
        else:
            self.poses[number] = np.eye(4)
            self.component[number] = number

    def _count(self, number: int) -> None:
        groups = self.members.setdefault(int(self.component[number]), {})
        groups[self._groups[number]] = groups.get(self._groups[number], 0) + 1

    def _count_members(self) -> None:
        self.members = {}
        for number in range(len(self)):
            self._count(number)

    def _add_loop(self, loop: Edge) -> int:
        self._loops.append(loop)
        self._kept.append(False)
        self._told_kept.append(False)
        return self._loop_edges.add(EdgeArrays.of([loop], self.number))

    def _keep(self, number: int, kept: bool = True) -> None:
        if kept != self.kept[number]:
            self.kept[number] = kept
            change = self._adjacency.add_loop if kept else self._adjacency.remove_loop
            change(number, *self._loop_edges.ends(number))
            if self._hierarchy is not None and kept:
                self._condensed[number] = self._hierarchy.add_edge(self._loop_edges.some([number]))
            elif self._hierarchy is not None:
                self._hierarchy.remove_edge(self._condensed.pop(number))

    def _tried(self, number: int) -> set[int]:
        """Take up a loop if that is certain; the vertices that moved. In doubt, none does."""
        source, target = self._loop_edges.ends(number)
        if not self._may_be_tried(number):
            return set()
        inside = self._adjacency.around((source, target))
        own, other = self._adjacency.edges_of(inside)
        trusted = self._widened.some(own)
        loops = self._loop_edges.some([*other, number])
        fixed = [v for v in inside if v in self._priors or self.component[v] == v]
        moved = adjusted(inside, trusted, loops, self.poses, fixed=fixed, limit=self._limit)
        if moved is None or self._moves_too_far(inside, moved):
            return set()
        if self._hierarchy is None:
            self.poses[inside] = moved
        self._keep(number)
        return set(inside)

    def _may_be_tried(self, loop: int) -> bool:
        source, target = self._loop_edges.ends(loop)
        return self._config.robust != "none" and self.component[source] == self.component[target]

    def _moves_too_far(self, inside: Sequence[int], moved: Array) -> bool:
        step = np.linalg.norm(moved[:, :3, 3] - self.poses[inside][:, :3, 3], axis=1)
        return bool(step.max(initial=0.0) > self._config.max_unsupported_correction_m)

    # By regions

    def _condense(self) -> set[int]:
        """Begin the hierarchy with everything that counts; the vertices that moved."""
        kept = np.flatnonzero(self.kept)
        odometry = self._widened.some(np.arange(len(self._widened)))
        edges = EdgeArrays.joined([odometry, self._loop_edges.some(kept)])
        held = [v for v in range(len(self)) if self._is_held(v)]
        self._hierarchy = Hierarchy(self.poses, edges, held)
        numbers = range(len(odometry), len(edges))
        self._condensed = dict(zip(kept.tolist(), numbers, strict=True))
        settled = self._hierarchy.settle(self.poses, limit=self._limit)
        self._was_exact = True
        self._strained = set(settled.strained.tolist())
        return set(settled.moved.tolist())

    def _condense_vertex(self, number: int) -> None:
        """Take a vertex that was just placed, and what it hangs on, into the hierarchy."""
        assert self._hierarchy is not None
        held = self._is_held(number)
        edge = self._odometry_of.get(number)
        if edge is None:
            self._hierarchy.add_vertex(None, self.poses[number], held=held)
            return
        before = self.number[self._odometry[edge].source]
        self._hierarchy.add_vertex(before, self.poses[number], held=held)
        self._hierarchy.add_edge(self._widened.some([edge]))

    def _is_held(self, number: int) -> bool:
        return number in self._priors or self.component[number] == number

    def _settled_with(self, loops: Iterable[int]) -> set[int]:
        """Take up loops that are certain and bring all poses to the optimum; those that moved."""
        doubtful = [number for number in loops if not self._tried(number)]
        touched = self._settled()
        for number in doubtful:
            touched |= self._tried_by_all(number)
        self.unsettled |= not self.kept[doubtful].all()
        return touched

    def _settled(self) -> set[int]:
        moved, strained = self._settlement()
        # What fitted when it was taken up may contradict what came since.
        self._strained |= strained
        self.unsettled |= bool(strained)
        return set(moved.tolist())

    def _settlement(self) -> tuple[Numbers, set[int]]:
        """Bring all poses to the optimum; which moved, which edges are newly beyond the limit."""
        assert self._hierarchy is not None
        settled = self._hierarchy.settle(self.poses, limit=self._limit)
        self._was_exact |= settled.exact
        return settled.moved, set(settled.strained.tolist()) - self._strained

    def _tried_by_all(self, number: int) -> set[int]:
        """Take up a loop that its neighbourhood alone does not agree with, if the graph does."""
        if self._hierarchy is None or not self._may_be_tried(number):
            return set()
        before = self.poses.copy()
        self._keep(number)
        moved, strained = self._settlement()
        if strained or self._moves_too_far(moved.tolist(), before[moved]):
            self._keep(number, False)
            self.poses[moved] = before[moved]
            self._hierarchy.moved(moved.tolist())
            return self._settled()
        return set(moved.tolist())

    # Telling

    def _news(self, numbers: Numbers) -> Change:
        """Of some vertices, those that differ from what was told, which they are from now on."""
        scale = 1.0
        if self._hierarchy is not None:
            scale = EXACTLY_NOTICEABLE if self._was_exact else ROUGHLY_NOTICEABLE
        self._was_exact = False
        now, before = self.poses[numbers], self._told.view[numbers]
        new = np.isnan(before[:, 0, 0])
        before = np.where(new[:, None, None], now, before)
        step_m = np.linalg.norm(now[:, :3, 3] - before[:, :3, 3], axis=1)
        # The small-angle form is exact enough to tell whether there is news.
        turn_rad = np.linalg.norm(now[:, :3, :3] - before[:, :3, :3], axis=(1, 2)) / np.sqrt(2.0)
        news = new | (step_m > scale * NOTICEABLE_M) | (turn_rad > scale * NOTICEABLE_RAD)
        news |= self.component[numbers] != self._told_component.view[numbers]
        flipped = self.kept != self._told_kept.view
        change = Change(
            vertices=numbers[news],
            taken_up=np.flatnonzero(flipped & self.kept),
            dropped=np.flatnonzero(flipped & ~self.kept),
            largest_move_m=float(step_m.max(initial=0.0)),
        )
        self._told.view[change.vertices] = self.poses[change.vertices]
        self._told_component.view[change.vertices] = self.component[change.vertices]
        self._told_kept.view[flipped] = self.kept[flipped]
        return change
