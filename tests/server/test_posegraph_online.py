"""The pose graph while it grows: places at once, adjusts nearby, leaves doubt to a whole solve."""

from __future__ import annotations

import dataclasses

import numpy as np

from magic_core.geometry import se3
from magic_server.posegraph import Edge, PoseGraphConfig
from magic_server.posegraph import neighbourhood as nearby
from magic_server.posegraph.online import NewVertex, OnlineGraph
from magic_server.posegraph.simulated import INFORMATION, SIGMAS, agents_in_a_hall
from magic_server.posegraph.solve import solve_arrays

TRUSTING = PoseGraphConfig(odometry_floor_m=0, odometry_floor_rad=0, odometry_floor_share=0)


def line(count: int, *, name: str = "a") -> dict[str, np.ndarray]:
    return {
        f"{name}{i}": se3.from_rotation_translation(np.eye(3), [0.5 * i, 0.0, 0.0])
        for i in range(count)
    }


def between(a: str, b: str, truth: dict, *, noise: np.ndarray | None = None) -> Edge:
    relation = se3.inverse(truth[a]) @ truth[b]
    return Edge(a, b, relation if noise is None else relation @ se3.exp(noise), INFORMATION)


def chain(truth: dict, *, seed: int | None = None) -> list[NewVertex]:
    """Sub-maps in order, each hanging on the one before it; with noise if seeded."""
    generator = np.random.default_rng(seed)
    names = list(truth)
    noise = [None if seed is None else generator.normal(size=6) * SIGMAS for _ in names]
    return [
        NewVertex(n, between(names[i - 1], n, truth, noise=noise[i]) if i else None, group=n[0])
        for i, n in enumerate(names)
    ]


def grown(vertices: list[NewVertex]) -> OnlineGraph:
    graph = OnlineGraph(TRUSTING)
    for vertex in vertices:
        graph.advance([vertex], [])
    return graph


def test_a_new_submap_is_where_odometry_puts_it_and_moves_nothing_else():
    vertices = chain(line(5), seed=1)
    graph = grown(vertices[:4])
    before = graph.poses.copy()
    change = graph.advance(vertices[4:], [])
    assert change.vertices.tolist() == [4]
    np.testing.assert_array_equal(graph.poses[:4], before)
    edge = vertices[4].odometry
    assert edge is not None
    np.testing.assert_allclose(graph.poses[4], before[3] @ edge.source_from_target)
    assert not graph.unsettled


def test_a_loop_that_agrees_counts_at_once_and_a_whole_solve_moves_little_more():
    truth = line(12)
    graph = grown(chain(truth, seed=2))
    change = graph.advance([], [between("a1", "a11", truth)])
    assert change.taken_up.tolist() == [0]
    assert graph.unsettled
    near = graph.poses[11, :3, 3].copy()
    after = graph.advance([], [], solve_arrays(graph.arrays(), TRUSTING))
    assert not graph.unsettled
    assert len(after.taken_up) == len(after.dropped) == 0
    assert np.linalg.norm(graph.poses[11, :3, 3] - near) < 0.02
    assert np.linalg.norm(near - truth["a11"][:3, 3]) < 0.1


def test_only_a_bounded_neighbourhood_moves():
    count = 6 * nearby.SIZE
    truth = line(count)
    graph = grown(chain(truth, seed=3))
    middle = count // 2
    change = graph.advance([], [between(f"a{middle}", f"a{middle + 3}", truth)])
    assert change.taken_up.tolist() == [0]
    assert 1 < len(change.vertices) <= nearby.SIZE
    assert np.abs(change.vertices - middle).max() <= nearby.SIZE


def test_a_loop_that_contradicts_waits_for_the_whole_solve_and_is_not_believed():
    truth = line(12)
    graph = grown(chain(truth))
    wrong = Edge("a1", "a9", se3.from_rotation_translation(np.eye(3), [0, 3.0, 0]), INFORMATION)
    before = graph.poses.copy()
    change = graph.advance([], [wrong])
    assert not change
    assert graph.unsettled
    np.testing.assert_array_equal(graph.poses, before)
    change = graph.advance([], [], solve_arrays(graph.arrays(), TRUSTING))
    assert graph.kept.tolist() == [False]


def test_components_join_in_the_older_frame_once_a_whole_solve_agrees():
    truth = {**line(8), **{f"b{i}": pose for i, pose in enumerate(line(8).values())}}
    first, second = chain(line(8)), chain({n: p for n, p in truth.items() if n[0] == "b"})
    graph = grown([*first, *second])
    assert graph.members == {0: {"a": 8}, 8: {"b": 8}}
    loops = [between(f"a{i}", f"b{i}", truth) for i in (2, 3, 5)]
    assert not graph.advance([], loops).taken_up.size
    change = graph.advance([], [], solve_arrays(graph.arrays(), TRUSTING))
    assert graph.members == {0: {"a": 8, "b": 8}}
    assert set(range(8, 16)) <= set(change.vertices.tolist())  # news of each in b: the component
    np.testing.assert_allclose(graph.poses[0], np.eye(4), atol=1e-9)


def test_what_came_during_a_whole_solve_is_placed_on_top_of_it():
    truth = line(14)
    vertices = chain(truth, seed=5)
    graph = grown(vertices[:12])
    graph.advance([], [between("a0", "a11", truth)])
    arrays = graph.arrays()
    graph.advance(vertices[12:], [between("a10", "a13", truth)])
    graph.advance([], [], solve_arrays(arrays, TRUSTING))
    assert graph.kept.tolist() == [True, True]
    assert graph.unsettled  # the second loop was not part of the solve
    edge = vertices[13].odometry
    assert edge is not None
    miss = se3.inverse(graph.poses[12] @ edge.source_from_target) @ graph.poses[13]
    assert np.linalg.norm(miss[:3, 3]) < 0.1


def test_a_restored_graph_goes_on_where_it_was_and_tells_what_nobody_was_told():
    truth = line(10)
    vertices, loop = chain(truth, seed=6), between("a1", "a8", truth)
    graph = grown(vertices[:9])
    graph.advance([], [loop])
    told = {name: (graph.names[0], graph.poses[i]) for i, name in enumerate(graph.names)}
    again = OnlineGraph(TRUSTING)
    again.restore(vertices, [loop], poses=told, kept=[0], settled=True)
    assert not again.unsettled
    change = again.advance([], [])
    assert change.vertices.tolist() == [9]
    assert not len(change.taken_up)
    np.testing.assert_array_equal(again.poses[:9], graph.poses)
    assert again.members == {0: {"a": 10}}


def test_known_starts_share_one_component():
    graph = OnlineGraph(TRUSTING)
    start = se3.from_rotation_translation(np.eye(3), [3.0, 1.0, 0.0])
    graph.advance([NewVertex("a0", prior=np.eye(4), group="a")], [])
    graph.advance([NewVertex("b0", prior=start, group="b"), NewVertex("c0", group="c")], [])
    assert graph.component.tolist() == [0, 0, 2]
    np.testing.assert_array_equal(graph.poses[1], start)


def test_a_loop_may_not_move_a_map_far_at_once():
    truth = line(12)
    cautious = dataclasses.replace(TRUSTING, max_unsupported_correction_m=0.02)
    graph = OnlineGraph(cautious)
    graph.advance(chain(truth, seed=7), [])
    assert not graph.advance([], [between("a0", "a11", truth)]).taken_up.size
    assert graph.unsettled


def test_many_agents_arriving_interleaved_end_where_one_solve_of_all_ends():
    simulation = agents_in_a_hall(agents=3, submaps=30, loops=150, seed=1, side_m=15.0)
    problem = simulation.problem
    order = [f"agent_{a}/{i}" for i in range(30) for a in range(3)]
    age = {name: number for number, name in enumerate(order)}
    odometry = {edge.target: edge for edge in problem.odometry}
    graph = OnlineGraph(TRUSTING)
    at_once = 0
    for number, name in enumerate(order):
        loops = [e for e in problem.loops if max(e.source, e.target, key=age.get) == name]  # type: ignore[arg-type]
        vertex = NewVertex(name, odometry.get(name), group=name.split("/", maxsplit=1)[0])
        at_once += len(graph.advance([vertex], loops).taken_up)
        if number % 10 == 9:
            graph.advance([], [], solve_arrays(graph.arrays(), TRUSTING))
    graph.advance([], [], solve_arrays(graph.arrays(), TRUSTING))
    fresh = dataclasses.replace(graph.arrays(), initial=None)
    expected = solve_arrays(fresh, TRUSTING)
    assert at_once > 0.5 * len(problem.loops)
    assert len(graph.members) == 1
    assert graph.kept.mean() > 0.95
    np.testing.assert_allclose(graph.poses[:, :3, 3], expected.poses[:, :3, 3], atol=0.02)
