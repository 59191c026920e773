"""Large graphs by regions: the optimum of the whole, found from what changed."""

from __future__ import annotations

import copy
import dataclasses

import numpy as np
import pytest

from magic_core.errors import ConfigError
from magic_core.geometry import se3
from magic_server.posegraph import (
    Edge,
    PoseGraphConfig,
    PoseGraphProblem,
    hierarchy,
    packed,
    stacked,
)
from magic_server.posegraph import settlement as exact
from magic_server.posegraph.arrays import EdgeArrays
from magic_server.posegraph.dissection import Dissection
from magic_server.posegraph.gnc import RobustGraph
from magic_server.posegraph.hierarchy import Hierarchy
from magic_server.posegraph.online import NewVertex, OnlineGraph
from magic_server.posegraph.simulated import INFORMATION, SIGMAS, agents_in_a_hall
from magic_server.posegraph.solve import solve, solve_arrays
from magic_server.posegraph.tension import Tension

REGIONAL = PoseGraphConfig(
    odometry_floor_m=0, odometry_floor_rad=0, odometry_floor_share=0, hierarchy="on"
)
WHOLE = dataclasses.replace(REGIONAL, hierarchy="off")
NO_LOOPS = EdgeArrays.of([], {})


@pytest.fixture(autouse=True)
def small_regions(monkeypatch):
    monkeypatch.setattr(hierarchy, "REGION", 12)


def hall(*, agents: int = 4, submaps: int = 75, loops: int = 300, seed: int = 1):
    """Poses near the optimum in order of arrival, all edges, the newer end of each."""
    problem = agents_in_a_hall(
        agents=agents, submaps=submaps, loops=loops, seed=seed, side_m=20.0
    ).problem
    solution = solve(problem, WHOLE)
    order = [f"agent_{a}/{i}" for i in range(submaps) for a in range(agents)]
    number = {name: index for index, name in enumerate(order)}
    kept = [loop for loop, is_kept in zip(problem.loops, solution.kept, strict=True) if is_kept]
    edges = EdgeArrays.of([*problem.odometry, *kept], number)
    return np.array([solution.world_from_anchor[name] for name in order]), edges


def optimum(edges: EdgeArrays, start: np.ndarray) -> np.ndarray:
    graph = RobustGraph(edges, NO_LOOPS, {0: start[0]})
    return graph.solve(start, np.zeros(0), max_iterations=50, tolerance=1e-12)


def apart_m(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.linalg.norm(a[:, :3, 3] - b[:, :3, 3], axis=1).max())


def condensed(poses: np.ndarray, edges: EdgeArrays, held: set[int]) -> Hierarchy:
    graph = Hierarchy(poses, edges, held)
    while not graph.condense(poses, at_most=10):
        pass
    return graph


def settled(graph: Hierarchy, poses: np.ndarray) -> None:
    """Steps against all that pulls, with old matrices renewed a few at a time."""
    for _ in range(12):
        graph.settle(poses, limit=np.inf, wholly=True)


def bent(poses: np.ndarray, by_m: float) -> np.ndarray:
    result = poses.copy()
    result[1:, 0, 3] += by_m * np.sin(poses[1:, 1, 3])
    return result


def test_regions_meet_only_in_separators():
    poses, edges = hall()
    tree = Dissection.of(poses[:, :3, 3], edges.source, edges.target, 12)
    assert sorted(v for node in tree.nodes for v in node.own) == list(range(len(poses)))
    assert all(len(node.own) <= 12 for node in tree.nodes if not node.children)
    assert tree.regions > 10
    for a, b in zip(edges.source.tolist(), edges.target.tolist(), strict=True):
        left, right = tree.node_of[a], tree.node_of[b]
        assert left in tree.path(right) or right in tree.path(left)


def test_finds_the_optimum_that_gtsam_finds():
    poses, edges = hall()
    expected = optimum(edges, poses)
    found = bent(expected, 0.1)
    settled(condensed(found, edges, {0}), found)
    assert apart_m(bent(expected, 0.1), expected) > 0.05
    assert apart_m(found, expected) < 1e-4


def test_a_graph_that_grows_stays_at_the_optimum_of_the_whole():
    poses, edges = hall()
    count, base = len(poses), len(poses) - 40
    newer = np.maximum(edges.source, edges.target)
    found = poses[:base].copy()
    graph = condensed(found, edges.select(newer < base), {0})
    settled(graph, found)
    regions = graph.regions
    for vertex in range(base, count):
        own = np.flatnonzero(newer == vertex)
        edge = edges.select(own[:1])  # odometry comes first
        before = int(edge.source[0])
        found = np.concatenate([found, found[[before]] @ edge.source_from_target])
        graph.add_vertex(before, found[-1])
        for number in own.tolist():
            graph.add_edge(edges.select(np.array([number])))
        graph.settle(found, limit=np.inf)
    expected = optimum(edges, poses)
    assert graph.regions >= regions
    assert apart_m(found, expected) < 0.03  # poses are sure of some 10 cm here
    settled(graph, found)
    assert apart_m(found, expected) < 1e-4


def test_a_region_that_grows_is_cut_in_two():
    generator = np.random.default_rng(4)
    step = se3.from_rotation_translation(np.eye(3), [0.5, 0.0, 0.0])
    poses = np.eye(4)[None]
    graph = condensed(poses, NO_LOOPS, {0})
    for vertex in range(1, 80):
        noise = se3.exp(generator.normal(size=6) * SIGMAS)
        edge = Edge(str(vertex - 1), str(vertex), step @ noise, INFORMATION)
        arrays = EdgeArrays.of([edge], {str(vertex - 1): vertex - 1, str(vertex): vertex})
        poses = np.concatenate([poses, poses[-1:] @ arrays.source_from_target])
        graph.add_vertex(vertex - 1, poses[-1])
        graph.add_edge(arrays)
        graph.settle(poses, limit=np.inf)
    assert graph.regions > 3


def test_a_removed_edge_pulls_no_more():
    poses, edges = hall()
    aside = se3.from_rotation_translation(np.eye(3), [0.5, 0.0, 0.0])
    relation = se3.inverse(poses[3]) @ poses[250] @ aside
    wrong = EdgeArrays(np.array([3]), np.array([250]), relation[None], INFORMATION[None])
    found = poses.copy()
    graph = condensed(found, edges, {0})
    settled(graph, found)
    number = graph.add_edge(wrong)
    settled(graph, found)
    expected = optimum(edges, poses)
    assert apart_m(found, expected) > 0.05
    graph.remove_edge(number)
    settled(graph, found)
    assert apart_m(found, expected) < 1e-4


def test_edges_beyond_their_limit_are_named():
    poses, edges = hall()
    far = se3.from_rotation_translation(np.eye(3), [30.0, 0, 0])[None]
    graph = condensed(poses, edges, {0})
    settled(graph, poses)
    number = graph.add_edge(EdgeArrays(np.array([3]), np.array([250]), far, INFORMATION[None]))
    assert number in graph.settle(poses, limit=22.0).strained.tolist()


def test_held_vertices_stay():
    poses, edges = hall()
    held = {0, 100}
    found = bent(poses, 0.05)
    graph = condensed(found, edges, held)
    before = found[[0, 100]].copy()
    settled(graph, found)
    np.testing.assert_allclose(found[[0, 100]], before, atol=1e-5)


def arriving(problem: PoseGraphProblem, agents: int, submaps: int):
    """Each sub-map with the loops to older ones, the agents in turns."""
    order = [f"agent_{a}/{i}" for i in range(submaps) for a in range(agents)]
    age = {name: number for number, name in enumerate(order)}
    odometry = {edge.target: edge for edge in problem.odometry}
    loops: dict[str, list[Edge]] = {}
    for edge in problem.loops:
        loops.setdefault(max(edge.source, edge.target, key=lambda n: age[n]), []).append(edge)
    for name in order:
        group = name.split("/", maxsplit=1)[0]
        yield NewVertex(name, odometry.get(name), group=group), loops.get(name, [])


def online(config: PoseGraphConfig) -> OnlineGraph:
    """Three agents that begin apart, one loop that is wrong, whole solves where asked for."""
    problem = agents_in_a_hall(agents=3, submaps=40, loops=160, seed=2, side_m=10.0).problem
    relation = se3.from_rotation_translation(np.eye(3), [0, 4.0, 0])
    wrong = Edge("agent_0/5", "agent_1/20", relation, INFORMATION)
    graph = OnlineGraph(config)
    for arrival, (vertex, loops) in enumerate(arriving(problem, 3, 40)):
        graph.advance([vertex], [*loops, wrong] if vertex.name == "agent_1/21" else loops)
        if graph.unsettled and arrival % 30 == 29:
            graph.advance([], [], solve_arrays(graph.arrays(), config))
        if graph.is_uncondensed:
            graph.advance([], [], regions=graph.outline().condensed())
    graph.advance([], [], solve_arrays(graph.arrays(), config))
    if graph.is_uncondensed:
        graph.advance([], [], regions=graph.outline().condensed())
    return graph


@pytest.fixture(scope="module")
def regional_graph() -> OnlineGraph:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(hierarchy, "REGION", 12)
        return online(REGIONAL)


def test_agents_that_meet_and_a_wrong_loop_end_as_in_one_solve_of_all(regional_graph):
    regional, whole = regional_graph, online(WHOLE)
    assert len(regional.members) == len(whole.members) == 1
    rejected = [regional.loop(n) for n in np.flatnonzero(~regional.kept).tolist()]
    assert ("agent_0/5", "agent_1/20") in [(edge.source, edge.target) for edge in rejected]
    np.testing.assert_array_equal(regional.kept, whole.kept)
    assert apart_m(regional.poses, whole.poses) < 0.01


@pytest.mark.slow
def test_growing_by_regions_gives_the_same_every_time(regional_graph):
    first, second = regional_graph, online(REGIONAL)
    np.testing.assert_array_equal(first.kept, second.kept)
    np.testing.assert_allclose(first.poses, second.poses, atol=1e-6)


def test_a_loop_that_is_taken_up_leaves_nothing_to_a_whole_solve(regional_graph):
    regional = copy.deepcopy(regional_graph)
    far, last = "agent_0/3", regional.names[-1]
    a, b = regional.poses[regional.number[far]], regional.poses[regional.number[last]]
    noise = stacked.exp(0.3 * SIGMAS[None])[0]
    change = regional.advance([], [Edge(far, last, se3.inverse(a) @ b @ noise, INFORMATION)])
    assert len(change.taken_up) == 1
    assert not regional.unsettled
    expected = solve_arrays(regional.arrays(), WHOLE)
    assert apart_m(regional.poses, expected.poses) < 0.01


def good_loop(graph: OnlineGraph, source: str, target: str) -> Edge:
    """What a good registration says, seen from the present estimate."""
    a, b = graph.poses[graph.number[source]], graph.poses[graph.number[target]]
    noise = stacked.exp(0.3 * SIGMAS[None])[0]
    return Edge(source, target, se3.inverse(a) @ b @ noise, INFORMATION)


def missed_m(graph: OnlineGraph) -> float:
    """How far the farthest sub-map is from the optimum of what counts."""
    asked = copy.deepcopy(graph).counted()
    return apart_m(graph.poses, exact.settled(asked).poses)


def following(graph: OnlineGraph, name: str, *, of: str) -> NewVertex:
    step = se3.from_rotation_translation(np.eye(3), [0.5, 0.0, 0.0])
    return NewVertex(name, Edge(of, name, step, INFORMATION), group=of.split("/", maxsplit=1)[0])


def test_what_arrives_during_an_exact_solve_is_neither_lost_nor_thrown_back(regional_graph):
    graph = copy.deepcopy(regional_graph)
    graph.advance([], [good_loop(graph, "agent_0/3", "agent_1/39")])
    assert graph.bent
    asked = graph.counted()
    assert not graph.bent
    graph.advance([following(graph, "agent_2/40", of="agent_2/39")], [])
    graph.advance([], [good_loop(graph, "agent_1/5", "agent_2/40")])
    before = graph.poses.copy()
    change = graph.advance([], [], exact.settled(asked))
    assert graph.kept[-2:].all()
    assert not len(change.dropped)
    assert graph.bent  # the second loop was not part of the solve
    assert apart_m(graph.poses, before) < 0.02
    assert missed_m(graph) < 0.02
    graph.advance([], [], exact.settled(graph.counted()))
    assert not graph.bent
    assert missed_m(graph) < 1e-4


def test_regions_that_were_condensed_while_the_graph_grew_know_all_of_it(regional_graph):
    graph = copy.deepcopy(regional_graph)
    outline = graph.outline()
    graph.advance([following(graph, "agent_2/40", of="agent_2/39")], [])
    graph.advance([], [good_loop(graph, "agent_1/5", "agent_2/40")])
    before = graph.regions
    graph.advance([], [], regions=outline.condensed())
    assert graph.regions is not before
    assert graph.regions is not None
    assert len(graph.regions) == len(graph)
    edges = copy.deepcopy(graph).counted().edges
    assert graph.regions.cost == pytest.approx(0.5 * edges.squared_norms(graph.poses).sum())
    graph.advance([], [good_loop(graph, "agent_0/3", "agent_1/30")])
    assert graph.kept[-2:].all()
    assert missed_m(graph) < 0.02


def test_loops_count_at_once_while_regions_are_still_being_condensed(regional_graph):
    graph = copy.deepcopy(regional_graph)
    graph._regions = None  # as after a restart
    assert graph.is_uncondensed
    change = graph.advance([], [good_loop(graph, "agent_0/3", "agent_0/8")])
    assert len(change.taken_up) == 1
    assert graph.bent
    assert not graph.unsettled
    graph.advance([], [], exact.settled(graph.counted()))
    assert missed_m(graph) < 1e-4


def test_a_robust_solve_that_joins_agents_has_all_condensed_anew():
    problem = agents_in_a_hall(agents=2, submaps=30, loops=80, seed=5, side_m=8.0).problem
    graph = OnlineGraph(REGIONAL)
    loops = []
    for vertex, own in arriving(problem, 2, 30):
        graph.advance([vertex], [])
        loops += own
    graph.advance([], [], regions=graph.outline().condensed())
    assert graph.regions is not None
    graph.advance([], loops)
    assert graph.unsettled
    old, asked = graph.outline(), graph.arrays()
    graph.advance([following(graph, "agent_1/30", of="agent_1/29")], [])
    graph.advance([], [], solve_arrays(asked, REGIONAL))
    assert graph.members == {0: {"agent_0": 30, "agent_1": 31}}
    assert graph.is_uncondensed
    graph.advance([], [], regions=old.condensed())
    assert graph.is_uncondensed  # they were regions of another graph
    graph.advance([], [], regions=graph.outline().condensed())
    assert not graph.is_uncondensed
    assert missed_m(graph) < 1e-3


def test_poses_stay_rigid_however_often_solves_are_carried_over():
    poses, _ = hall()
    previous = np.full(len(poses), -1)
    solved = poses[:-5] @ stacked.exp(np.tile(0.01 * SIGMAS, (len(poses) - 5, 1)))
    found = poses
    for _ in range(60):
        found = exact.carried(found, found[:-5], solved, previous)
    gram = found[:, :3, :3].swapaxes(1, 2) @ found[:, :3, :3]
    np.testing.assert_allclose(gram, np.tile(np.eye(3), (len(poses), 1, 1)), atol=1e-12)


def test_settling_never_makes_edges_worse():
    poses, edges = hall()
    far = se3.inverse(poses[3]) @ poses[250]
    far[:3, 3] += [6.0, -4.0, 1.0]
    found = poses.copy()
    graph = condensed(found, edges, {0})
    settled(graph, found)
    graph.add_edge(EdgeArrays(np.array([3]), np.array([250]), far[None], INFORMATION[None]))
    graph.settle(found, limit=np.inf)
    for _ in range(5):
        before = graph.cost
        graph.settle(found, limit=np.inf, wholly=True)
        assert graph.cost <= before + 1e-5


def test_edges_pull_by_the_gradient_of_their_error():
    poses, edges = hall(agents=1, submaps=12, loops=6)
    poses = bent(poses, 0.3)
    tension = Tension()
    tension.add_vertices(len(poses))
    tension.add(edges)
    tension.refresh(np.arange(len(edges)), poses)
    assert tension.cost == pytest.approx(0.5 * edges.squared_norms(poses).sum())
    step = 1e-6
    for vertex in range(len(poses)):
        for axis in range(6):
            tangent = np.zeros((1, 6))
            tangent[0, axis] = step
            costs = []
            for sign in (1.0, -1.0):
                moved = poses.copy()
                moved[vertex] = poses[vertex] @ stacked.exp(sign * tangent)[0]
                costs.append(0.5 * edges.squared_norms(moved).sum())
            slope = (costs[0] - costs[1]) / (2.0 * step)
            assert tension.gradient[vertex, axis] == pytest.approx(slope, rel=1e-3, abs=0.5)


@pytest.mark.parametrize("size", [1, 2, 7])
def test_a_packed_triangle_is_the_matrix_it_was(size):
    generator = np.random.default_rng(size)
    square = generator.normal(size=(size, size))
    matrix = square + square.T + 2.0 * size * np.eye(size)
    triangle = packed.lower(matrix)
    np.testing.assert_array_equal(packed.symmetric(triangle, size), matrix)
    np.testing.assert_array_equal(packed.diagonal(triangle, size), np.diagonal(matrix))
    factor = np.tril(matrix)
    rhs = generator.normal(size=size).astype(np.float32)
    half = packed.solved(packed.lower(factor).astype(np.float32), rhs)
    np.testing.assert_allclose(factor @ half, rhs, atol=1e-4)
    other = packed.solved(packed.lower(factor).astype(np.float32), rhs, transposed=True)
    np.testing.assert_allclose(factor.T @ other, rhs, atol=1e-4)


def test_small_graphs_are_left_as_they_were():
    assert not PoseGraphConfig().is_hierarchical(9999)
    assert PoseGraphConfig().is_hierarchical(10_000)
    assert not WHOLE.is_hierarchical(10**6)
    with pytest.raises(ConfigError, match=r"posegraph\.hierarchy"):
        PoseGraphConfig(hierarchy="maybe")  # type: ignore[arg-type]
