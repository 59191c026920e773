"""Looking at a whole map from outside: which way is up, what faces the viewer, where to stand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magic_core.evaluation.trajectory import Trajectory
from magic_core.evaluation.views import Renders
from magic_core.gaussians import GaussianCloud
from magic_core.geometry import Camera, se3

Array = NDArray[np.float64]
_ELEVATION_RAD = np.deg2rad(56.0)
_FIELD_OF_VIEW_RAD = np.deg2rad(36.0)
_MARGIN = 1.04
_ORBIT_MARGIN = 1.12  # one centre for all azimuths leaves each a little off its own
_SKETCH_POINTS = 40_000
_OWN_UP_WEIGHT = 0.004  # what a few degrees of roll spread the horizontal axes vertically


@dataclass(frozen=True, slots=True)
class PlanFrame:
    """A level frame: two horizontal axes, the longer extent first, and up."""

    origin: Array  # (3,) world, metres
    axes: Array  # (3, 3) rows: right, forward, up, in the world

    def plan(self, points: Array) -> Array:
        """(n, 2) horizontal coordinates of (n, 3) world points, metres."""
        return (np.asarray(points) - self.origin) @ self.axes[:2].T


def up_direction(world_from_camera: Array) -> Array:
    """Unit (3,) up of cameras (n, 4, 4) that people hold level.

    Up is at right angles to all the cameras' horizontal axes; their own up tells the sign, and
    decides where they hardly turned.
    """
    across = world_from_camera[:, :3, 0]
    own_up = -world_from_camera[:, :3, 1].mean(axis=0)
    moment = across.T @ across / len(across) - _OWN_UP_WEIGHT * np.outer(own_up, own_up)
    up = np.linalg.eigh(moment)[1][:, 0]
    return up if up @ own_up > 0 else -up


def plan_frame(trajectories: Sequence[Trajectory]) -> PlanFrame:
    """The level frame of some trajectories of one world."""
    poses = np.concatenate([trajectory.world_from_camera for trajectory in trajectories])
    up = up_direction(poses)
    positions = poses[:, :3, 3]
    origin = positions.mean(axis=0)
    level = (positions - origin) - np.outer((positions - origin) @ up, up)
    right = np.linalg.svd(level, full_matrices=False)[2][0] if len(level) > 1 else np.eye(3)[0]
    right = right - (right @ up) * up
    if np.linalg.norm(right) < 1e-6:
        right = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    right = np.asarray(right / np.linalg.norm(right), np.float64)
    return PlanFrame(origin, np.stack([right, np.cross(up, right), up]))


@dataclass(frozen=True, slots=True)
class SeenSurface:
    """Which side of each Gaussian the cameras saw."""

    toward_cameras: NDArray[np.float32]  # (n, 3) unit mean direction; 0 = no camera saw it
    normals: NDArray[np.float32]  # (n, 3) unit, of the surface around it, on the seen side


def seen_surface(
    cloud: GaussianCloud, camera: Camera, world_from_camera: Array, rasteriser: Renders
) -> SeenSurface:
    """What cameras at (k, 4, 4) saw of a map."""
    total = np.zeros((len(cloud), 3), np.float32)
    small = camera.scaled(min(1.0, 240 / camera.width))
    for pose in world_from_camera:
        seen = rasteriser.render(cloud, small, pose).visible
        total[seen] += _unit(pose[:3, 3].astype(np.float32) - cloud.means[seen])
    toward = _unit(total)
    normals = _normals(cloud.means)
    sign = np.where((normals * toward).sum(axis=1, keepdims=True) < 0, -1, 1)
    return SeenSurface(toward, (normals * sign).astype(np.float32))


def facing(cloud: GaussianCloud, seen: SeenSurface, position: Array) -> NDArray[np.bool_]:
    """(n,) whose seen side faces a viewer: near walls and the ceiling do not."""
    to_viewer = _unit(position.astype(np.float32) - cloud.means)
    by_normal = (seen.normals * to_viewer).sum(axis=1)
    by_cameras = (seen.toward_cameras * to_viewer).sum(axis=1)
    return (by_normal > 0.03) & (by_cameras > -0.35)


def _unit(vectors: NDArray[np.float32]) -> NDArray[np.float32]:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-6)


def _normals(points: NDArray[np.float32]) -> NDArray[np.float32]:
    """(n, 3) unit normals of the surface through the nearest neighbours, either sign."""
    import open3d as o3d

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.astype(np.float64)))
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(30))
    return np.asarray(cloud.normals, dtype=np.float32)


def outside_camera(width: int, height: int) -> Camera:
    """The camera that looks at the map from outside."""
    focal = 0.5 * height / np.tan(_FIELD_OF_VIEW_RAD / 2)
    return Camera(width=width, height=height, fx=float(focal), fy=float(focal),
                  cx=(width - 1) / 2, cy=(height - 1) / 2)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Scene:
    """What an outside picture shows."""

    cloud: GaussianCloud
    seen: SeenSurface
    frame: PlanFrame
    positions: Array  # (k, 3) camera centres, which the picture must hold

    def thinned(self, count: int) -> Scene:
        """The same scene of about `count` Gaussians: enough to see where it ends."""
        every = slice(None, None, max(1, len(self.cloud) // count))
        seen = SeenSurface(self.seen.toward_cameras[every], self.seen.normals[every])
        chosen = np.arange(len(self.cloud))[every]
        return Scene(self.cloud.select(chosen), seen, self.frame, self.positions)


def outside_pose(scene: Scene, camera: Camera, *, azimuth_rad: float) -> Array:
    """(4, 4) pose that looks down at the map from an azimuth, as near as everything fits in."""
    cloud = scene.cloud
    horizontal = np.cos(_ELEVATION_RAD)
    away = np.array([
        horizontal * np.cos(azimuth_rad), horizontal * np.sin(azimuth_rad), np.sin(_ELEVATION_RAD),
    ])  # fmt: skip
    rotation = scene.frame.axes.T @ _looking_along(-away)
    half = np.array([camera.width / (2 * camera.fx), camera.height / (2 * camera.fy)])
    centre = np.median(cloud.means, axis=0).astype(np.float64)
    distance = 4.0 * float(np.percentile(np.linalg.norm(cloud.means - centre, axis=1), 95)) + 0.1
    for _ in range(5):  # moving changes perspective and what faces the viewer: it settles quickly
        position = centre - distance * rotation[:, 2]
        solid = facing(cloud, scene.seen, position) & (cloud.opacities > 0.3)
        points = cloud.means[solid if solid.sum() > 100 else slice(None)]
        low, high, depth = _bounds(points, scene.positions, position, rotation)
        centre = centre + rotation[:, :2] @ (0.5 * (low + high) * depth)
        fill = float((0.5 * (high - low) / half).max())
        distance += depth * (_MARGIN * fill - 1.0)
    return se3.from_rotation_translation(rotation, centre - distance * rotation[:, 2])


def orbit_poses(scene: Scene, camera: Camera, *, count: int) -> Array:
    """(count, 4, 4) poses once round the map, at one height, all looking at one centre.

    As far away as the azimuth that needs most distance asks for, so that nothing pumps.
    """
    sketch = scene.thinned(_SKETCH_POINTS)
    tried = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    outside = np.stack([outside_pose(sketch, camera, azimuth_rad=float(a)) for a in tried])
    # The point that all these views look at, in the sense of least squares.
    across = np.eye(3) - outside[:, :3, 2, None] * outside[:, None, :3, 2]
    centre = np.linalg.solve(across.sum(axis=0), (across @ outside[:, :3, 3, None]).sum(axis=0))
    centre = centre[:, 0]
    distance = _ORBIT_MARGIN * float(np.linalg.norm(outside[:, :3, 3] - centre, axis=1).max())
    horizontal, height = np.cos(_ELEVATION_RAD), np.sin(_ELEVATION_RAD)
    poses = []
    for azimuth in np.linspace(0, 2 * np.pi, count, endpoint=False):
        away = np.array([horizontal * np.cos(azimuth), horizontal * np.sin(azimuth), height])
        rotation = scene.frame.axes.T @ _looking_along(-away)
        position = centre - distance * rotation[:, 2]
        poses.append(se3.from_rotation_translation(rotation, position))
    return np.stack(poses)


def _bounds(
    points: NDArray[np.float32], positions: Array, viewer: Array, rotation: Array
) -> tuple[Array, Array, float]:
    """Extent of a map on the image plane at z = 1, its stray points left out, and its depth."""
    local = (points - viewer) @ rotation
    cameras = (positions - viewer) @ rotation
    low, high = np.percentile(local[:, :2] / local[:, 2:], (0.7, 99.3), axis=0)
    spread = cameras[:, :2] / cameras[:, 2:]
    return (
        np.minimum(low, spread.min(axis=0)),
        np.maximum(high, spread.max(axis=0)),
        float(np.median(local[:, 2])),
    )


def best_outside_pose(scene: Scene, camera: Camera, rasteriser: Renders) -> Array:
    """The outside pose, of twelve round the map, from which most of the picture is filled."""
    small = camera.scaled(160 / camera.width)
    sketch = scene.thinned(_SKETCH_POINTS)
    poses, scores = [], []
    for azimuth in np.linspace(0, 2 * np.pi, 12, endpoint=False):
        pose = outside_pose(sketch, camera, azimuth_rad=float(azimuth))
        shown = scene.cloud.select(facing(scene.cloud, scene.seen, pose[:3, 3]))
        poses.append(pose)
        scores.append(float(rasteriser.render(shown, small, pose).alpha.mean()))
    return poses[int(np.argmax(scores))]


def _looking_along(forward: Array) -> Array:
    """(3, 3) level-frame rotation of an OpenCV camera that looks along `forward`, without roll."""
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward], axis=1)
