"""Stage 6, project backward: from the pairs' sums to the gradients of Gaussians and camera pose.

With D = S^-1 = [[A, B], [B, C]] and the moments m of `blend_backward`:

    dL/d(u, v) = D (m_x, m_y),   dL/dD = -1/2 [[m_xx, m_xy], [m_xy, m_yy]],   dL/dS = -D dL/dD D,

then through S = (J V)(J V)^T to J and V, and on to mean, axes and scales. Gradients are by natural
values (scale in metres, opacity, not their logarithms); the quaternion's gradient is orthogonal to
it. The pose gradient is by a perturbation of camera_from_frame on the left, summed per chunk in
float64 and in order, so that it does not depend on the number of threads. Lanes are Gaussians.
"""

from __future__ import annotations

import numpy as np

from magic_core.render import layout
from magic_core.render.blend_backward import PAIR_GRADIENT
from magic_core.render.jit import inlined, kernel
from magic_core.render.lanes import LANES
from magic_core.render.layout import CHUNK, RECORD, f32
from magic_core.render.project import (
    covariance,
    jacobian,
    projected_axes,
    rotation_entries,
    scaled_axes,
    stage_inputs,
    to_camera,
)
from magic_core.render.simd import (
    fma,
    fnma,
    lane_sum,
    maximum,
    select,
    splat,
    square_root,
    zero_unless,
)
from magic_core.render.simd_memory import claim, load, store, store3, store4

_INPUTS = 14
_SUMS = _INPUTS * LANES  # the ten sums of each Gaussian, one row per sum
_DRAWN = _SUMS + 10 * LANES  # 1 where the lane's Gaussian was drawn
_ROW = _DRAWN + LANES  # one Gaussian's sums while its slots are added
_SCRATCH = _ROW + 16

_ZERO, _ONE, _TWO, _HALF = f32(0.0), f32(1.0), f32(2.0), f32(0.5)


@inlined
def _add_slots(scratch, lane, g, touched, record_ints, slot_starts, pair_gradients, pair_written):
    """Sum the written slots of Gaussian g, in order of tiles, into column `lane`."""
    slot = np.int64(slot_starts[g // CHUNK] + record_ints[RECORD * g + layout.SLOT])
    for part in range(0, 16, LANES):
        total = splat(_ZERO)
        for k in range(slot, slot + touched[g]):
            if pair_written[k] != 0:
                total = total + load(pair_gradients, PAIR_GRADIENT * k + part)
        store(scratch, _ROW + part, total)
    for k in range(10):
        scratch[_SUMS + k * LANES + lane] = scratch[_ROW + k]
    scratch[_DRAWN + lane] = _ONE


@inlined
def _gather_sums(scratch, first, n, touched, record_ints, slot_starts, pair_gradients,
                 pair_written):  # fmt: skip
    """Fill the rows of sums for LANES Gaussians; returns whether any was drawn."""
    for row in range(11):
        store(scratch, _SUMS + row * LANES, splat(_ZERO))
    drawn = False
    for lane in range(min(LANES, n - first)):
        if touched[first + lane] > 0:
            drawn = True
            _add_slots(
                scratch, lane, first + lane, touched, record_ints, slot_starts,
                pair_gradients, pair_written,
            )  # fmt: skip
    return drawn


@inlined
def _covariance_gradient(s11, s12, s22, m_xx, m_xy, m_yy):
    """(dL/ds11, dL/ds12 (of one off-diagonal entry), dL/ds22) and the conic (A, B, C)."""
    inverse = splat(_ONE) / fnma(s12, s12, s11 * s22)
    a, b, c = s22 * inverse, splat(_ZERO) - s12 * inverse, s11 * inverse
    half = splat(_HALF)
    # -D M D with M = -1/2 m: the two minus signs cancel.
    p00, p01 = fma(a, m_xx, b * m_xy), fma(a, m_xy, b * m_yy)
    p10, p11 = fma(b, m_xx, c * m_xy), fma(b, m_xy, c * m_yy)
    return (
        half * fma(p00, a, p01 * b), half * fma(p00, b, p01 * c), half * fma(p10, b, p11 * c),
        a, b, c,
    )  # fmt: skip


@inlined
def _back_rotated(view, row, x, y, z):
    """Component `row` of the transposed camera_from_frame rotation times (x, y, z)."""
    return fma(splat(view[row]), x, fma(splat(view[row + 3]), y, splat(view[row + 6]) * z))


@inlined
def _quaternion_gradient(w, x, y, z, inverse_norm, m):
    """From dL/dR (nine entries) to the gradient by the quaternion before normalisation."""
    m00, m01, m02, m10, m11, m12, m20, m21, m22 = m
    two = splat(_TWO)
    dw = two * fma(x, m21 - m12, fma(y, m02 - m20, z * (m10 - m01)))
    dx = two * fma(y, m01 + m10, fma(z, m02 + m20, fnma(two * x, m11 + m22, w * (m21 - m12))))
    dy = two * fma(x, m01 + m10, fma(z, m12 + m21, fnma(two * y, m00 + m22, w * (m02 - m20))))
    dz = two * fma(x, m02 + m20, fma(y, m12 + m21, fnma(two * z, m00 + m11, w * (m10 - m01))))
    along = fma(dw, w, fma(dx, x, fma(dy, y, dz * z)))
    return (
        fnma(w, along, dw) * inverse_norm, fnma(x, along, dx) * inverse_norm,
        fnma(y, along, dy) * inverse_norm, fnma(z, along, dz) * inverse_norm,
    )  # fmt: skip


@inlined
def _lanes_backward(scratch, view, first, means, quaternions, scales, opacities, colours):
    """Write the gradients of LANES Gaussians from their inputs and sums; returns the pose's."""
    zero, one, two = splat(_ZERO), splat(_ONE), splat(_TWO)
    drawn = load(scratch, _DRAWN) > zero
    x, y, z = to_camera(view, load(scratch, 0), load(scratch, LANES), load(scratch, 2 * LANES))
    inverse_z = one / select(drawn, z, one)
    qw, qx = load(scratch, 3 * LANES), load(scratch, 4 * LANES)
    qy, qz = load(scratch, 5 * LANES), load(scratch, 6 * LANES)
    norm = square_root(fma(qw, qw, fma(qx, qx, fma(qy, qy, qz * qz))))
    unit = one / select(drawn, norm, one)
    qw, qx, qy, qz = qw * unit, qx * unit, qy * unit, qz * unit
    r = rotation_entries(qw, qx, qy, qz)
    s0, s1, s2 = load(scratch, 7 * LANES), load(scratch, 8 * LANES), load(scratch, 9 * LANES)
    axes = scaled_axes(view, r, s0, s1, s2)
    v00, v01, v02, v10, v11, v12, v20, v21, v22 = axes
    ratio_x, ratio_y = x * inverse_z, y * inverse_z
    j00, j02, j11, j12 = jacobian(view, ratio_x, ratio_y, inverse_z)
    rows = projected_axes(axes, j00, j02, j11, j12)
    a0, a1, a2, b0, b1, b2 = rows
    s11, s12, s22 = covariance(rows)
    m_x, m_y = load(scratch, _SUMS + LANES), load(scratch, _SUMS + 2 * LANES)
    h11, h12, h22, conic_a, conic_b, conic_c = _covariance_gradient(
        s11, s12, s22,
        load(scratch, _SUMS + 3 * LANES), load(scratch, _SUMS + 4 * LANES),
        load(scratch, _SUMS + 5 * LANES),
    )  # fmt: skip
    du, dv = fma(conic_a, m_x, conic_b * m_y), fma(conic_b, m_x, conic_c * m_y)
    # S = rows rows^T: d(rows) = 2 dS rows.
    da0, da1 = two * fma(h11, a0, h12 * b0), two * fma(h11, a1, h12 * b1)
    da2 = two * fma(h11, a2, h12 * b2)
    db0, db1 = two * fma(h12, a0, h22 * b0), two * fma(h12, a1, h22 * b1)
    db2 = two * fma(h12, a2, h22 * b2)
    # rows = J V.
    dj00 = fma(da0, v00, fma(da1, v01, da2 * v02))
    dj02 = fma(da0, v20, fma(da1, v21, da2 * v22))
    dj11 = fma(db0, v10, fma(db1, v11, db2 * v12))
    dj12 = fma(db0, v20, fma(db1, v21, db2 * v22))
    d00, d01, d02 = j00 * da0, j00 * da1, j00 * da2
    d10, d11, d12 = j11 * db0, j11 * db1, j11 * db2
    d20, d21, d22 = (
        fma(j02, da0, j12 * db0), fma(j02, da1, j12 * db1), fma(j02, da2, j12 * db2)
    )  # fmt: skip
    # J02 = -J00 clamped_x, where clamped_x follows x/z only inside the clamp; likewise J12.
    free_x = (ratio_x >= splat(view[16])) & (ratio_x <= splat(view[17]))
    free_y = (ratio_y >= splat(view[18])) & (ratio_y <= splat(view[19]))
    dratio_x = fma(splat(view[12]), du, zero_unless(free_x, zero - j00 * dj02))
    dratio_y = fma(splat(view[13]), dv, zero_unless(free_y, zero - j11 * dj12))
    dx, dy = dratio_x * inverse_z, dratio_y * inverse_z
    by_j = fma(j00, dj00, fma(j02, dj02, fma(j11, dj11, j12 * dj12)))
    along_ray = fma(dratio_x, ratio_x, fma(dratio_y, ratio_y, by_j))
    dz = fnma(along_ray, inverse_z, load(scratch, _SUMS + 9 * LANES))
    dx, dy = zero_unless(drawn, dx), zero_unless(drawn, dy)
    dz = zero_unless(drawn, dz)
    store3(means, 3 * first, _back_rotated(view, 0, dx, dy, dz),
           _back_rotated(view, 1, dx, dy, dz), _back_rotated(view, 2, dx, dy, dz))  # fmt: skip
    # V = (rotation r) diag(s): back to the Gaussian's own frame.
    m00, m10 = _back_rotated(view, 0, d00, d10, d20), _back_rotated(view, 1, d00, d10, d20)
    m20 = _back_rotated(view, 2, d00, d10, d20)
    m01, m11 = _back_rotated(view, 0, d01, d11, d21), _back_rotated(view, 1, d01, d11, d21)
    m21 = _back_rotated(view, 2, d01, d11, d21)
    m02, m12 = _back_rotated(view, 0, d02, d12, d22), _back_rotated(view, 1, d02, d12, d22)
    m22 = _back_rotated(view, 2, d02, d12, d22)
    ds0 = fma(m00, r[0], fma(m10, r[3], m20 * r[6]))
    ds1 = fma(m01, r[1], fma(m11, r[4], m21 * r[7]))
    ds2 = fma(m02, r[2], fma(m12, r[5], m22 * r[8]))
    store3(scales, 3 * first, zero_unless(drawn, ds0), zero_unless(drawn, ds1),
           zero_unless(drawn, ds2))  # fmt: skip
    gw, gx, gy, gz = _quaternion_gradient(
        qw, qx, qy, qz, unit,
        (m00 * s0, m01 * s1, m02 * s2, m10 * s0, m11 * s1, m12 * s2, m20 * s0, m21 * s1, m22 * s2),
    )  # fmt: skip
    store4(quaternions, 4 * first, zero_unless(drawn, gw), zero_unless(drawn, gx),
           zero_unless(drawn, gy), zero_unless(drawn, gz))  # fmt: skip
    opacity = maximum(load(scratch, 10 * LANES), splat(layout.ALPHA_MIN))
    store(opacities, first, load(scratch, _SUMS) / opacity)
    store3(colours, 3 * first, load(scratch, _SUMS + 6 * LANES),
           load(scratch, _SUMS + 7 * LANES), load(scratch, _SUMS + 8 * LANES))  # fmt: skip
    # A rotation phi on the left moves every point p and axis v by phi x p and phi x v.
    tx = fma(v10, d20, fma(v11, d21, v12 * d22)) - fma(v20, d10, fma(v21, d11, v22 * d12))
    ty = fma(v20, d00, fma(v21, d01, v22 * d02)) - fma(v00, d20, fma(v01, d21, v02 * d22))
    tz = fma(v00, d10, fma(v01, d11, v02 * d12)) - fma(v10, d00, fma(v11, d01, v12 * d02))
    rx, ry = fnma(z, dy, fma(y, dz, tx)), fnma(x, dz, fma(z, dx, ty))
    rz = fnma(y, dx, fma(x, dy, tz))
    return (
        dx, dy, dz, zero_unless(drawn, rx), zero_unless(drawn, ry), zero_unless(drawn, rz),
    )  # fmt: skip


@inlined
def _store_zeros(first, means, quaternions, scales, opacities, colours):
    """The gradients of LANES Gaussians that were not drawn."""
    zero = splat(_ZERO)
    store3(means, 3 * first, zero, zero, zero)
    store4(quaternions, 4 * first, zero, zero, zero, zero)
    store3(scales, 3 * first, zero, zero, zero)
    store(opacities, first, zero)
    store3(colours, 3 * first, zero, zero, zero)


@kernel
def project_backward(claimed, means, quaternions, scales, opacities, colours, view,
                     touched, record_ints, slot_starts, pair_gradients, pair_written,
                     d_means, d_quaternions, d_scales, d_opacities, d_colours,
                     d_pose):  # fmt: skip
    """Write every Gaussian's gradient, zeros for those not drawn.

    The gradient arrays are flat, with room for LANES Gaussians past the last. d_pose is
    (chunks, 6) float64: translation, rotation, by a left perturbation of camera_from_frame.
    """
    n = len(opacities)
    scratch = np.empty(_SCRATCH, np.float32)
    pose = np.empty(6 * LANES, np.float32)
    while True:
        chunk = claim(claimed, np.int64(1))
        begin = chunk * CHUNK
        if begin >= n:
            break
        for k in range(6):
            store(pose, k * LANES, splat(_ZERO))
        for first in range(begin, min(begin + CHUNK, n), LANES):
            drawn = _gather_sums(
                scratch, first, n, touched, record_ints, slot_starts, pair_gradients, pair_written
            )
            if not drawn:
                _store_zeros(first, d_means, d_quaternions, d_scales, d_opacities, d_colours)
                continue
            stage_inputs(scratch, means, quaternions, scales, opacities, colours, first, n)
            by_pose = _lanes_backward(
                scratch, view, first, d_means, d_quaternions, d_scales, d_opacities, d_colours
            )
            for k in range(6):
                store(pose, k * LANES, load(pose, k * LANES) + by_pose[k])
        for k in range(6):
            d_pose[chunk, k] = np.float64(lane_sum(load(pose, k * LANES)))
