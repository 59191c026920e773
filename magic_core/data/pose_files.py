"""Reading poses and calibration matrices of stored recordings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magic_core.errors import DataError, InvalidInput
from magic_core.geometry import Camera, se3

Pose = NDArray[np.float64]

OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""OpenGL's camera looks along -z with y up; ARKit's too. `pose @ this` gives OpenCV axes."""


def read_matrix(path: Path, shape: tuple[int, int]) -> NDArray[np.float64]:
    """A matrix of numbers from a text file; DataError names the file, what is there, and wanted."""
    try:
        values = np.loadtxt(path, dtype=np.float64, ndmin=2)
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: {error}; expected {shape[0]}x{shape[1]} numbers") from error
    if values.shape != shape:
        found = "x".join(map(str, values.shape))
        raise DataError(f"{path}: {found} numbers; expected {shape[0]}x{shape[1]}")
    return values


def read_pose(path: Path) -> Pose | None:
    """A 4x4 pose file; None where it is absent or holds inf or nan: the pose is unknown."""
    if not path.is_file():
        return None
    return known_pose(read_matrix(path, (4, 4)))


def known_pose(pose: Pose) -> Pose | None:
    """The pose itself; None where any of its numbers is infinite or missing."""
    return pose if np.isfinite(pose).all() else None


def pose_from_values(values: object, *, where: str) -> Pose | None:
    """A 4x4 pose from JSON lists; None where it is absent or not finite."""
    if values is None:
        return None
    try:
        pose = np.asarray(values, dtype=np.float64).reshape(4, 4)
    except (TypeError, ValueError) as error:
        raise DataError(f"{where}: {error}; expected a 4x4 matrix, row by row") from error
    return known_pose(pose)


def pose_from_xyzw(quaternion_xyzw: NDArray[np.float64], position: NDArray[np.float64]) -> Pose:
    """(4, 4) of a position in metres and a quaternion with w last, as ROS and Record3D write it."""
    rotation = se3.rotation_from_quaternion(np.asarray(quaternion_xyzw)[[3, 0, 1, 2]])
    return se3.from_rotation_translation(rotation, np.asarray(position, dtype=np.float64))


def camera_from_matrix(
    matrix: NDArray[np.float64], *, width: int, height: int, where: Path | str
) -> Camera:
    """A validated camera from a calibration matrix (3x3 or 4x4) and its image size."""
    camera = Camera(
        width=width,
        height=height,
        fx=float(matrix[0, 0]),
        fy=float(matrix[1, 1]),
        cx=float(matrix[0, 2]),
        cy=float(matrix[1, 2]),
    )
    return valid_camera(camera, where=where)


def valid_camera(camera: Camera, *, where: Path | str) -> Camera:
    """The camera itself; DataError names the file whose values no camera can have."""
    try:
        camera.validate()
    except InvalidInput as error:
        raise DataError(f"{where}: {error.message}; correct the calibration") from error
    return camera


def resized_camera(camera: Camera, *, width: int, height: int) -> Camera:
    """The camera of the same view stored at another size, both axes scaled on their own."""
    sx, sy = width / camera.width, height / camera.height
    return Camera(
        width=width,
        height=height,
        fx=camera.fx * sx,
        fy=camera.fy * sy,
        cx=(camera.cx + 0.5) * sx - 0.5,
        cy=(camera.cy + 0.5) * sy - 0.5,
    )


def median_camera(cameras: list[Camera]) -> Camera:
    """One camera for a recording whose focus changes from frame to frame."""
    fx, fy, cx, cy = np.median([(c.fx, c.fy, c.cx, c.cy) for c in cameras], axis=0)
    first = cameras[0]
    return Camera(first.width, first.height, float(fx), float(fy), float(cx), float(cy))
