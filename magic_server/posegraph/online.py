"""A pose graph that grows: the new is placed at once, its neighbourhood adjusted, the rest later.

A new sub-map hangs on one odometry edge: the optimum is where that edge puts it, and nothing else
moves. An accepted loop that agrees with the estimate moves a neighbourhood of bounded size
(`adjusted`), so that a revision takes as long in a graph of ten thousand sub-maps as in one of a
hundred. A loop that does not agree, that would join two components or move a sub-map far, is in
doubt: it counts once a solve of the whole graph (`solve_arrays`, elsewhere and robust) has taken it
up. Such a solve is adopted whenever it comes; what arrived meanwhile is placed again on top of it.

A large graph is condensed by regions (`Regions`): loops that are taken up bring all poses near the
optimum at once. Doubt alone asks for a robust solve; the last millimetres are those of an exact one
of what counts (`settled`, elsewhere too). What arrives during either is carried along.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magic_server.posegraph.arrays import ArraySolution, EdgeArrays, GraphArrays
from magic_server.posegraph.growing import EdgeRows, Rows
from magic_server.posegraph.neighbourhood import Adjacency, adjusted
from magic_server.posegraph.problem import Edge, PoseGraphConfig
from magic_server.posegraph.regional import Outline, Regions
from magic_server.posegraph.settlement import CountedArrays, Optimum, carried
from magic_server.posegraph.telling import Change, Told

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]

ROUGHLY_NOTICEABLE = 1000.0
"""In a large graph a loop moves much by little: while more of it is to come, only moves that are
larger by this are news (a centimetre, a milliradian)."""
FINELY_NOTICEABLE = 100.0
"""The same once nothing more is to come."""
TRIED_PER_STEP = 8
"""Loops that a step tries to take up; more than that wait for the solve of the whole graph."""
TRIED_BY_ALL = 2
"""The same for loops that all regions are asked about."""
LOOPS_PER_STEP = 32
"""So many loops a step of a large graph should be given: it keeps others waiting."""
MOST_FLIPS = 64
"""A solve that takes up or drops more loops has all regions condensed anew."""


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


class OnlineGraph:
    """Vertices are numbered in order of arrival. Not thread-safe: one owner."""

    def __init__(self, config: PoseGraphConfig) -> None:
        self._config = config
        self._limit = config.squared_norm_limit
        self.names: list[str] = []
        self.number: dict[str, int] = {}
        self._odometry, self._widened = EdgeRows(), EdgeRows()
        self._hangs_on, self._previous = Rows((), np.int64), Rows((), np.int64)
        """Of each vertex: its odometry and the vertex before it, -1 where it begins a chain."""
        self._loop_edges = EdgeRows()
        self._regions: Regions | None = None
        self._adjacency = Adjacency()
        self._priors: dict[int, Array] = {}
        self._poses, self._component = Rows((4, 4)), Rows((), np.int64)
        self._kept = Rows((), np.bool_)
        self._told = Told()
        self._groups: list[str] = []
        self.members: dict[int, dict[str, int]] = {}
        """Of each component, by its oldest vertex: how many vertices each group has in it."""
        self._touched: set[int] = set()
        self._asked = np.zeros((0, 4, 4))
        """Poses that a solve of the whole was last asked for with."""
        self.unsettled = False
        """Whether a robust solve of the whole graph would change something, or may."""
        self.bent = False
        """Whether the edges that count want poses that are a little different."""

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
        return len(self._loop_edges)

    def loop(self, number: int) -> Edge:
        """A loop by its number, in order of arrival."""
        return self._edge(self._loop_edges, number)

    def odometry_of(self, name: str) -> Edge | None:
        """The edge that a vertex hangs on, None where it begins a chain."""
        number = int(self._hangs_on.view[self.number[name]])
        return None if number < 0 else self._edge(self._odometry, number)

    def _edge(self, edges: EdgeRows, number: int) -> Edge:
        one = edges.some([number])
        source, target = one.ends(0)
        names = self.names[source], self.names[target]
        return Edge(*names, one.source_from_target[0], one.information[0])

    @property
    def regions(self) -> Regions | None:
        """What it is condensed to, if it is."""
        return self._regions

    @property
    def is_large(self) -> bool:
        """Whether it is to be condensed by regions."""
        return self._config.is_hierarchical(len(self))

    @property
    def wants_solve(self) -> bool:
        """Whether a solve of the whole, robust or exact, would change something, or may."""
        return self.unsettled or self.bent

    @property
    def is_uncondensed(self) -> bool:
        """Whether `outline` should be condensed and given to `advance`."""
        return self.is_large and (self._regions is None or self._regions.is_outgrown)

    @property
    def loops_per_step(self) -> int | None:
        """How many loops a step should be given at most; None for any number."""
        return LOOPS_PER_STEP if self.is_large else None

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
                self.poses[number] = pose
                self.component[number] = self.number[component]
                self._told.know_vertex(number, pose, self.number[component])
        for number in kept:
            self._keep(number)
            self._told.know_loop(number)
        self._touched = self._told.unknown
        self._count_members()
        self.unsettled = bool(vertices) and not settled

    def advance(
        self,
        vertices: Sequence[NewVertex],
        loops: Sequence[Edge],
        solution: ArraySolution | Optimum | None = None,
        regions: Regions | None = None,
    ) -> Change:
        """Place new sub-maps and take up new loops, as far as that is certain.

        A `solution` of the graph as `arrays` or `counted` gave it is adopted first; `regions` of
        it as `outline` gave it are taken into use.
        """
        touched, self._touched = self._touched, set()
        again = self._adopt(solution) if solution is not None else ()
        # What was solved as a whole is at its optimum, but what came since pulls at it.
        wholly = solution is not None and self.bent
        for vertex in vertices:
            touched.add(self._add_vertex(vertex))
        waiting = [*again, *(self._add_loop(loop) for loop in loops)]
        if regions is not None:
            self._take_into_use(regions)
        if self._regions is not None:
            # Without a loop, odometry has put the new where the optimum is.
            if waiting or wholly:
                touched |= self._settled_with(self._regions, waiting, wholly=wholly)
        elif self.is_large:
            for number in waiting:
                touched |= self._tried(number)
            self.unsettled |= not self.kept[waiting].all()
        else:
            for number in waiting[-TRIED_PER_STEP:]:
                touched |= self._tried(number)
            self.unsettled |= bool(waiting)
        self.bent |= self.is_large and bool(waiting)
        every = np.arange(len(self)) if solution is not None else None
        return self._news(np.array(sorted(touched), dtype=np.int64) if every is None else every)

    def arrays(self) -> GraphArrays:
        """Everything, for a robust solve of the whole graph from the present estimate."""
        self.unsettled = self.bent = False
        self._asked = self.poses.copy()
        return GraphArrays(
            count=len(self),
            odometry=self._odometry.every,
            loops=self._loop_edges.every,
            priors=dict(self._priors),
            initial=self._asked,
        )

    def counted(self) -> CountedArrays:
        """What counts, for an exact solve from the present estimate."""
        self.bent = False
        self._asked = self.poses.copy()
        loops = self._loop_edges.some(np.flatnonzero(self.kept))
        edges = EdgeArrays.joined([self._widened.every, loops])
        return CountedArrays(edges, np.array(self._held(), dtype=np.int64), self._asked)

    def outline(self) -> Outline:
        """What is to be condensed."""
        kept = np.flatnonzero(self.kept)
        return Outline(
            poses=self.poses.copy(),
            odometry=self._widened.every,
            loops=self._loop_edges.some(kept),
            numbers=kept,
            loop_count=self.loop_count,
            held=frozenset(self._held()),
        )

    # Adopting

    def _adopt(self, solution: ArraySolution | Optimum) -> list[int]:
        """Take over a solve of the graph as it was. Returns the loops to try again."""
        if isinstance(solution, Optimum):
            self._take_in(solution)
            return []
        if self.is_large:
            self._adopt_below(solution)
            return []
        return self._adopt_anew(solution)

    def _adopt_anew(self, solution: ArraySolution) -> list[int]:
        """Sub-maps that came since are placed on top; loops that came since count no more."""
        count, loops = len(solution.poses), len(solution.kept)
        self.poses[:count] = solution.poses
        self.component[:count] = solution.component
        for number in np.flatnonzero(solution.kept != self.kept[:loops]).tolist():
            self._keep(number, bool(solution.kept[number]))
        for number in range(count, len(self)):
            self._place(number)
        self._count_members()
        since = list(range(loops, self.loop_count))
        for number in since:
            self._keep(number, False)
        return since

    def _adopt_below(self, solution: ArraySolution) -> None:
        """Sub-maps that came since are carried along, and their loops go on to count."""
        flips = np.flatnonzero(solution.kept != self.kept[: len(solution.kept)]).tolist()
        same = np.array_equal(solution.component, self.component[: len(solution.component)])
        if not same or len(flips) > MOST_FLIPS:
            self._regions = None
        self.poses[:] = self._carried(solution.poses)
        if not same:
            self._follow_components(solution.component)
        for number in flips:
            self._keep(number, bool(solution.kept[number]))
        for number in range(len(solution.kept), self.loop_count):
            if self.kept[number] and not self._is_within_component(number):
                self._keep(number, False)
                self.unsettled = True
        if self._regions is not None:
            self._regions.take_over(self.poses, self._limit)

    def _follow_components(self, component: Numbers) -> None:
        """The components of some vertices, the first ones, are new; newer ones follow theirs."""
        self.component[: len(component)] = component
        for number in range(len(component), len(self)):
            self.component[number] = self._component_of_new(number)
        self._count_members()

    def _take_in(self, optimum: Optimum) -> None:
        """Go to the optimum of what counted then; what counts since is taken up from there."""
        self.poses[:] = self._carried(optimum.poses)
        if self._regions is not None:
            self._regions.take_over(self.poses, self._limit)

    def _carried(self, solved: Array) -> Array:
        """All poses (n, 4, 4), moved as a solve of the whole moved what it was asked for."""
        return carried(self.poses, self._asked, solved, self._previous.view)

    def _take_into_use(self, regions: Regions) -> None:
        """Regions of the graph as it was, unless it has become another one."""
        count = len(regions)
        flips = regions.loops ^ set(np.flatnonzero(self.kept).tolist())
        older = sum(number < regions.loop_count for number in flips)
        if older > MOST_FLIPS or regions.held != {v for v in self._held() if v < count}:
            return
        self._regions = regions
        for number in range(count, len(self)):
            self._condense_vertex(number)
        for number in sorted(flips):
            self._condense_loop(number)
        regions.take_over(self.poses, self._limit)

    # Adding

    def _add_vertex(self, vertex: NewVertex) -> int:
        number = len(self.names)
        self.names.append(vertex.name)
        self.number[vertex.name] = number
        self._adjacency.add_vertex()
        if vertex.prior is not None:
            self._priors[number] = vertex.prior
        hangs_on, previous = -1, -1
        if vertex.odometry is not None:
            edge = EdgeArrays.of([vertex.odometry], self.number)
            hangs_on = self._odometry.add(edge)
            self._widened.add(edge.with_odometry_floor(self._config))
            self._adjacency.add_odometry(hangs_on, *edge.ends(0))
            previous = -1 if vertex.prior is not None else edge.ends(0)[0]
        self._hangs_on.append(hangs_on)
        self._previous.append(previous)
        self._poses.append(np.eye(4))
        self._component.append(number)
        self._told.add_vertex()
        self._place(number)
        if self._regions is not None:
            self._condense_vertex(number)
        self._groups.append(vertex.group)
        self._count(number)
        return number

    def _place(self, number: int) -> None:
        """Where odometry or a known start puts a vertex, and in which component."""
        previous = self._previous.view[number]
        if number in self._priors:
            self.poses[number] = self._priors[number]
        elif previous >= 0:
            edge = self._odometry.some([self._hangs_on.view[number]])
            self.poses[number] = self.poses[previous] @ edge.source_from_target[0]
        else:
            self.poses[number] = np.eye(4)
        self.component[number] = self._component_of_new(number)

    def _component_of_new(self, number: int) -> int:
        """The component of a vertex that no loop has joined with another yet."""
        if number in self._priors:
            first = min(self._priors)
            return number if first == number else int(self.component[first])
        previous = self._previous.view[number]
        return number if previous < 0 else int(self.component[previous])

    def _count(self, number: int) -> None:
        groups = self.members.setdefault(int(self.component[number]), {})
        groups[self._groups[number]] = groups.get(self._groups[number], 0) + 1

    def _count_members(self) -> None:
        self.members = {}
        for number in range(len(self)):
            self._count(number)

    def _add_loop(self, loop: Edge) -> int:
        self._kept.append(False)
        self._told.add_loop()
        return self._loop_edges.add(EdgeArrays.of([loop], self.number))

    def _keep(self, number: int, kept: bool = True) -> None:
        if kept != self.kept[number]:
            self.kept[number] = kept
            change = self._adjacency.add_loop if kept else self._adjacency.remove_loop
            change(number, *self._loop_edges.ends(number))
            if self._regions is not None:
                self._condense_loop(number)

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
        if self._regions is None:
            self.poses[inside] = moved
        self._keep(number)
        return set(inside)

    def _may_be_tried(self, loop: int) -> bool:
        return self._config.robust != "none" and self._is_within_component(loop)

    def _is_within_component(self, loop: int) -> bool:
        source, target = self._loop_edges.ends(loop)
        return bool(self.component[source] == self.component[target])

    def _moves_too_far(self, inside: Sequence[int], moved: Array) -> bool:
        step = np.linalg.norm(moved[:, :3, 3] - self.poses[inside][:, :3, 3], axis=1)
        return bool(step.max(initial=0.0) > self._config.max_unsupported_correction_m)

    # By regions

    def _held(self) -> list[int]:
        """Vertices that stay: known starts, and the oldest of each component."""
        return sorted({*self._priors, *np.unique(self.component).tolist()})

    def _condense_vertex(self, number: int) -> None:
        """Take a vertex that was just placed, and what it hangs on, into the regions."""
        assert self._regions is not None
        hangs_on, previous = int(self._hangs_on.view[number]), int(self._previous.view[number])
        self._regions.add_vertex(
            None if previous < 0 else previous,
            self.poses,
            self._widened.some([hangs_on] if hangs_on >= 0 else []),
            held=number in self._priors or self.component[number] == number,
        )

    def _condense_loop(self, number: int) -> None:
        """Tell the regions whether a loop counts."""
        assert self._regions is not None
        if self.kept[number]:
            self._regions.count_loop(number, self._loop_edges.some([number]))
        else:
            self._regions.discount_loop(number)

    def _settled_with(self, regions: Regions, loops: Iterable[int], *, wholly: bool) -> set[int]:
        """Take up loops that are certain and bring all poses near the optimum; those that moved."""
        doubtful = [number for number in loops if not self._tried(number)]
        done = regions.settle(self.poses, self._limit, wholly=wholly)
        self.unsettled |= done.strained
        touched = set(done.moved.tolist())
        for number in doubtful[:TRIED_BY_ALL]:
            touched |= self._tried_by_all(regions, number)
        self.unsettled |= not self.kept[doubtful].all()
        return touched

    def _tried_by_all(self, regions: Regions, number: int) -> set[int]:
        """Take up a loop that its neighbourhood alone does not agree with, if the graph does."""
        if not self._may_be_tried(number):
            return set()
        before = self.poses.copy()
        self._keep(number)
        done = regions.settle(self.poses, self._limit)
        moved = done.moved
        if done.strained or self._moves_too_far(moved.tolist(), before[moved]):
            self._keep(number, False)
            regions.put_back(moved, before[moved], self.poses, self._limit)
            return set()
        return set(moved.tolist())

    def _news(self, numbers: Numbers) -> Change:
        """Of some vertices, those that differ from what was told, which they are from now on."""
        scale = 1.0
        if self.is_large:
            more = self.unsettled or self.bent
            scale = ROUGHLY_NOTICEABLE if more else FINELY_NOTICEABLE
        return self._told.news(numbers, self.poses, self.component, self.kept, scale=scale)
