"""Rigid transforms SE(3) as 4x4 float64 matrices, and their tangent vectors.

A tangent vector is (translation, rotation): xi = (rho, phi), metres and radians. Perturbations
act on the right: T <- T @ exp(xi). See docs/conventions.md. Formulas follow Sola, Deray and
Atchuthan, "A micro Lie theory for state estimation in robotics" (2018), section "SE(3)".
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

_SMALL_ANGLE_RAD = 1e-5


def identity() -> Array:
    """The 4x4 identity."""
    return np.eye(4)


def from_rotation_translation(rotation: ArrayLike, translation: ArrayLike) -> Array:
    """A 4x4 transform from a (3, 3) rotation and a (3,) translation in metres."""
    transform = np.eye(4)
    transform[:3, :3] = rotation
    transform[:3, 3] = translation
    return transform


def inverse(transform: ArrayLike) -> Array:
    """The inverse of (..., 4, 4) rigid transforms: b_from_a of a_from_b."""
    transform = np.asarray(transform, dtype=np.float64)
    rotation_t = np.swapaxes(transform[..., :3, :3], -1, -2)
    result = np.zeros_like(transform)
    result[..., :3, :3] = rotation_t
    result[..., :3, 3] = -(rotation_t @ transform[..., :3, 3:])[..., 0]
    result[..., 3, 3] = 1.0
    return result


def transform_points(a_from_b: ArrayLike, points_b: ArrayLike) -> Array:
    """Map (n, 3) points in b to a, metres."""
    a_from_b = np.asarray(a_from_b, dtype=np.float64)
    return np.asarray(points_b) @ a_from_b[:3, :3].T + a_from_b[:3, 3]


def hat(vector: ArrayLike) -> Array:
    """The (3, 3) skew matrix of a (3,) vector: hat(a) @ b = a x b."""
    x, y, z = np.asarray(vector, dtype=np.float64)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def rotation_exp(phi: ArrayLike) -> Array:
    """Rotation matrix of a (3,) rotation vector in radians (Rodrigues)."""
    phi = np.asarray(phi, dtype=np.float64)
    a, b, _ = _coefficients(float(np.linalg.norm(phi)))
    skew = hat(phi)
    return np.eye(3) + a * skew + b * skew @ skew


def rotation_log(rotation: ArrayLike) -> Array:
    """Rotation vector (3,) of a rotation matrix, angle in [0, pi]; exact near 0 and pi.

    Goes through the unit quaternion, whose logarithm is well conditioned over the whole range.
    """
    w, *xyz = quaternion_from_rotation(rotation)
    vector = np.array(xyz)
    norm = float(np.linalg.norm(vector))
    if norm < 1e-12:
        return 2.0 * vector / max(float(w), 1e-12)
    return vector * float(2.0 * np.arctan2(norm, w) / norm)


def exp(xi: ArrayLike) -> Array:
    """The transform of a (6,) tangent vector (rho, phi)."""
    xi = np.asarray(xi, dtype=np.float64)
    return from_rotation_translation(rotation_exp(xi[3:]), _left_jacobian(xi[3:]) @ xi[:3])


def fractions(xi: ArrayLike, shares: ArrayLike) -> Array:
    """(n, 4, 4) exp(s xi) for each share s (n,) of one motion."""
    xi = np.asarray(xi, dtype=np.float64)
    share = np.asarray(shares, dtype=np.float64)[:, None, None]
    angle = float(np.linalg.norm(xi[3:]))
    coefficients = [_coefficients(abs(float(s)) * angle) for s in share.ravel()]
    a, b, c = np.array(coefficients).reshape(-1, 3).T[:, :, None, None]
    once, twice = share * hat(xi[3:]), share**2 * (hat(xi[3:]) @ hat(xi[3:]))
    result = np.tile(np.eye(4), (len(share), 1, 1))
    result[:, :3, :3] += a * once + b * twice
    jacobian = np.eye(3) + b * once + c * twice
    result[:, :3, 3:] = jacobian @ (share * xi[:3, None])
    return result


def log(transform: ArrayLike) -> Array:
    """The (6,) tangent vector (rho, phi) of a transform."""
    transform = np.asarray(transform, dtype=np.float64)
    phi = rotation_log(transform[:3, :3])
    rho = np.linalg.solve(_left_jacobian(phi), transform[:3, 3])
    return np.concatenate([rho, phi]).astype(np.float64)


def adjoint(transform: ArrayLike) -> Array:
    """The (6, 6) adjoint: T @ exp(xi) = exp(adjoint(T) @ xi) @ T, order (translation, rotation)."""
    transform = np.asarray(transform, dtype=np.float64)
    rotation = transform[:3, :3]
    result = np.zeros((6, 6))
    result[:3, :3] = rotation
    result[3:, 3:] = rotation
    result[:3, 3:] = hat(transform[:3, 3]) @ rotation
    return result


def quaternion_from_rotation(rotation: ArrayLike) -> Array:
    """Unit quaternion (4,) wxyz with w >= 0 of a rotation matrix (Shepperd's method)."""
    m = np.asarray(rotation, dtype=np.float64)
    candidates = np.array(
        [m[0, 0] + m[1, 1] + m[2, 2], m[0, 0] - m[1, 1] - m[2, 2],
         m[1, 1] - m[0, 0] - m[2, 2], m[2, 2] - m[0, 0] - m[1, 1]]
    )  # fmt: skip
    skew = np.array([m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]])
    largest = int(candidates.argmax())
    if largest == 0:
        q = np.concatenate([[candidates[0] + 1.0], skew])
    else:
        i = largest - 1
        q = np.empty(4)
        q[0] = skew[i]
        q[1:] = m[i, :] + m[:, i]
        q[1 + i] = candidates[largest] + 1.0
    q /= np.linalg.norm(q)
    return -q if q[0] < 0 else q


def rotation_from_quaternion(quaternions: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) of (..., 4) wxyz quaternions; they are normalised first."""
    q = np.asarray(quaternions, dtype=np.float64)
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quaternion_multiply(a: ArrayLike, b: ArrayLike) -> Array:
    """Hamilton product of (..., 4) wxyz quaternions."""
    aw, ax, ay, az = np.moveaxis(np.asarray(a, dtype=np.float64), -1, 0)
    bw, bx, by, bz = np.moveaxis(np.asarray(b, dtype=np.float64), -1, 0)
    product = [
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    ]
    return np.stack(product, axis=-1)


def orthonormalised(transform: ArrayLike) -> Array:
    """The nearest rigid transform: the rotation block is projected to SO(3) by an SVD."""
    transform = np.array(transform, dtype=np.float64)
    u, _, vt = np.linalg.svd(transform[:3, :3])
    sign = np.sign(np.linalg.det(u @ vt))
    transform[:3, :3] = u @ np.diag([1.0, 1.0, sign]) @ vt
    transform[3] = (0.0, 0.0, 0.0, 1.0)
    return transform


def rotation_angle(transform: ArrayLike) -> float:
    """The rotation angle of a (4, 4) or (3, 3) transform, radians in [0, pi]."""
    return float(np.linalg.norm(rotation_log(np.asarray(transform)[:3, :3])))


def _coefficients(angle: float) -> tuple[float, float, float]:
    """sin(t)/t, (1-cos t)/t^2, (t-sin t)/t^3, with Taylor series near zero."""
    if angle < _SMALL_ANGLE_RAD:
        t2 = angle * angle
        return 1.0 - t2 / 6.0, 0.5 - t2 / 24.0, 1.0 / 6.0 - t2 / 120.0
    half = np.sin(0.5 * angle)
    return (
        float(np.sin(angle) / angle),
        float(2.0 * half * half / angle**2),
        float((angle - np.sin(angle)) / angle**3),
    )


def _left_jacobian(phi: Array) -> Array:
    """Left Jacobian of SO(3): V in exp((rho, phi)) = (exp(phi), V @ rho)."""
    _, b, c = _coefficients(float(np.linalg.norm(phi)))
    skew = hat(phi)
    return np.eye(3) + b * skew + c * skew @ skew
