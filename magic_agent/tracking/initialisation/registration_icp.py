"""Multi-scale ICP of coloured point clouds with Open3D: point to plane, and the paper's coloured.

The coloured variant minimises (paper, "Pose Initialization"; Park, Zhou and Koltun, ICCV 2017)

    E = (1 - sigma) sum r_C^2 + sigma sum r_G^2

over correspondences at voxel sizes from coarse to fine; the geometric term alone is the
point-to-plane variant.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from magic_agent.tracking.initialisation.base import InitialPose, LastFrame, Pose, checked
from magic_core.data import Frame
from magic_core.geometry import Camera

if TYPE_CHECKING:
    import open3d

_MIN_POINTS = 200
_MIN_FITNESS = 0.3


@dataclass(frozen=True, slots=True)
class IcpSchedule:
    """Scales of the registration, coarse to fine."""

    voxels_m: tuple[float, ...]
    """Voxel sizes; correspondences reach 1.5 times as far."""
    iterations: tuple[int, ...]
    max_depth_m: float = 6.0
    """Farther points are too noisy to register."""


POINT_TO_PLANE = IcpSchedule(voxels_m=(0.08, 0.04, 0.02), iterations=(20, 15, 10))
COLOURED = IcpSchedule(voxels_m=(0.04, 0.02, 0.01), iterations=(50, 30, 14))


class RegistrationIcp:
    """Open3D's tensor `multi_scale_icp` from the current cloud to the previous one."""

    def __init__(
        self, residual: Literal["point_to_plane", "coloured"], schedule: IcpSchedule
    ) -> None:
        self._residual = residual
        self._schedule = schedule
        self._last: LastFrame[open3d.t.geometry.PointCloud] = LastFrame()

    def reset(self) -> None:
        """Forget the last frame."""
        self._last.clear()

    def estimate(
        self,
        previous: Frame,
        current: Frame,
        *,
        camera: Camera,
        predicted_previous_from_current: Pose,
    ) -> InitialPose:
        """ICP from the prediction; too few points or no convergence give the prediction back."""
        source = self._cloud(current, camera)
        target = self._last.get(previous) or self._cloud(previous, camera)
        self._last.put(current, source)
        failed = InitialPose(predicted_previous_from_current, False, 0.0)
        if min(len(source.point.positions), len(target.point.positions)) < _MIN_POINTS:
            return failed
        try:
            result = self._register(source, target, predicted_previous_from_current)
        except RuntimeError:  # Open3D's answer to "no correspondences" and singular systems
            return failed
        if result.fitness < _MIN_FITNESS:
            return failed
        transform = result.transformation.numpy()
        return checked(transform, predicted_previous_from_current, fitness=result.fitness)

    def _cloud(self, frame: Frame, camera: Camera) -> open3d.t.geometry.PointCloud:
        import open3d as o3d

        valid = (frame.depth > 0) & (frame.depth < self._schedule.max_depth_m)
        points = camera.back_project(frame.depth)[valid]
        cloud = o3d.t.geometry.PointCloud(_tensor(points))
        colours = frame.colour[valid].astype(np.float32) / 255.0
        cloud.point.colors = _tensor(colours)
        if len(points) < _MIN_POINTS:
            return cloud
        finest = self._schedule.voxels_m[-1]
        cloud = cloud.voxel_down_sample(finest)
        cloud.estimate_normals(30, 3.0 * finest)
        if self._residual == "coloured":
            cloud.estimate_color_gradients(30, 3.0 * finest)
        return cloud

    def _register(
        self,
        source: open3d.t.geometry.PointCloud,
        target: open3d.t.geometry.PointCloud,
        start: Pose,
    ) -> open3d.t.pipelines.registration.RegistrationResult:
        import open3d as o3d

        icp = o3d.t.pipelines.registration
        if self._residual == "coloured":
            method = icp.TransformationEstimationForColoredICP()
        else:
            method = icp.TransformationEstimationPointToPlane()
        voxels = list(self._schedule.voxels_m)
        criteria = [icp.ICPConvergenceCriteria(1e-6, 1e-6, n) for n in self._schedule.iterations]
        return icp.multi_scale_icp(
            source,
            target,
            o3d.utility.DoubleVector(voxels),
            criteria,
            o3d.utility.DoubleVector([1.5 * voxel for voxel in voxels]),
            _tensor(start),
            method,
        )


def _tensor(array: np.ndarray) -> open3d.core.Tensor:
    """A tensor of the array's own type; Open3D's stubs know no typed arrays."""
    import open3d as o3d

    return o3d.core.Tensor(np.ascontiguousarray(array))  # pyright: ignore[reportCallIssue]
