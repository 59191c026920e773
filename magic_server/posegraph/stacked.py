"""Many rigid transforms at once: the formulas of magic_core.geometry.se3 on (n, 4, 4) stacks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_SMALL_ANGLE_RAD = 1e-4


def inverse(transforms: Array) -> Array:
    """Inverses of (n, 4, 4) transforms."""
    rotations_t = transforms[..., :3, :3].swapaxes(-1, -2)
    result = np.zeros_like(transforms)
    result[..., :3, :3] = rotations_t
    result[..., :3, 3] = -(rotations_t @ transforms[..., :3, 3:])[..., 0]
    result[..., 3, 3] = 1.0
    return result


def straightened(transforms: Array) -> Array:
    """Transforms (n, 4, 4) whose rotations were nearly rotations; rounding adds up in products."""
    result = transforms.copy()
    rotation = transforms[..., :3, :3]
    skewed = rotation.swapaxes(-1, -2) @ rotation
    result[..., :3, :3] = rotation @ (1.5 * np.eye(3) - 0.5 * skewed)
    return result


def log(transforms: Array) -> Array:
    """Tangent vectors (n, 6), (translation, rotation), of (n, 4, 4) transforms."""
    phi = rotation_log(transforms[..., :3, :3])
    translation = transforms[..., :3, 3]
    angle = np.linalg.norm(phi, axis=-1, keepdims=True)
    safe = np.maximum(angle, _SMALL_ANGLE_RAD)
    exact = (1.0 - 0.5 * safe / np.tan(0.5 * safe)) / safe**2
    factor = np.where(angle < _SMALL_ANGLE_RAD, 1.0 / 12.0, exact)
    once = np.cross(phi, translation)
    rho = translation - 0.5 * once + factor * np.cross(phi, once)
    return np.concatenate([rho, phi], axis=-1)


def exp(vectors: Array) -> Array:
    """Transforms (n, 4, 4) of tangent vectors (n, 6), (translation, rotation)."""
    rho, phi = vectors[..., :3], vectors[..., 3:]
    angle = np.linalg.norm(phi, axis=-1)[..., None, None]
    small = angle < _SMALL_ANGLE_RAD
    safe = np.where(small, 1.0, angle)
    first = np.where(small, 1.0 - angle**2 / 6.0, np.sin(safe) / safe)
    second = np.where(small, 0.5 - angle**2 / 24.0, (1.0 - np.cos(safe)) / safe**2)
    third = np.where(small, 1.0 / 6.0 - angle**2 / 120.0, (safe - np.sin(safe)) / safe**3)
    hat = cross_matrices(phi)
    twice = hat @ hat
    result = np.zeros((*vectors.shape[:-1], 4, 4))
    result[..., :3, :3] = np.eye(3) + first * hat + second * twice
    left = np.eye(3) + second * hat + third * twice
    result[..., :3, 3] = (left @ rho[..., None])[..., 0]
    result[..., 3, 3] = 1.0
    return result


def cross_matrices(vectors: Array) -> Array:
    """(n, 3, 3) matrices that take the cross product with (n, 3) vectors from the left."""
    result = np.zeros((*vectors.shape[:-1], 3, 3))
    result[..., [2, 0, 1], [1, 2, 0]] = vectors
    result[..., [1, 2, 0], [2, 0, 1]] = -vectors
    return result


def adjoint(transforms: Array) -> Array:
    """(n, 6, 6) adjoints of (n, 4, 4) transforms, (translation, rotation)."""
    rotation = transforms[..., :3, :3]
    result = np.zeros((*transforms.shape[:-2], 6, 6))
    result[..., :3, :3] = result[..., 3:, 3:] = rotation
    result[..., :3, 3:] = cross_matrices(transforms[..., :3, 3]) @ rotation
    return result


def rotation_log(rotations: Array) -> Array:
    """Rotation vectors (n, 3) of (n, 3, 3) rotations, exact near 0 and pi (by quaternions)."""
    quaternions = _small_quaternions(rotations)
    w, xyz = quaternions[..., :1], quaternions[..., 1:]
    norm = np.linalg.norm(xyz, axis=-1, keepdims=True)
    half = np.arctan2(norm, w)
    return xyz * np.where(norm < 1e-12, 2.0, 2.0 * half / np.maximum(norm, 1e-12))


def _small_quaternions(rotations: Array) -> Array:
    """The same as below, swiftly where all turn by less than 90 degrees."""
    m = rotations
    trace = m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2]
    if not (trace > 1.0).all():
        return quaternions_from_rotations(rotations)
    w = 0.5 * np.sqrt(1.0 + trace)
    quarter = 0.25 / w
    x = quarter * (m[..., 2, 1] - m[..., 1, 2])
    y = quarter * (m[..., 0, 2] - m[..., 2, 0])
    z = quarter * (m[..., 1, 0] - m[..., 0, 1])
    found = np.stack([w, x, y, z], axis=-1)
    return found / np.linalg.norm(found, axis=-1, keepdims=True)


def rotation_angles(transforms: Array) -> Array:
    """Rotation angles (n,) in radians of (n, 4, 4) transforms; fast, good to 1e-4 rad near 0."""
    trace = np.trace(transforms[..., :3, :3], axis1=-2, axis2=-1)
    return np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0))


def quaternions_from_rotations(rotations: Array) -> Array:
    """Unit quaternions (n, 4) wxyz, w >= 0, of (n, 3, 3) rotations (Bar-Itzhack's four cases)."""
    m = rotations
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    yz, zx, xy = m[..., 2, 1], m[..., 0, 2], m[..., 1, 0]
    zy, xz, yx = m[..., 1, 2], m[..., 2, 0], m[..., 0, 1]
    # Row r is 4 q_r times the quaternion; the row of the largest q_r is the accurate one.
    rows = np.stack(
        [
            np.stack([1 + xx + yy + zz, yz - zy, zx - xz, xy - yx], axis=-1),
            np.stack([yz - zy, 1 + xx - yy - zz, xy + yx, zx + xz], axis=-1),
            np.stack([zx - xz, xy + yx, 1 - xx + yy - zz, yz + zy], axis=-1),
            np.stack([xy - yx, zx + xz, yz + zy, 1 - xx - yy + zz], axis=-1),
        ],
        axis=-2,
    )
    diagonal = np.stack([rows[..., i, i] for i in range(4)], axis=-1)
    best = diagonal.argmax(axis=-1)[..., None, None]
    chosen = np.take_along_axis(rows, best, axis=-2)[..., 0, :]
    chosen = chosen / np.linalg.norm(chosen, axis=-1, keepdims=True)
    return np.where(chosen[..., :1] < 0, -chosen, chosen)


def squared_norms(vectors: Array, information: Array) -> Array:
    """Squared Mahalanobis norms (n,) of vectors (n, 6) under information (n, 6, 6)."""
    return np.einsum("ni,nij,nj->n", vectors, information, vectors)
