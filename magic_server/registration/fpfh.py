"""FPFH features and RANSAC (Rusu et al. 2009), the paper's coarse registration, with Open3D.

The paper registers the anchors' RGB-D clouds, and shows as an ablation that the means of the
Gaussians register worse: they thin out where the colour is even.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal

import numpy as np
import open3d
from numpy.typing import NDArray

from magic_server.registration.coarse import Hypothesis
from magic_server.registration.config import RegistrationConfig
from magic_server.registration.view import PreparedView

VOXEL_M = 0.05
ITERATIONS = 100_000
CONFIDENCE = 0.999
LEAST_POINTS = 50

# Open3D fills its modules in at run time: static checks see nothing in them.
o3d: Any = open3d
registration = o3d.pipelines.registration


class FpfhRansac:
    """One hypothesis. Deterministic by Open3D's global seed and one OpenMP thread."""

    def __init__(self, name: Literal["fpfh", "means"]) -> None:
        self._name: Literal["fpfh", "means"] = name

    def propose(
        self, source: PreparedView, target: PreparedView, config: RegistrationConfig
    ) -> Iterator[Hypothesis]:
        source_points, target_points = self._points(source), self._points(target)
        if min(len(source_points), len(target_points)) < LEAST_POINTS:
            return
        source_cloud, source_features = _features(source_points)
        target_cloud, target_features = _features(target_points)
        o3d.utility.random.seed(config.seed)
        result = registration.registration_ransac_based_on_feature_matching(
            source_cloud,
            target_cloud,
            source_features,
            target_features,
            True,
            VOXEL_M * 1.5,
            registration.TransformationEstimationPointToPoint(False),
            3,
            [
                registration.CorrespondenceCheckerBasedOnEdgeLength(0.9),
                registration.CorrespondenceCheckerBasedOnDistance(VOXEL_M * 1.5),
            ],
            registration.RANSACConvergenceCriteria(ITERATIONS, CONFIDENCE),
        )
        inliers = len(result.correspondence_set)
        if inliers:
            yield Hypothesis(np.array(result.transformation), inliers, self._name)

    def _points(self, view: PreparedView) -> NDArray[np.float32]:
        return view.means if self._name == "means" else view.points


def _features(points: NDArray[np.float32]) -> tuple[Any, Any]:
    """The thinned cloud with normals, and its FPFH features."""
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.astype(np.float64)))
    cloud = cloud.voxel_down_sample(VOXEL_M)
    search = o3d.geometry.KDTreeSearchParamHybrid(radius=VOXEL_M * 2, max_nn=30)
    cloud.estimate_normals(search)
    cloud.orient_normals_towards_camera_location(np.zeros(3))
    wide = o3d.geometry.KDTreeSearchParamHybrid(radius=VOXEL_M * 5, max_nn=100)
    return cloud, registration.compute_fpfh_feature(cloud, wide)
