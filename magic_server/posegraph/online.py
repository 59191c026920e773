"""A pose graph that grows: the new is placed at once, its neighbourhood adjusted, the rest later.

A new sub-map hangs on one odometry edge: the optimum is where that edge puts it, and nothing else
moves. An accepted loop that agrees with the estimate moves a neighbourhood of bounded size
(`adjusted`), so that a revision takes as long in a graph of ten thousand sub-maps as in one of a
hundred. A loop that does not agree, that would join two components or move a sub-map far, is in
doubt: it counts once a solve of the whole graph (`solve_arrays`, elsewhere and robust) has taken it
up. Such a solve is adopted whenever it comes; what arrived meanwhile is placed again on top of it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magic_server.posegraph.arrays import ArraySolution, EdgeArrays, GraphArrays
from magic_server.posegraph.neighbourhood import Adjacency, adjusted
from magic_server.posegraph.problem import Edge, PoseGraphConfig

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]

NOTICEABLE_M = 1e-5
NOTICEABLE_RAD = 1e-6
"""A pose that moved by less is not news."""
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
        self._widened = _Edges()
        self._loop_edges = _Edges()
        self._adjacency = Adjacency()
        self._priors: dict[int, Array] = {}
        self.poses = np.zeros((0, 4, 4))
        self.component = np.zeros(0, dtype=np.int64)
        self.kept = np.zeros(0, dtype=bool)
        self._told = np.zeros((0, 4, 4))
        self._told_component = np.zeros(0, dtype=np.int64)
        self._told_kept = np.zeros(0, dtype=bool)
        self._groups: list[str] = []
        self.members: dict[int, dict[str, int]] = {}
        """Of each component, by its oldest vertex: how many vertices each group has in it."""
        self._touched: set[int] = set()
        self.unsettled = False
        """Whether a solve of the whole graph would change something, or may."""

    def __len__(self) -> int:
        return len(self.names)

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
                self.poses[number] = self._told[number] = pose
                self.component[number] = self._told_component[number] = self.number[component]
        for number in kept:
            self._keep(number)
            self._told_kept[number] = True
        self._touched = set(np.flatnonzero(np.isnan(self._told[:, 0, 0])).tolist())
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
        added = [self._add_loop(loop) for loop in loops]
        for number in (*again, *added)[-TRIED_PER_STEP:]:
            touched |= self._tried(number)
        self.unsettled |= bool(again or added)
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
        self.poses = _grown(self.poses, np.eye(4))
        self.component = _grown(self.component, np.int64(number))
        self._told = _grown(self._told, np.full((4, 4), np.nan))
        self._told_component = _grown(self._told_component, np.int64(-1))
        self._place(number)
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
        self.kept = _grown(self.kept, np.bool_(False))
        self._told_kept = _grown(self._told_kept, np.bool_(False))
        return self._loop_edges.add(EdgeArrays.of([loop], self.number))

    def _keep(self, number: int, kept: bool = True) -> None:
        if kept != self.kept[number]:
            self.kept[number] = kept
            change = self._adjacency.add_loop if kept else self._adjacency.remove_loop
            change(number, *self._loop_edges.one(number).ends(0))

    def _tried(self, number: int) -> set[int]:
        """Take up a loop if that is certain; the vertices that moved. In doubt, none does."""
        source, target = self._loop_edges.one(number).ends(0)
        if self._config.robust == "none" or self.component[source] != self.component[target]:
            return set()
        inside = self._adjacency.around((source, target))
        own, other = self._adjacency.edges_of(inside)
        trusted = self._widened.some(own)
        loops = self._loop_edges.some([*other, number])
        fixed = [v for v in inside if v in self._priors or self.component[v] == v]
        moved = adjusted(inside, trusted, loops, self.poses, fixed=fixed, limit=self._limit)
        if moved is None or self._moves_too_far(inside, moved):
            return set()
        self.poses[inside] = moved
        self._keep(number)
        return set(inside)

    def _moves_too_far(self, inside: list[int], moved: Array) -> bool:
        step = np.linalg.norm(moved[:, :3, 3] - self.poses[inside][:, :3, 3], axis=1)
        return bool(step.max(initial=0.0) > self._config.max_unsupported_correction_m)

    # Telling

    def _news(self, numbers: Numbers) -> Change:
        """Of some vertices, those that differ from what was told, which they are from now on."""
        now, before = self.poses[numbers], self._told[numbers]
        new = np.isnan(before[:, 0, 0])
        before = np.where(new[:, None, None], now, before)
        step_m = np.linalg.norm(now[:, :3, 3] - before[:, :3, 3], axis=1)
        # The small-angle form is exact enough to tell whether there is news.
        turn_rad = np.linalg.norm(now[:, :3, :3] - before[:, :3, :3], axis=(1, 2)) / np.sqrt(2.0)
        news = new | (step_m > NOTICEABLE_M) | (turn_rad > NOTICEABLE_RAD)
        news |= self.component[numbers] != self._told_component[numbers]
        flipped = self.kept != self._told_kept
        change = Change(
            vertices=numbers[news],
            taken_up=np.flatnonzero(flipped & self.kept),
            dropped=np.flatnonzero(flipped & ~self.kept),
            largest_move_m=float(step_m.max(initial=0.0)),
        )
        self._told[change.vertices] = self.poses[change.vertices]
        self._told_component[change.vertices] = self.component[change.vertices]
        self._told_kept = self.kept.copy()
        return change


class _Edges:
    """Edges that are added one at a time and read a few at a time."""

    def __init__(self) -> None:
        self._rows: list[EdgeArrays] = []

    def add(self, edge: EdgeArrays) -> int:
        self._rows.append(edge)
        return len(self._rows) - 1

    def one(self, number: int) -> EdgeArrays:
        return self._rows[number]

    def some(self, numbers: Sequence[int]) -> EdgeArrays:
        rows = [self._rows[number] for number in numbers]
        return EdgeArrays.joined(rows)


def _grown(rows: NDArray, row: NDArray | np.generic) -> NDArray:
    return np.concatenate([rows, np.asarray(row, dtype=rows.dtype)[None]])
