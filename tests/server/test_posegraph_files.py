"""g2o files: round trips, several robots, malformed lines, public benchmark graphs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from magic_core.errors import CorruptData, DataError
from magic_core.geometry import se3
from magic_server.posegraph.g2o import problem_of, read_g2o, write_g2o
from magic_server.posegraph.solve_files import solve_files

DATA = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "g2o"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason=f"{DATA} is absent")

VERTEX = "VERTEX_SE3:QUAT {} {} 0 0 0 0 0 1"
EDGE = "EDGE_SE3:QUAT {} {} {} 0 0 0 0 0 1 " + " ".join(
    "1" if row == column else "0" for row in range(6) for column in range(row, 6)
)


def key(robot: str, index: int) -> int:
    return (ord(robot) << 56) + index


def test_round_trip_keeps_every_digit(tmp_path):
    generator = np.random.default_rng(0)
    poses = {n: se3.exp(generator.normal(size=6)) for n in range(4)}
    root = generator.normal(size=(6, 6))
    edges = [(n, n + 1, se3.exp(generator.normal(size=6)), root @ root.T) for n in range(3)]
    write_g2o(tmp_path / "graph.g2o", poses, edges)
    graph = read_g2o([tmp_path / "graph.g2o"])
    for n, pose in poses.items():
        np.testing.assert_allclose(graph.poses[n], pose, atol=1e-14)
    for found, expected in zip(graph.edges, edges, strict=True):
        assert found[:2] == expected[:2]
        np.testing.assert_allclose(found[2], expected[2], atol=1e-14)
        np.testing.assert_allclose(found[3], expected[3], rtol=1e-14)


def test_robots_in_files_of_their_own_become_one_graph(tmp_path):
    between = EDGE.format(key("a", 1), key("b", 0), 0.5)
    for robot in "ab":
        lines = [VERTEX.format(key(robot, n), n) for n in range(3)]
        lines += [EDGE.format(key(robot, n), key(robot, n + 1), 1.0) for n in range(2)]
        (tmp_path / f"{robot}.g2o").write_text("\n".join([*lines, between]) + "\n")
    paths = [tmp_path / "a.g2o", tmp_path / "b.g2o"]
    problem = problem_of(read_g2o(paths))
    assert len(problem.odometry) == 4
    assert len(problem.loops) == 1  # stands in both files
    report = solve_files(paths, output=tmp_path / "out.g2o")
    assert report["components"] == 1
    assert report["vertices"] == 6
    assert report["error_after"] == pytest.approx(0.0, abs=1e-9)
    solved = read_g2o([tmp_path / "out.g2o"]).poses
    np.testing.assert_allclose(solved[key("b", 0)][:3, 3], [1.5, 0, 0], atol=1e-6)


def test_rejected_loops_are_named_and_not_written(tmp_path):
    lines = [VERTEX.format(n, n) for n in range(12)]
    lines += [EDGE.format(n, n + 1, 1.0) for n in range(11)]
    lines += [EDGE.format(n, n + 3, 3.0) for n in range(8)]
    lines.append(EDGE.format(0, 11, -60.0))
    (tmp_path / "graph.g2o").write_text("\n".join(lines))
    report = solve_files([tmp_path / "graph.g2o"], output=tmp_path / "out.g2o")
    assert report["loops_rejected"] == [[0, 11]]
    assert report["loops_kept"] == 8
    assert len(read_g2o([tmp_path / "out.g2o"]).edges) == report["edges"] - 1
    trusting = solve_files([tmp_path / "graph.g2o"], robust="none")
    assert trusting["loops_rejected"] == []
    assert trusting["error_after"] > report["error_after"] + 100


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("EDGE_SE3:QUAT 0 1 0 0 0 0 0 0 1 1 0", "28 numbers"),
        ("VERTEX_SE3:QUAT 0 0 0 nan 0 0 0 1", "finite"),
        ("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 0", "quaternion"),
        ("VERTEX_SE2 0 0 0 0", "VERTEX_SE2"),
        ("VERTEX_SE3:QUAT zero 0 0 0 0 0 0 1", "zero"),
        (EDGE.format(0, 7, 1.0), "no file has"),
    ],
)
def test_malformed_files_are_refused_with_file_and_reason(tmp_path, text, message):
    path = tmp_path / "bad.g2o"
    path.write_text(VERTEX.format(0, 0) + "\n" + text + "\n")
    with pytest.raises(CorruptData, match=message) as caught:
        read_g2o([path])
    assert "bad.g2o" in caught.value.message


def test_missing_file_is_named(tmp_path):
    with pytest.raises(DataError, match=r"none\.g2o"):
        read_g2o([tmp_path / "none.g2o"])


@needs_data
@pytest.mark.parametrize("robust", ["none", "gnc"])
def test_small_grid_reaches_its_known_optimum(robust):
    report = solve_files([DATA / "smallGrid3D.g2o"], robust=robust)
    assert report["error_after"] == pytest.approx(517.925, abs=0.01)
    assert report["loops_rejected"] == []


@needs_data
@pytest.mark.slow
@pytest.mark.parametrize(("name", "optimum"), [("sphere2500", 675.71), ("parking-garage", 0.6342)])
@pytest.mark.parametrize("robust", ["none", "gnc"])
def test_benchmarks_reach_their_optimum_from_the_file(name, optimum, robust):
    report = solve_files([DATA / f"{name}.g2o"], robust=robust)
    assert report["error_after"] <= optimum
    assert report["loops_rejected"] == []


@needs_data
@pytest.mark.parametrize(("kind", "least_kept"), [("clean", 70), ("spoiled", 25)])
def test_four_unaligned_robots_become_one_component(kind, least_kept):
    paths = [DATA / f"argos_4robots_{kind}" / f"{robot}.g2o" for robot in range(4)]
    report = solve_files(paths)
    connected = 1 if kind == "clean" else report["components"]
    assert report["components"] == connected
    assert report["loops_kept"] >= least_kept
    assert report["error_after"] < 0.1 * solve_files(paths, robust="none")["error_before"]
