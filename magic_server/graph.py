"""A session's pose graph in memory: sub-maps, odometry, loops, and the last solution."""

from __future__ import annotations

import time
from collections.abc import Collection

import numpy as np
from magicslam.v1 import mapping_service_pb2 as mapping_pb

from magic_core.wire import convert, names, records
from magic_server.bridging import bridged
from magic_server.poseboard import PoseBoard
from magic_server.posegraph import Edge, PoseGraphProblem, PoseGraphSolution
from magic_server.store import RemovedSubmap, Vertex


class SessionGraph:
    """What the solver needs to know about a session."""

    def __init__(self, session: str) -> None:
        self._session = session
        self._vertices: dict[str, Vertex] = {}
        self._loops: dict[tuple[str, str], records.LoopCandidate] = {}
        self._poses: dict[str, np.ndarray] = {}
        self._removed: dict[str, RemovedSubmap] = {}

    def __contains__(self, submap: str) -> bool:
        return submap in self._vertices

    @property
    def accepted_count(self) -> int:
        """Accepted loops."""
        return sum(loop.verdict == "ACCEPTED" for loop in self._loops.values())

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

    def add_vertex(self, vertex: Vertex) -> None:
        """A new sub-map; its place in the order of arrival is now."""
        self._vertices[vertex.name] = vertex

    def add_removed(self, removed: RemovedSubmap) -> None:
        """A deleted sub-map, over which odometry is carried on."""
        self._removed[removed.name] = removed

    def remove(self, submaps: Collection[str], *, keep_odometry: bool) -> None:
        """Forget sub-maps and their loops; with `keep_odometry`, not how their neighbours lie."""
        for name in submaps:
            vertex = self._vertices.pop(name, None)
            self._poses.pop(name, None)
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
        self._loops[loop.source, loop.target] = loop

    def knows_pair(self, source: str, target: str) -> bool:
        """Whether two sub-maps were paired before, in either order."""
        return (source, target) in self._loops or (target, source) in self._loops

    def remember(self, solution: PoseGraphSolution) -> None:
        """Keep a solution as the start of the next."""
        self._poses = dict(solution.world_from_anchor)

    def problem(self) -> PoseGraphProblem:
        """The graph as it is now."""
        vertices = list(self._vertices.values())
        odometry, priors = _bridged_odometry(vertices, dict(self._removed))
        accepted = [loop for loop in list(self._loops.values()) if loop.verdict == "ACCEPTED"]
        return PoseGraphProblem(
            vertices=tuple(vertex.name for vertex in vertices),
            odometry=odometry,
            loops=tuple(_loop_edge(loop) for loop in accepted),
            priors=priors,
            initial=dict(self._poses) or None,
        )

    def solved(
        self, problem: PoseGraphProblem, solution: PoseGraphSolution, revision: int
    ) -> tuple[mapping_pb.PoseSnapshot, bytes, set[tuple[str, str]]]:
        """A solution as message and bytes, and the (source, target) of the loops it relies on.

        Slow for thousands of sub-maps: call it off the event loop.
        """
        poses = {
            name: records.CorrectedPose(
                name, solution.component[name], solution.world_from_anchor[name]
            )
            for name in problem.vertices
        }
        snapshot = records.PoseSnapshot(
            session=names.session_name(self._session),
            revision=revision,
            solved_at=convert.moment(time.time()),
            poses=poses,
            components=convert.components_of(poses.values()),
            loop_count=len(problem.loops),
            loops_kept=sum(solution.kept),
        )
        message = convert.snapshot_to_proto(snapshot)
        pairs = zip(problem.loops, solution.kept, strict=True)
        # An edge's source is the loop's target: see _loop_edge.
        kept = {(edge.target, edge.source) for edge, relied_on in pairs if relied_on}
        return message, message.SerializeToString(), kept


def initial_board(session: str, stored: bytes | None) -> PoseBoard:
    """The board of a session: its stored solution, or revision 0."""
    if stored is None:
        return PoseBoard(mapping_pb.PoseSnapshot(session=names.session_name(session)))
    return PoseBoard(mapping_pb.PoseSnapshot.FromString(stored))


def _bridged_odometry(
    vertices: list[Vertex], removed: dict[str, RemovedSubmap]
) -> tuple[tuple[Edge, ...], dict[str, np.ndarray]]:
    """The odometry edges of sub-maps and their known starts, carried on over deleted ones."""
    edges, priors = [], {}
    for vertex in vertices:
        odometry, prior = bridged(vertex, removed)
        if prior is not None:
            priors[vertex.name] = prior
        if odometry is not None:
            session, agent, _ = names.parse_submap(vertex.name)
            edge = Edge(
                source=names.submap_name(session, agent, odometry.previous_index),
                target=vertex.name,
                source_from_target=odometry.previous_from_anchor,
                information=odometry.information,
            )
            edges.append(edge)
    return tuple(edges), priors


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
