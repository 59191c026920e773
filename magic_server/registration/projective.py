"""Kernels of projective association: points of one image against another's depth and texture."""

from __future__ import annotations

import numpy as np
from numba import njit

COMPARED = 0
CONFIRMED = 1
CONTRADICTED = 2
SQUARED_ERROR = 3
TEXTURE_SUMS = slice(4, 10)  # count, a, b, aa, bb, ab
COLOUR_SUMS = slice(10, 16)
FIGURES = 16

NEAR_Z_M = 0.1
ROBUST_WIDTH = 2.0
"""Residuals of so many standard deviations get a quarter of the full weight."""
FREE_SPACE_SIGMAS = 6.0
FREE_SPACE_MARGIN_M = 0.05
BACK_COSINE = 0.2
"""Beyond this cosine a surface faces away: both views cannot see it. Normals at edges are noise."""
CONFIRM_SIGMAS = 3.0
CONFIRM_MARGIN_M = 0.01


@njit(cache=True, nogil=True)
def linearise(
    points, texture, variance, fixed_from_source, sign, intrinsics, depth, depth_variance, normals,
    fixed_texture, gradient, gate_m, texture_variance, hessian, slope,
):  # fmt: skip
    """Add the Gauss-Newton terms of one image against another; returns the points used.

    points (n, 3) in the source anchor's frame, texture (n,), variance (n,) of their depth;
    fixed_from_source (4, 4); sign +1 where the points move with the right perturbation xi of
    target_from_source, -1 where the fixed image does. Point-to-plane distance (metres) and
    texture difference, both weighted by their variance and by 1 / (1 + r^2 / (c s)^2)^2.
    Adds to hessian (6, 6) and slope (6,) = J^T W r, order (translation, rotation).
    """
    height, width = depth.shape
    fx, fy, cx, cy = intrinsics
    used = 0
    row = np.empty(6)
    for index in range(points.shape[0]):
        px, py, pz = points[index, 0], points[index, 1], points[index, 2]
        m = fixed_from_source
        x = m[0, 0] * px + m[0, 1] * py + m[0, 2] * pz + m[0, 3]
        y = m[1, 0] * px + m[1, 1] * py + m[1, 2] * pz + m[1, 3]
        z = m[2, 0] * px + m[2, 1] * py + m[2, 2] * pz + m[2, 3]
        if z < NEAR_Z_M:
            continue
        u, v = fx * x / z + cx, fy * y / z + cy
        if not (u >= 1.0 and v >= 1.0 and u < width - 2.0 and v < height - 2.0):
            continue
        iu, iv = int(u + 0.5), int(v + 0.5)
        d = depth[iv, iu]
        if d <= 0.0 or abs(z - d) > gate_m:
            continue
        nx, ny, nz = normals[iv, iu, 0], normals[iv, iu, 1], normals[iv, iu, 2]
        if nz == 0.0:
            continue
        used += 1
        qx, qy = (iu - cx) / fx * d, (iv - cy) / fy * d
        error = nx * (x - qx) + ny * (y - qy) + nz * (z - d)
        spread = (variance[index] + depth_variance[iv, iu]) * nz * nz + 1e-6
        robust = 1.0 + error * error / (ROBUST_WIDTH * ROBUST_WIDTH * spread)
        _add(row, nx, ny, nz, m, px, py, pz, sign)
        _accumulate(hessian, slope, row, error, 1.0 / (spread * robust * robust))

        fu, fv = u - int(u), v - int(v)
        iu, iv = int(u), int(v)
        error = _bilinear(fixed_texture, iu, iv, fu, fv) - texture[index]
        gu = _bilinear(gradient[:, :, 0], iu, iv, fu, fv) * fx / z
        gv = _bilinear(gradient[:, :, 1], iu, iv, fu, fv) * fy / z
        robust = 1.0 + error * error / (ROBUST_WIDTH * ROBUST_WIDTH * texture_variance)
        _add(row, gu, gv, -(gu * x + gv * y) / z, m, px, py, pz, sign)
        _accumulate(hessian, slope, row, error, 1.0 / (texture_variance * robust * robust))
    return used


@njit(cache=True, nogil=True)
def compare(
    points, texture, colour, variance, camera_centre, fixed_from_source, intrinsics, depth,
    depth_variance, normals, fixed_texture, fixed_colour, figures,
):  # fmt: skip
    """Add to figures (FIGURES,) how one image's points look in another image.

    COMPARED: fall on a depth reading; CONFIRMED: agree with it; CONTRADICTED: stand where the
    other image saw through, or on a surface of which their own camera would see the back;
    SQUARED_ERROR: sum of squared point-to-plane distances of the confirmed; sums of texture and
    of colour (deviation from grey) for their correlation. camera_centre (3,): where the points
    were seen from, in their frame.
    """
    height, width = depth.shape
    fx, fy, cx, cy = intrinsics
    m = fixed_from_source
    sx, sy, sz = camera_centre
    eye_x = m[0, 0] * sx + m[0, 1] * sy + m[0, 2] * sz + m[0, 3]
    eye_y = m[1, 0] * sx + m[1, 1] * sy + m[1, 2] * sz + m[1, 3]
    eye_z = m[2, 0] * sx + m[2, 1] * sy + m[2, 2] * sz + m[2, 3]
    for index in range(points.shape[0]):
        px, py, pz = points[index, 0], points[index, 1], points[index, 2]
        x = m[0, 0] * px + m[0, 1] * py + m[0, 2] * pz + m[0, 3]
        y = m[1, 0] * px + m[1, 1] * py + m[1, 2] * pz + m[1, 3]
        z = m[2, 0] * px + m[2, 1] * py + m[2, 2] * pz + m[2, 3]
        if z < NEAR_Z_M:
            continue
        u, v = fx * x / z + cx, fy * y / z + cy
        if not (u >= 1.0 and v >= 1.0 and u < width - 2.0 and v < height - 2.0):
            continue
        iu, iv = int(u + 0.5), int(v + 0.5)
        d = depth[iv, iu]
        if d <= 0.0:
            continue
        figures[COMPARED] += 1.0
        sigma = np.sqrt(variance[index] + depth_variance[iv, iu])
        if z < d and _least_around(depth, iu, iv) - z > (
            FREE_SPACE_MARGIN_M + FREE_SPACE_SIGMAS * sigma
        ):
            figures[CONTRADICTED] += 1.0
            continue
        error = z - d
        nx, ny, nz = normals[iv, iu, 0], normals[iv, iu, 1], normals[iv, iu, 2]
        if nz != 0.0 and abs(error) < 0.2:
            error = nx * (x - (iu - cx) / fx * d) + ny * (y - (iv - cy) / fy * d) + nz * (z - d)
        if abs(error) > CONFIRM_MARGIN_M + CONFIRM_SIGMAS * sigma:
            continue
        ex, ey, ez = eye_x - x, eye_y - y, eye_z - z
        facing = nx * ex + ny * ey + nz * ez
        if facing < -BACK_COSINE * np.sqrt(ex * ex + ey * ey + ez * ez):
            figures[CONTRADICTED] += 1.0
            continue
        figures[CONFIRMED] += 1.0
        figures[SQUARED_ERROR] += error * error
        fu, fv = u - int(u), v - int(v)
        there = _bilinear(fixed_texture, int(u), int(v), fu, fv)
        _correlate(figures, 4, texture[index], there)
        for a, b in ((0, 1), (1, 2)):
            # Opponent channels R-G and G-B do not change with brightness.
            here = colour[index, a] - colour[index, b]
            _correlate(figures, 10, here, fixed_colour[iv, iu, a] - fixed_colour[iv, iu, b])


@njit(cache=True, nogil=True, inline="always")
def _add(row, gx, gy, gz, m, px, py, pz, sign):
    """Row of the Jacobian: a gradient in the fixed camera's frame, for a point of the source."""
    hx = sign * (m[0, 0] * gx + m[1, 0] * gy + m[2, 0] * gz)
    hy = sign * (m[0, 1] * gx + m[1, 1] * gy + m[2, 1] * gz)
    hz = sign * (m[0, 2] * gx + m[1, 2] * gy + m[2, 2] * gz)
    row[0], row[1], row[2] = hx, hy, hz
    row[3], row[4], row[5] = py * hz - pz * hy, pz * hx - px * hz, px * hy - py * hx


@njit(cache=True, nogil=True, inline="always")
def _accumulate(hessian, slope, row, error, weight):
    for i in range(6):
        scaled = weight * row[i]
        slope[i] += scaled * error
        for j in range(i, 6):
            hessian[i, j] += scaled * row[j]


@njit(cache=True, nogil=True, inline="always")
def _bilinear(image, iu, iv, fu, fv):
    upper = (1.0 - fu) * image[iv, iu] + fu * image[iv, iu + 1]
    lower = (1.0 - fu) * image[iv + 1, iu] + fu * image[iv + 1, iu + 1]
    return (1.0 - fv) * upper + fv * lower


@njit(cache=True, nogil=True, inline="always")
def _least_around(depth, iu, iv):
    """The nearest reading of the 3 x 3 pixels: at edges, nothing is called free space."""
    least = depth[iv, iu]
    for row in range(iv - 1, iv + 2):
        for column in range(iu - 1, iu + 2):
            value = depth[row, column]
            if value > 0.0 and value < least:
                least = value
    return least


@njit(cache=True, nogil=True, inline="always")
def _correlate(figures, first, a, b):
    figures[first] += 1.0
    figures[first + 1] += a
    figures[first + 2] += b
    figures[first + 3] += a * a
    figures[first + 4] += b * b
    figures[first + 5] += a * b
