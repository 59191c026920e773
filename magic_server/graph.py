"""A session's pose graph in memory: sub-maps, odometry, loops, and the last solution."""

from __future__ import annotations

import dataclasses
import time
from collections import deque
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from magicslam.v1 import geometry_pb2
from magicslam.v1 import mapping_service_pb2 as mapping_pb

from magic_core.submap import OdometryEdge
from magic_core.wire import convert, names, records
from magic_server.bridging import bridged
from magic_server.posegraph import Edge, PoseGraphConfig, stacked
from magic_server.posegraph.arrays import ArraySolution
from magic_server.posegraph.online import NewVertex, OnlineGraph
from magic_server.posegraph.regional import Regions
from magic_server.posegraph.settlement import Optimum
from magic_server.posegraph.telling import Change
from magic_server.store import GraphVertex, RemovedSubmap, Vertex


@dataclass(frozen=True, slots=True)
class Facts:
    """What a session's pose graph is made of."""

    vertices: tuple[GraphVertex, ...]
    loops: tuple[records.LoopCandidate, ...]
    """The accepted ones."""


class SessionGraph:
    """What the solver needs to know about a session, and the solver's own state."""

    def __init__(self, session: str, config: PoseGraphConfig) -> None:
        self._session = session
        self._config = config
        self._vertices: dict[str, GraphVertex] = {}
        self._loops: dict[tuple[str, str], records.LoopCandidate] = {}
        self._removed: dict[str, RemovedSubmap] = {}
        self._new_vertices: deque[GraphVertex] = deque()
        self._new_loops: deque[records.LoopCandidate] = deque()
        self.online = OnlineGraph(config)
        self.edition = 0
        """Counts how often the solver's state was begun anew."""

    def __contains__(self, submap: str) -> bool:
        return submap in self._vertices

    def loops_without(self, gone: Collection[str]) -> int:
        """Accepted loops that touch none of these sub-maps."""
        left = (loop for ends, loop in self._loops.items() if not {*ends} & {*gone})
        return sum(loop.verdict == "ACCEPTED" for loop in left)

    @property
    def known_starts(self) -> set[str]:
        """The sub-maps with a known start, deleted ones included."""
        all_known = (*self._vertices.values(), *self._removed.values())
        return {one.name for one in all_known if one.prior is not None}

    def names_of(self, agent: str) -> set[str]:
        """The sub-maps of an agent, all by resource name."""
        return {vertex.name for vertex in self._vertices.values() if vertex.agent == agent}

    def span_of(self, submap: str) -> tuple[float, float] | None:
        """Timestamps of a sub-map's first and last frame; None for one that is gone."""
        vertex = self._vertices.get(submap)
        return vertex and vertex.span_s

    def odometry_of(self, submap: str) -> OdometryEdge | None:
        """A sub-map's tracked motion; None for the first of a chain and for one that is gone."""
        vertex = self._vertices.get(submap)
        return vertex and vertex.odometry

    def add_vertex(self, vertex: Vertex) -> None:
        """A new sub-map; its place in the order of arrival is now."""
        self._vertices[vertex.name] = bare = vertex.bare()
        self._new_vertices.append(bare)

    def add_removed(self, removed: RemovedSubmap) -> None:
        """A deleted sub-map, over which odometry is carried on."""
        self._removed[removed.name] = removed

    def remove(self, submaps: Collection[str], *, keep_odometry: bool) -> None:
        """Forget sub-maps and their loops; with `keep_odometry`, not how their neighbours lie."""
        for name in submaps:
            vertex = self._vertices.pop(name, None)
            if vertex is not None and keep_odometry:
                self.add_removed(RemovedSubmap(name, vertex.odometry, vertex.prior))
        gone = set(submaps)
        self._loops = {ends: loop for ends, loop in self._loops.items() if gone.isdisjoint(ends)}

    def forget_removed(self, agent: str) -> None:
        """Nothing is left of an agent, all by resource name: its indices begin at 0 again."""
        prefix = f"{agent}/"
        self._removed = {n: r for n, r in self._removed.items() if not n.startswith(prefix)}

    def set_loop(self, loop: records.LoopCandidate) -> None:
        """A candidate, new or with news."""
        before = self._loops.get((loop.source, loop.target))
        self._loops[loop.source, loop.target] = loop
        if loop.verdict == "ACCEPTED" and (before is None or before.verdict != "ACCEPTED"):
            self._new_loops.append(loop)

    def knows_pair(self, source: str, target: str) -> bool:
        """Whether two sub-maps were paired before, in either order."""
        return (source, target) in self._loops or (target, source) in self._loops

    # The solution: what follows belongs to one owner at a time, see solving

    @property
    def has_news(self) -> bool:
        """Whether sub-maps or accepted loops wait to be taken in."""
        return bool(self._new_vertices or self._new_loops)

    def facts(self) -> Facts:
        """Everything that is known now. Nothing of it is news any more: hand it to `restore`."""
        self._new_vertices.clear()
        self._new_loops.clear()
        accepted = [loop for loop in self._loops.values() if loop.verdict == "ACCEPTED"]
        return Facts(tuple(self._vertices.values()), tuple(accepted))

    def restore(self, facts: Facts, snapshot: mapping_pb.PoseSnapshot, settled: bool) -> None:
        """Begin the solver anew, where a solution put things. Slow: not in the event loop.

        What the solution does not hold is told with the next change. A `settled` one was solved as
        a whole with all the loops that it counts.
        """
        self.online = OnlineGraph(self._config)
        self.edition += 1
        stored = convert.snapshot_from_proto(snapshot).poses
        self.online.restore(
            [self._joining(vertex) for vertex in facts.vertices],
            [_loop_edge(loop) for loop in facts.loops],
            poses={name: (pose.component, pose.world_from_anchor) for name, pose in stored.items()},
            kept=[number for number, loop in enumerate(facts.loops) if loop.kept],
            settled=settled and snapshot.loop_count == len(facts.loops),
        )

    def advance(
        self, solution: ArraySolution | Optimum | None, regions: Regions | None = None
    ) -> Change:
        """Adopt a solve of the whole graph and its regions, if there are, and take in what is new.

        Of a large graph's new loops some may be left for the next time.
        """
        # Loops first: each came after the sub-maps that it joins.
        waiting, most = len(self._new_loops), self.online.loops_per_step
        count = waiting if most is None else min(waiting, most)
        loops = [self._new_loops.popleft() for _ in range(count)]
        vertices = [self._new_vertices.popleft() for _ in range(len(self._new_vertices))]
        joining = [self._joining(vertex) for vertex in vertices]
        edges = [_loop_edge(loop) for loop in loops]
        return self.online.advance(joining, edges, solution, regions)

    def remember(self, change: Change) -> None:
        """A change is in the store: so are the loops that it took up or dropped."""
        for numbers, kept in ((change.taken_up, True), (change.dropped, False)):
            for ends in self.ends_of(numbers):
                if ends in self._loops:
                    self._loops[ends] = dataclasses.replace(self._loops[ends], kept=kept)

    def message(self, change: Change, revision: int) -> mapping_pb.PoseSnapshot:
        """A change as a snapshot that holds the changed poses only."""
        online = self.online
        components = online.component[change.vertices].tolist()
        poses = _pose_messages(
            [online.names[number] for number in change.vertices.tolist()],
            [online.names[number] for number in components],
            online.poses[change.vertices],
        )
        return mapping_pb.PoseSnapshot(
            session=names.session_name(self._session),
            revision=revision,
            solved_at=convert.timestamp_to_proto(convert.moment(time.time())),
            poses=poses,
            components=self._components(),
            loop_count=online.loop_count,
            loops_kept=int(online.kept.sum()),
        )

    def ends_of(self, loops: Iterable[int]) -> list[tuple[str, str]]:
        """(source, target) of loops by their number in the solver."""
        edges = [self.online.loop(int(number)) for number in loops]
        # An edge's source is the loop's target: see _loop_edge.
        return [(edge.target, edge.source) for edge in edges]

    def kept_loops(self) -> set[tuple[str, str]]:
        """(source, target) of the loops that the solution relies on."""
        return set(self.ends_of(np.flatnonzero(self.online.kept)))

    def empty_snapshot(self) -> mapping_pb.PoseSnapshot:
        """Revision 0."""
        return mapping_pb.PoseSnapshot(session=names.session_name(self._session))

    def _joining(self, vertex: GraphVertex) -> NewVertex:
        """A sub-map with its odometry and known start, carried on over deleted ones."""
        odometry, prior = bridged(vertex, self._removed)
        if odometry is None:
            return NewVertex(vertex.name, None, prior, group=vertex.agent)
        session, agent, _ = names.parse_submap(vertex.name)
        source = names.submap_name(session, agent, odometry.previous_index)
        before = self._vertices.get(source)
        edge = Edge(
            source=source if before is None else before.name,  # that very string, not its equal
            target=vertex.name,
            source_from_target=odometry.previous_from_anchor,
            information=odometry.information,
        )
        return NewVertex(vertex.name, edge, prior, group=vertex.agent)

    def _components(self) -> list[mapping_pb.Component]:
        """Largest first, then by id."""
        found = [
            mapping_pb.Component(
                id=self.online.names[oldest], submap_count=sum(counts.values()), agents=counts
            )
            for oldest, counts in self.online.members.items()
        ]
        return sorted(found, key=lambda c: (-c.submap_count, c.id))


def _pose_messages(
    submaps: Sequence[str], components: Sequence[str], poses: np.ndarray
) -> list[mapping_pb.CorrectedPose]:
    """Messages of many poses (n, 4, 4), without a check for each: they come from the solver."""
    quaternions = stacked.quaternions_from_rotations(poses[:, :3, :3]).tolist()
    translations = poses[:, :3, 3].tolist()
    return [
        mapping_pb.CorrectedPose(
            submap=submap,
            component=component,
            world_from_anchor=geometry_pb2.Pose(x=x, y=y, z=z, qw=w, qx=i, qy=j, qz=k),
        )
        for submap, component, (x, y, z), (w, i, j, k) in zip(
            submaps, components, translations, quaternions, strict=True
        )
    ]


def _loop_edge(loop: records.LoopCandidate) -> Edge:
    # Both are there once a loop is accepted.
    assert loop.target_from_source is not None
    assert loop.information is not None
    return Edge(
        source=loop.target,
        target=loop.source,
        source_from_target=loop.target_from_source,
        information=loop.information,
    )
