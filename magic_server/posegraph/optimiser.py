"""The border to GTSAM: our arrays in, second-order optimisation, our arrays out.

GTSAM orders tangent vectors (rotation, translation); ours are (translation, rotation). They are
permuted here and nowhere else.
"""

from __future__ import annotations

import gtsam
import numpy as np
from numpy.typing import NDArray

from magic_server.posegraph.arrays import EdgeArrays

Array = NDArray[np.float64]

GTSAM_ORDER = np.array([3, 4, 5, 0, 1, 2])
ANCHOR_SIGMA = 1e-6
"""Standard deviation that fixes the gauge (m and rad)."""
MIN_RELATIVE_INFORMATION = 1e-9
"""Eigenvalues below this share of the largest are raised: GTSAM needs positive definite ones."""


class FactorCache:
    """Between factors of edges, made once and reused while their weight is 1."""

    def __init__(self, edges: EdgeArrays) -> None:
        self._edges = edges
        self._square_root = _square_root(_gtsam_information(edges.information))
        self._measured = [gtsam.Pose3(matrix) for matrix in edges.source_from_target]
        self._unit: dict[int, gtsam.BetweenFactorPose3] = {}

    def __len__(self) -> int:
        return len(self._edges)

    def factor(self, index: int, weight: float = 1.0) -> gtsam.BetweenFactorPose3:
        """The factor of one edge with its information scaled by a weight > 0."""
        if weight != 1.0:
            return self._make(index, weight)
        if index not in self._unit:
            self._unit[index] = self._make(index, 1.0)
        return self._unit[index]

    def _make(self, index: int, weight: float) -> gtsam.BetweenFactorPose3:
        root = self._square_root[index]
        noise = gtsam.noiseModel.Gaussian.SqrtInformation(np.sqrt(weight) * root)
        edges = self._edges
        return gtsam.BetweenFactorPose3(
            int(edges.source[index]), int(edges.target[index]), self._measured[index], noise
        )


def optimise(
    graph: gtsam.NonlinearFactorGraph,
    start: gtsam.Values,
    *,
    max_iterations: int,
    tolerance: float = 1e-9,
) -> gtsam.Values:
    """Gauss-Newton, or Levenberg-Marquardt where that does not go down, from given poses.

    The result's error is never above the start's.
    """
    least = graph.error(start)
    for kind in ("GaussNewton", "LevenbergMarquardt"):
        parameters = getattr(gtsam, f"{kind}Params")()
        parameters.setMaxIterations(max_iterations)
        parameters.setRelativeErrorTol(tolerance)
        parameters.setAbsoluteErrorTol(1e-9)
        try:
            result = getattr(gtsam, f"{kind}Optimizer")(graph, start, parameters).optimize()
        except RuntimeError:  # not positive definite without damping
            continue
        if graph.error(result) <= least:
            return result
    return start


def anchored(anchors: dict[int, Array]) -> gtsam.NonlinearFactorGraph:
    """A graph that holds the given vertices at their poses."""
    graph = gtsam.NonlinearFactorGraph()
    noise = gtsam.noiseModel.Isotropic.Sigma(6, ANCHOR_SIGMA)
    for vertex, pose in anchors.items():
        graph.add(gtsam.PriorFactorPose3(vertex, gtsam.Pose3(pose), noise))
    return graph


def chordal_start(graph: gtsam.NonlinearFactorGraph, count: int) -> Array | None:
    """Chordal initialisation (Carlone et al. 2015); None where the graph does not allow it."""
    try:
        values = gtsam.InitializePose3.initialize(graph)
    except RuntimeError:
        return None
    if values.size() < count:
        return None
    poses = poses_of(values, count)
    return poses if np.isfinite(poses).all() else None


def values_of(poses: Array) -> gtsam.Values:
    """GTSAM values with the vertex number as the key."""
    values = gtsam.Values()
    for vertex, pose in enumerate(poses):
        values.insert(vertex, gtsam.Pose3(pose))
    return values


def poses_of(values: gtsam.Values, count: int) -> Array:
    """Poses (count, 4, 4) of GTSAM values keyed 0 to count - 1."""
    rows = gtsam.utilities.extractPose3(values)[:count]
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = rows[:, :9].reshape(-1, 3, 3)
    poses[:, :3, 3] = rows[:, 9:12]
    return poses


def _square_root(information: Array) -> Array:
    """Upper triangular R (m, 6, 6) with R^T R the information."""
    if not len(information):
        return information
    return np.linalg.cholesky(information).astype(np.float64).swapaxes(1, 2)


def _gtsam_information(information: Array) -> Array:
    permuted = information[:, GTSAM_ORDER[:, None], GTSAM_ORDER[None, :]]
    if not len(permuted):
        return permuted
    values, vectors = np.linalg.eigh(permuted)
    least = np.maximum(MIN_RELATIVE_INFORMATION * values[:, -1:], 1e-9)
    weak = values[:, 0] < least[:, 0]
    if weak.any():
        raised = np.maximum(values[weak], least[weak])
        permuted[weak] = (vectors[weak] * raised[:, None, :]) @ vectors[weak].swapaxes(1, 2)
    return permuted
