"""A session's pose graph in memory: sub-maps, odometry, loops, and the last solution."""

from __future__ import annotations

import time

import numpy as np
from magicslam.v1 import mapping_service_pb2 as mapping_pb

from magic_core.wire import convert, names, records
from magic_server.poseboard import PoseBoard
from magic_server.posegraph import Edge, PoseGraphProblem, PoseGraphSolution
from magic_server.store import Vertex


class SessionGraph:
    """What the solver needs to know about a session."""

    def __init__(self, session: str) -> None:
        self._session = session
        self._vertices: dict[str, Vertex] = {}
        self._loops: dict[tuple[str, str], records.LoopCandidate] = {}
        self._poses: dict[str, np.ndarray] = {}

    @property
    def accepted_count(self) -> int:
        """Accepted loops."""
        return sum(loop.verdict == "ACCEPTED" for loop in self._loops.values())

    def names_of(self, agent: str) -> set[str]:
        """The sub-maps of an agent, all by resource name."""
        return {vertex.name for vertex in self._vertices.values() if vertex.agent == agent}

    def add_vertex(self, vertex: Vertex) -> None:
        """A new sub-map; its place in the order of arrival is now."""
        self._vertices[vertex.name] = vertex

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
        accepted = [loop for loop in list(self._loops.values()) if loop.verdict == "ACCEPTED"]
        return PoseGraphProblem(
            vertices=tuple(vertex.name for vertex in vertices),
            odometry=tuple(edge for vertex in vertices if (edge := _odometry(vertex))),
            loops=tuple(_loop_edge(loop) for loop in accepted),
            priors={v.name: v.prior for v in vertices if v.prior is not None},
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


def _odometry(vertex: Vertex) -> Edge | None:
    if vertex.odometry is None:
        return None
    session, agent, _ = names.parse_submap(vertex.name)
    return Edge(
        source=names.submap_name(session, agent, vertex.odometry.previous_index),
        target=vertex.name,
        source_from_target=vertex.odometry.previous_from_anchor,
        information=vertex.odometry.information,
    )


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
