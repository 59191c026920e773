"""Poses, cameras, information matrices and descriptors to and from their messages."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from magicslam.v1 import geometry_pb2
from numpy.typing import ArrayLike, NDArray

from magic_core.errors import InvalidInput
from magic_core.geometry import Camera, se3
from magic_core.submap import Descriptor

UNIT_TOLERANCE = 1e-3
MAX_COORDINATE_M = 1e6
INFORMATION_LENGTH = 21
_UPPER = np.triu_indices(6)


def pose_to_proto(a_from_b: ArrayLike) -> geometry_pb2.Pose:
    """A (4, 4) rigid transform as translation and wxyz quaternion.

    Raises InvalidInput for a matrix that is not rigid, so that nothing bent leaves this side.
    """
    a_from_b = np.asarray(a_from_b, dtype=np.float64)
    if problem := rigid_problem(a_from_b):
        raise InvalidInput.field("pose", problem)
    qw, qx, qy, qz = se3.quaternion_from_rotation(a_from_b[:3, :3]).tolist()
    x, y, z = a_from_b[:3, 3].tolist()
    return geometry_pb2.Pose(x=x, y=y, z=z, qw=qw, qx=qx, qy=qy, qz=qz)


def pose_from_proto(pose: geometry_pb2.Pose, *, field: str = "pose") -> NDArray[np.float64]:
    """The (4, 4) transform of a message; InvalidInput when it is not a rigid transform."""
    row = pose_row(pose)
    if problem := pose_problems(row[None])[0]:
        raise InvalidInput.field(field, problem)
    return transforms_of_rows(row[None])[0]


def pose_row(pose: geometry_pb2.Pose) -> NDArray[np.float64]:
    """(7,) x y z qw qx qy qz of a message, unchecked."""
    return np.array([pose.x, pose.y, pose.z, pose.qw, pose.qx, pose.qy, pose.qz])


def pose_rows(poses: Iterable[geometry_pb2.Pose]) -> NDArray[np.float64]:
    """(n, 7) rows of many messages, unchecked."""
    rows = [(p.x, p.y, p.z, p.qw, p.qx, p.qy, p.qz) for p in poses]
    return np.array(rows, dtype=np.float64).reshape(-1, 7)


def pose_problems(rows: NDArray[np.float64]) -> list[str | None]:
    """For each of (n, 7) rows, what keeps it from being a pose, or None."""
    with np.errstate(all="ignore"):
        norm = np.linalg.norm(rows[:, 3:], axis=1)
        far = np.abs(rows[:, :3]).max(axis=1, initial=0.0)
    problems: list[str | None] = []
    for i in range(len(rows)):
        if not np.isfinite(rows[i]).all():
            problems.append("holds NaN or infinity; send finite numbers only")
        elif abs(norm[i] - 1.0) > UNIT_TOLERANCE:
            problems.append(f"quaternion norm {norm[i]:.6g}, expected 1 within {UNIT_TOLERANCE}")
        elif far[i] > MAX_COORDINATE_M:
            problems.append(f"translation beyond {MAX_COORDINATE_M:.0f} m")
        else:
            problems.append(None)
    return problems


def transforms_of_rows(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, 4, 4) transforms of valid (n, 7) rows; quaternions are normalised."""
    transforms = np.tile(np.eye(4), (len(rows), 1, 1))
    if len(rows):
        transforms[:, :3, :3] = se3.rotation_from_quaternion(rows[:, 3:])
        transforms[:, :3, 3] = rows[:, :3]
    return transforms


def rigid_problem(transform: NDArray[np.float64]) -> str | None:
    """What keeps a matrix from being a rigid (4, 4) transform, or None."""
    if transform.shape != (4, 4):
        return f"shape {transform.shape}, expected (4, 4)"
    if not np.isfinite(transform).all():
        return "holds NaN or infinity; send finite numbers only"
    rotation = transform[:3, :3]
    off = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if off > UNIT_TOLERANCE or np.linalg.det(rotation) < 0:
        return f"rotation block is off by {off:.3g} from a rotation; orthonormalise it first"
    if not np.array_equal(transform[3], (0.0, 0.0, 0.0, 1.0)):
        return "last row must be 0 0 0 1"
    return None


def camera_to_proto(camera: Camera) -> geometry_pb2.Camera:
    """A camera as its message."""
    return geometry_pb2.Camera(
        width=camera.width,
        height=camera.height,
        fx=camera.fx,
        fy=camera.fy,
        cx=camera.cx,
        cy=camera.cy,
    )


def camera_from_proto(message: geometry_pb2.Camera, *, field: str = "camera") -> Camera:
    """The camera of a message; InvalidInput when no pinhole camera can have these values."""
    camera = Camera(
        width=message.width,
        height=message.height,
        fx=message.fx,
        fy=message.fy,
        cx=message.cx,
        cy=message.cy,
    )
    camera.validate(field)
    return camera


def information_to_list(information: ArrayLike) -> list[float]:
    """The upper triangle of a symmetric (6, 6) matrix, row by row: 21 numbers."""
    return np.asarray(information, dtype=np.float64)[_UPPER].tolist()


def information_from_list(values: Sequence[float]) -> NDArray[np.float64]:
    """The symmetric (6, 6) matrix of its upper triangle; the length is not checked here."""
    matrix = np.zeros((6, 6))
    matrix[_UPPER] = values
    return matrix + np.triu(matrix, 1).T


def information_problem(values: Sequence[float]) -> str | None:
    """What keeps numbers from being the upper triangle of an information matrix, or None."""
    if len(values) != INFORMATION_LENGTH:
        return f"{len(values)} numbers, expected the {INFORMATION_LENGTH} of an upper triangle"
    matrix = information_from_list(values)
    if not np.isfinite(matrix).all():
        return "holds NaN or infinity; send finite numbers only"
    smallest = float(np.linalg.eigvalsh(matrix)[0])
    if smallest <= 0.0:
        return f"smallest eigenvalue {smallest:.3g}, expected a positive definite matrix"
    return None


def descriptor_to_proto(descriptor: Descriptor) -> geometry_pb2.Descriptor:
    """A descriptor as its message."""
    return geometry_pb2.Descriptor(model_id=descriptor.model_id, vector=descriptor.vector.tolist())


def descriptor_from_proto(message: geometry_pb2.Descriptor) -> Descriptor:
    """The descriptor of a message that was checked."""
    return Descriptor(message.model_id, np.array(message.vector, dtype=np.float32))


def vector_from_proto(values: Sequence[float]) -> NDArray[np.float32] | None:
    """The descriptor (d,) of a keyframe, whose header was checked; None where it has none."""
    return np.array(values, dtype=np.float32) if values else None


def descriptor_problem(message: geometry_pb2.Descriptor, *, max_dimension: int) -> str | None:
    """What is wrong with a descriptor, or None."""
    if not 1 <= len(message.model_id) <= 128 or not message.model_id.isprintable():
        return "model_id must be 1 to 128 printable characters"
    if not 1 <= len(message.vector) <= max_dimension:
        return f"{len(message.vector)} numbers, expected 1 to {max_dimension}"
    return unit_problem(message.vector)


def unit_problem(values: Sequence[float]) -> str | None:
    """What keeps numbers from being a unit vector, or None."""
    vector = np.array(values, dtype=np.float64)
    if not np.isfinite(vector).all():
        return "holds NaN or infinity; send finite numbers only"
    norm = float(np.linalg.norm(vector))
    if abs(norm - 1.0) > UNIT_TOLERANCE:
        return f"norm {norm:.6g}, expected 1 within {UNIT_TOLERANCE}"
    return None
