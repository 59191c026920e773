"""The pose graph: gauges, components, unknown starts, wrong loops, noise that was understated."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from magic_core.errors import ConfigError, InvalidInput
from magic_core.geometry import se3
from magic_server.posegraph import Edge, PoseGraphConfig, PoseGraphProblem, stacked
from magic_server.posegraph.arrays import EdgeArrays
from magic_server.posegraph.bodies import bodies_of
from magic_server.posegraph.chains import follow
from magic_server.posegraph.optimiser import (
    FactorCache,
    anchored,
    optimise,
    poses_of,
    values_of,
)
from magic_server.posegraph.simulated import (
    INFORMATION,
    SIGMAS,
    agents_in_a_hall,
    with_wrong_loops,
)
from magic_server.posegraph.solve import solve

TRUSTING = PoseGraphConfig(odometry_floor_m=0, odometry_floor_rad=0, odometry_floor_share=0)


def random_pose(generator: np.random.Generator, spread: float = 1.0) -> np.ndarray:
    return se3.exp(generator.normal(size=6) * spread)


def edge(source: str, target: str, truth: dict, information=INFORMATION, noise=None) -> Edge:
    relation = se3.inverse(truth[source]) @ truth[target]
    return Edge(source, target, relation if noise is None else relation @ noise, information)


def circle(name: str, count: int, centre: tuple[float, float]) -> dict[str, np.ndarray]:
    """Poses along a circle of 3 m, looking along it."""
    poses = {}
    for index in range(count):
        angle = 2 * np.pi * index / count
        rotation = se3.rotation_exp([0, 0, angle])
        position = [centre[0] + 3 * np.cos(angle), centre[1] + 3 * np.sin(angle), 0.0]
        poses[f"{name}{index}"] = se3.from_rotation_translation(rotation, position)
    return poses


def two_circles(seed: int = 0, scale: float = 1.0):
    """Two agents, 12 sub-maps each, on circles that share a stretch; loops within and between."""
    generator = np.random.default_rng(seed)
    truth = {**circle("a", 12, (0.0, 0.0)), **circle("b", 12, (0.5, 0.3))}

    def noisy(source: str, target: str) -> Edge:
        noise = se3.exp(generator.normal(size=6) * SIGMAS * scale)
        return edge(source, target, truth, noise=noise)

    odometry = [noisy(f"{n}{i}", f"{n}{i + 1}") for n in "ab" for i in range(11)]
    loops = [noisy(f"{n}0", f"{n}11") for n in "ab"] + [noisy(f"a{i}", f"b{i}") for i in range(12)]
    problem = PoseGraphProblem(tuple(truth), tuple(odometry), tuple(loops))
    return problem, truth


def worst_error_m(solution, truth: dict, gauge: str) -> float:
    frame = truth[gauge] @ se3.inverse(solution.world_from_anchor[gauge])
    return max(
        float(np.linalg.norm((frame @ solution.world_from_anchor[name])[:3, 3] - pose[:3, 3]))
        for name, pose in truth.items()
    )


def root_mean_square_m(solution, truth: dict) -> float:
    """ATE after the best rigid alignment."""
    found = np.array([solution.world_from_anchor[name][:3, 3] for name in truth])
    expected = np.array([pose[:3, 3] for pose in truth.values()])
    a, b = found - found.mean(axis=0), expected - expected.mean(axis=0)
    u, _, vt = np.linalg.svd(b.T @ a)
    rotation = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    return float(np.sqrt(((a @ rotation.T - b) ** 2).sum(axis=1).mean()))


@pytest.mark.parametrize("size", [1e-9, 1e-6, 1e-3, 0.3, 2.0])
def test_stacked_logarithm_is_the_one_of_se3(size):
    generator = np.random.default_rng(0)
    vectors = generator.normal(size=(40, 6)) * size
    vectors[:, 3:] *= np.minimum(1.0, 3.1 / np.linalg.norm(vectors[:, 3:], axis=1, keepdims=True))
    transforms = np.array([se3.exp(vector) for vector in vectors])
    np.testing.assert_allclose(stacked.log(transforms), vectors, rtol=1e-7, atol=1e-12)


def test_stacked_logarithm_near_half_a_turn():
    axes = np.random.default_rng(1).normal(size=(30, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    vectors = np.concatenate([np.ones((30, 3)), axes * (np.pi - 1e-7)], axis=1)
    transforms = np.array([se3.exp(vector) for vector in vectors])
    np.testing.assert_allclose(stacked.log(transforms), vectors, atol=1e-7)


def test_error_is_gtsams_error_with_the_order_permuted():
    generator = np.random.default_rng(2)
    poses = np.array([random_pose(generator) for _ in range(6)])
    roots = generator.normal(size=(5, 6, 6))
    edges = EdgeArrays(
        np.arange(5),
        np.arange(1, 6),
        np.array([random_pose(generator) for _ in range(5)]),
        roots @ roots.swapaxes(1, 2) + np.diag([1, 2, 3, 40, 50, 60.0]),
    )
    graph = gtsam.NonlinearFactorGraph()
    cache = FactorCache(edges)
    for index in range(5):
        graph.add(cache.factor(index))
    ours = 0.5 * edges.squared_norms(poses).sum()
    assert ours == pytest.approx(graph.error(values_of(poses)), rel=1e-9)


def test_information_is_translation_first():
    loose_x = np.diag([1e-2, 1e4, 1e4, 1e4, 1e4, 1e4])
    tight = np.eye(6) * 1e4
    shift = se3.from_rotation_translation(np.eye(3), [1.0, 0.0, 0.0])
    shifted = se3.from_rotation_translation(np.eye(3), [2.0, 0.0, 0.0])
    problem = PoseGraphProblem(
        ("a", "b"),
        odometry=(Edge("a", "b", shift, loose_x),),
        loops=(Edge("a", "b", shifted, tight),),
    )
    solution = solve(problem, replace(TRUSTING, robust="none"))
    assert solution.world_from_anchor["b"][0, 3] == pytest.approx(2.0, abs=1e-4)


def test_agents_without_common_loops_stay_apart_each_in_its_own_frame():
    problem, truth = two_circles()
    apart = tuple(e for e in problem.loops if e.source[0] == e.target[0])
    solution = solve(replace(problem, loops=apart), TRUSTING)
    assert {solution.component[name] for name in truth} == {"a0", "b0"}
    for oldest in ("a0", "b0"):
        np.testing.assert_allclose(solution.world_from_anchor[oldest], np.eye(4), atol=1e-9)


def test_loops_join_agents_in_the_frame_of_the_oldest():
    problem, truth = two_circles()
    solution = solve(problem, TRUSTING)
    assert set(solution.component.values()) == {"a0"}
    assert all(solution.kept)
    np.testing.assert_allclose(solution.world_from_anchor["a0"], np.eye(4), atol=1e-6)
    assert worst_error_m(solution, truth, "a0") < 0.3  # sigma 5 cm and 0.01 rad per edge
    assert solution.error_after < solution.error_before


def test_the_older_frame_wins_whatever_the_names():
    problem, _ = two_circles()
    order = tuple(n for n in problem.vertices if n[0] == "b") + tuple(
        n for n in problem.vertices if n[0] == "a"
    )
    solution = solve(replace(problem, vertices=order), TRUSTING)
    assert set(solution.component.values()) == {"b0"}
    np.testing.assert_allclose(solution.world_from_anchor["b0"], np.eye(4), atol=1e-6)


def test_known_starts_hold_and_share_one_world_without_loops():
    problem, truth = two_circles()
    priors = {"a0": truth["a0"], "b0": truth["b0"]}
    solution = solve(replace(problem, loops=(), priors=priors), TRUSTING)
    assert set(solution.component.values()) == {"a0"}
    for name, pose in priors.items():
        np.testing.assert_allclose(solution.world_from_anchor[name], pose, atol=1e-6)


def test_one_wrong_loop_is_left_out_and_bends_nothing():
    problem, truth = two_circles()
    wrong = Edge("a2", "b8", se3.exp([0.2, 0.1, 0, 0, 0, 0.5]), INFORMATION)
    spoiled = replace(problem, loops=(*problem.loops[:5], wrong, *problem.loops[5:]))
    solution = solve(spoiled, TRUSTING)
    assert [i for i, kept in enumerate(solution.kept) if not kept] == [5]
    clean = solve(problem, TRUSTING)
    for name in truth:
        np.testing.assert_allclose(
            solution.world_from_anchor[name], clean.world_from_anchor[name], atol=1e-4
        )


def test_without_robustness_every_loop_is_kept():
    problem, _ = two_circles()
    wrong = Edge("a2", "b8", se3.exp([0.2, 0.1, 0, 0, 0, 0.5]), INFORMATION)
    solution = solve(
        replace(problem, loops=(*problem.loops, wrong)), replace(TRUSTING, robust="none")
    )
    assert all(solution.kept)
    assert solution.error_after > 100


@pytest.mark.parametrize("kind", ["random", "groups"])
@pytest.mark.parametrize("share", [0.2, 0.6])
def test_wrong_loops_are_found_among_several_agents(kind, share):
    simulation = agents_in_a_hall(agents=4, submaps=80, loops=500, seed=3, side_m=25.0)
    spoiled, wrong = with_wrong_loops(
        simulation.problem, share=share, kind=kind, seed=5, group_size=6
    )
    solution = solve(spoiled, TRUSTING)
    clean = solve(simulation.problem, TRUSTING)
    kept = np.array(solution.kept)
    assert not (kept & wrong).any()
    assert kept[~wrong].mean() >= 0.95
    limit = 1.5 * root_mean_square_m(clean, simulation.truth)
    assert root_mean_square_m(solution, simulation.truth) <= limit


def test_understated_noise_does_not_cost_the_right_loops():
    problem, truth = two_circles(seed=4, scale=4.0)
    solution = solve(problem, TRUSTING)
    assert np.mean(solution.kept) >= 0.85
    assert set(solution.component.values()) == {"a0"}
    assert worst_error_m(solution, truth, "a0") < 1.2


def test_an_earlier_solution_is_continued_to_the_same_result():
    problem, _ = two_circles()
    first = solve(problem, TRUSTING)
    again = solve(replace(problem, initial=first.world_from_anchor), TRUSTING)
    assert again.kept == first.kept
    for name, pose in first.world_from_anchor.items():
        np.testing.assert_allclose(again.world_from_anchor[name], pose, atol=1e-5)
    assert again.error_before == pytest.approx(first.error_after, rel=1e-4)


def test_a_rejected_loop_is_taken_up_when_others_come_to_support_it():
    problem, truth = two_circles()
    within = tuple(e for e in problem.loops if e.source[0] == e.target[0])
    between = tuple(e for e in problem.loops if e.source[0] != e.target[0])
    alias = tuple(
        Edge(f"a{i}", f"b{i + 5}", se3.inverse(truth[f"a{i}"]) @ se3.exp([4, 0, 0, 0, 0, 1.0])
             @ truth[f"b{i + 5}"], INFORMATION) for i in range(3)
    )  # fmt: skip
    fooled = solve(replace(problem, loops=within + alias + between[:1]), TRUSTING)
    assert not fooled.kept[-1]
    later = replace(problem, loops=within + alias + between, initial=fooled.world_from_anchor)
    solution = solve(later, TRUSTING)
    assert not any(solution.kept[2:5])
    assert all(solution.kept[5:])


def straight_line(count: int = 20) -> dict[str, np.ndarray]:
    return {
        f"a{i}": se3.from_rotation_translation(np.eye(3), [0.5 * i, 0.0, 0.0]) for i in range(count)
    }


def test_one_witness_may_not_move_a_map_far_but_two_may():
    truth = straight_line()
    tight = np.diag([1e6] * 6)
    odometry = tuple(edge(f"a{i}", f"a{i + 1}", truth, information=tight) for i in range(19))
    # Both say that the way's end lies 2 m beside where precise odometry puts it.
    beside = se3.from_rotation_translation(np.eye(3), [0.0, 2.0, 0.0])
    claims = tuple(
        Edge(f"a{i}", f"a{j}", se3.inverse(truth[f"a{i}"]) @ beside @ truth[f"a{j}"], tight)
        for i, j in ((0, 18), (1, 19), (2, 17))
    )
    config = replace(TRUSTING, odometry_floor_m=0.01)
    alone = solve(PoseGraphProblem(tuple(truth), odometry, claims[:1]), config)
    assert alone.kept == (False,)
    assert worst_error_m(alone, truth, "a0") < 1e-3
    together = solve(PoseGraphProblem(tuple(truth), odometry, claims), config)
    assert together.kept == (True, True, True)


def test_a_lone_loop_corrects_drift_that_odometry_explains():
    truth = straight_line()
    generator = np.random.default_rng(1)
    odometry = tuple(
        edge(f"a{i}", f"a{i + 1}", truth, noise=se3.exp(generator.normal(size=6) * SIGMAS))
        for i in range(19)
    )
    loop = edge("a0", "a19", truth, information=np.diag([1e6] * 6))
    before = solve(PoseGraphProblem(tuple(truth), odometry), TRUSTING)
    after = solve(PoseGraphProblem(tuple(truth), odometry, (loop,)), TRUSTING)
    assert after.kept == (True,)
    error = [np.linalg.norm(s.world_from_anchor["a19"][:3, 3] - truth["a19"][:3, 3]) for s in
             (before, after)]  # fmt: skip
    assert error[1] < 0.05 * error[0]


def test_new_submaps_extend_an_earlier_solution():
    problem, truth = two_circles()
    earlier = solve(problem, TRUSTING)
    generator = np.random.default_rng(8)
    truth = {**truth, "a12": truth["a11"] @ se3.exp([0.5, 0, 0, 0, 0, 0.2])}
    extended = replace(
        problem,
        vertices=(*problem.vertices, "a12"),
        odometry=(
            *problem.odometry,
            edge("a11", "a12", truth, noise=se3.exp(generator.normal(size=6) * SIGMAS)),
        ),
        initial=earlier.world_from_anchor,
    )
    solution = solve(extended, TRUSTING)
    assert solution.component["a12"] == "a0"
    assert worst_error_m(solution, truth, "a0") < 0.4


def test_chordal_start_is_not_needed_where_the_graph_is_under_constrained():
    blind = np.diag([1e4, 1e4, 0.0, 0.0, 0.0, 1e4])  # no height, roll or pitch
    truth = circle("a", 8, (0, 0))
    edges = [edge(f"a{i}", f"a{i + 1}", truth, information=blind) for i in range(7)]
    loop = edge("a0", "a7", truth, information=blind)
    problem = PoseGraphProblem(tuple(truth), tuple(edges), (loop,))
    for robust in ("none", "gnc"):
        solution = solve(problem, replace(TRUSTING, robust=robust))
        assert solution.error_after < 1e-6
        assert worst_error_m(solution, truth, "a0") < 1e-3


def test_optimise_never_ends_above_its_start():
    problem, truth = two_circles()
    number = {name: index for index, name in enumerate(problem.vertices)}
    edges = EdgeArrays.of(problem.odometry + problem.loops, number)
    graph = anchored({0: truth["a0"]})
    cache = FactorCache(edges)
    for index in range(len(edges)):
        graph.add(cache.factor(index))
    start = np.array(list(truth.values()))
    found = poses_of(optimise(graph, values_of(start), max_iterations=30), len(start))
    assert edges.squared_norms(found).sum() <= edges.squared_norms(start).sum()


def test_gauss_newton_that_goes_up_gives_way_to_damped_steps():
    """Far from the optimum a whole step overshoots; the result must still go down."""
    generator = np.random.default_rng(3)
    truth = [random_pose(generator, 2.0) for _ in range(12)]
    pairs = [(i, j) for i in range(12) for j in range(i)]
    edges = EdgeArrays(
        np.array([i for i, _ in pairs]),
        np.array([j for _, j in pairs]),
        np.array([se3.inverse(truth[i]) @ truth[j] for i, j in pairs]),
        np.tile(INFORMATION, (len(pairs), 1, 1)),
    )
    graph = anchored({0: truth[0]})
    cache = FactorCache(edges)
    for index in range(len(edges)):
        graph.add(cache.factor(index))
    starts = [np.array([truth[0], *(random_pose(generator, 2.0) for _ in range(11))])
              for _ in range(10)]  # fmt: skip
    for start in starts:
        found = poses_of(optimise(graph, values_of(start), max_iterations=5), len(start))
        assert edges.squared_norms(found).sum() < 0.9 * edges.squared_norms(start).sum()


def test_loops_between_bodies_say_what_they_say_between_vertices():
    simulation = agents_in_a_hall(agents=2, submaps=30, loops=40)
    number = {name: index for index, name in enumerate(simulation.problem.vertices)}
    odometry = EdgeArrays.of(simulation.problem.odometry, number)
    loops = EdgeArrays.of(simulation.problem.loops, number)
    truth = np.array(list(simulation.truth.values()))
    placed = replace(follow(len(number), odometry), poses=truth)
    bodies = bodies_of(odometry, loops, placed, 5)
    assert bodies is not None
    assert len(bodies.first) == 12
    assert len(bodies.odometry) == 10
    assert np.allclose(bodies.spread(truth[bodies.first]), truth)
    # At the true poses every loop misses by its own noise, and may miss by more than before.
    fine, coarse = loops.squared_norms(truth), bodies.loops.squared_norms(truth[bodies.first])
    at_first = np.isin(loops.source, bodies.first) & np.isin(loops.target, bodies.first)
    assert (coarse <= fine * (1 + 1e-9)).all()
    assert np.allclose(coarse[at_first], fine[at_first])


def test_bodies_need_simple_chains():
    simulation = agents_in_a_hall(agents=1, submaps=12, loops=4)
    number = {name: index for index, name in enumerate(simulation.problem.vertices)}
    odometry = EdgeArrays.of(simulation.problem.odometry, number)
    forked = replace(odometry, source=np.where(odometry.source == 7, 3, odometry.source))
    assert bodies_of(forked, odometry, follow(12, forked), 5) is None


def test_odometry_floor_widens_optimistic_edges_only():
    optimistic = EdgeArrays(
        np.array([0]), np.array([1]), se3.exp([1, 0, 0, 0, 0, 0])[None], np.eye(6)[None] * 1e12
    )
    config = PoseGraphConfig(
        odometry_floor_m=0.003, odometry_floor_rad=0.002, odometry_floor_share=0.01
    )
    covariance = np.linalg.inv(optimistic.with_odometry_floor(config).information[0])
    np.testing.assert_allclose(np.sqrt(np.diag(covariance))[:3], 0.013, rtol=1e-3)
    np.testing.assert_allclose(np.sqrt(np.diag(covariance))[3:], 0.002, rtol=1e-3)
    assert optimistic.with_odometry_floor(TRUSTING) is optimistic


def test_refuses_broken_problems():
    truth = circle("a", 3, (0, 0))
    good = edge("a0", "a1", truth)
    with pytest.raises(InvalidInput, match=r"loops\[0\].*no vertex 'x'"):
        solve(PoseGraphProblem(("a0", "a1"), loops=(replace(good, target="x"),)), TRUSTING)
    with pytest.raises(InvalidInput, match="unique"):
        solve(PoseGraphProblem(("a0", "a0")), TRUSTING)
    nan = replace(good, information=np.full((6, 6), np.nan))
    with pytest.raises(InvalidInput, match="finite"):
        solve(PoseGraphProblem(("a0", "a1"), odometry=(nan,)), TRUSTING)
    with pytest.raises(ConfigError):
        PoseGraphConfig(inlier_probability=1.0)


def test_an_empty_problem_has_an_empty_solution():
    solution = solve(PoseGraphProblem(()), TRUSTING)
    assert solution.world_from_anchor == {}
    assert solution.kept == ()
