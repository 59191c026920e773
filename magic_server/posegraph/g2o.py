"""g2o files: 3D pose graphs (VERTEX_SE3:QUAT, EDGE_SE3:QUAT), of one robot or of several."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magic_core.errors import CorruptData, DataError
from magic_core.geometry import se3
from magic_server.posegraph.problem import Edge, PoseGraphProblem

UPPER_TRIANGLE = np.triu_indices(6)
ROBOT_SHIFT = 56
"""GTSAM symbols carry the robot's letter in the top byte of the key."""


@dataclass(frozen=True, slots=True)
class G2oGraph:
    """The content of one or several files, vertices in ascending order of their keys."""

    poses: dict[int, NDArray[np.float64]]
    """(4, 4) per key, as the file gives it; robots may be unaligned."""
    edges: tuple[tuple[int, int, NDArray[np.float64], NDArray[np.float64]], ...]
    """(i, j, i_from_j (4, 4), information (6, 6)), each measurement once."""


def read_g2o(paths: Sequence[Path]) -> G2oGraph:
    """Read files as one graph; an edge between robots that stands in two files counts once.

    Raises DataError for a missing file, CorruptData with file and line for a malformed one.
    """
    poses: dict[int, NDArray[np.float64]] = {}
    edges: dict[tuple, tuple[int, int, NDArray[np.float64], NDArray[np.float64]]] = {}
    for path in paths:
        if not path.is_file():
            raise DataError(f"pose graph {path}: no such file")
        for line_number, line in enumerate(path.read_text().splitlines(), start=1):
            try:
                _read_line(line.split(), poses, edges)
            except (ValueError, IndexError) as error:
                raise CorruptData(f"{path}:{line_number}: {error}") from error
    missing = {key for i, j, *_ in edges.values() for key in (i, j)} - poses.keys()
    if missing:
        raise CorruptData(
            f"{paths[0]}: edges name vertices that no file has: {sorted(missing)[:3]}"
        )
    ordered = {key: poses[key] for key in sorted(poses)}
    return G2oGraph(poses=ordered, edges=tuple(edges.values()))


def write_g2o(
    path: Path, poses: Mapping[int, NDArray], edges: Iterable[tuple[int, int, NDArray, NDArray]]
) -> None:
    """Write a graph; numbers keep all their digits."""
    with path.open("w") as file:
        for key, pose in poses.items():
            file.write(f"VERTEX_SE3:QUAT {key} {_pose_text(pose)}\n")
        for i, j, i_from_j, information in edges:
            numbers = " ".join(repr(float(value)) for value in information[UPPER_TRIANGLE])
            file.write(f"EDGE_SE3:QUAT {i} {j} {_pose_text(i_from_j)} {numbers}\n")


def robot_of(key: int) -> int:
    """The robot of a key: the symbol's letter, 0 for plain numbers."""
    return key >> ROBOT_SHIFT


def problem_of(graph: G2oGraph) -> PoseGraphProblem:
    """A problem with keys as names: edges between successive keys are odometry, others loops."""
    odometry, loops = [], []
    for i, j, i_from_j, information in graph.edges:
        edge = Edge(str(i), str(j), i_from_j, information)
        (odometry if is_odometry(i, j) else loops).append(edge)
    return PoseGraphProblem(
        vertices=tuple(str(key) for key in graph.poses),
        odometry=tuple(odometry),
        loops=tuple(loops),
        initial={str(key): pose for key, pose in graph.poses.items()},
    )


def is_odometry(i: int, j: int) -> bool:
    """Whether an edge joins successive poses of one robot."""
    return abs(i - j) == 1 and robot_of(i) == robot_of(j)


def _read_line(words: list[str], poses: dict, edges: dict) -> None:
    if not words or words[0].startswith("#") or words[0] == "FIX":
        return
    if words[0] == "VERTEX_SE3:QUAT":
        poses[int(words[1])] = _pose([float(word) for word in words[2:9]])
    elif words[0] == "EDGE_SE3:QUAT":
        i, j = int(words[1]), int(words[2])
        numbers = [float(word) for word in words[3:31]]
        if len(numbers) != 28:
            raise ValueError(f"an edge has 28 numbers, found {len(numbers)}")
        information = np.zeros((6, 6))
        information[UPPER_TRIANGLE] = numbers[7:]
        information = information + np.triu(information, 1).T
        edges[i, j, *numbers[:7]] = (i, j, _pose(numbers[:7]), information)
    else:
        raise ValueError(f"{words[0]} is not supported, expected 3D vertices and edges")


def _pose(numbers: list[float]) -> NDArray[np.float64]:
    if len(numbers) != 7 or not np.isfinite(numbers).all():
        raise ValueError("a pose has 7 finite numbers: x y z qx qy qz qw")
    x, y, z, w = numbers[3:]
    if x * x + y * y + z * z + w * w < 0.5:
        raise ValueError("a pose's quaternion must have unit length")
    return se3.from_rotation_translation(se3.rotation_from_quaternion([w, x, y, z]), numbers[:3])


def _pose_text(pose: NDArray) -> str:
    w, x, y, z = se3.quaternion_from_rotation(pose[:3, :3])
    return " ".join(repr(float(value)) for value in (*pose[:3, 3], x, y, z, w))
