"""Stage 1, project: each Gaussian becomes a 2D Gaussian, its record and the tiles it touches.

EWA splatting (Zwicker et al. 2001, as in 3DGS): with the mean (x, y, z) in the camera frame and
V = camera_from_frame rotation . axes . diag(scales), the 2D covariance is

    S = (J V) (J V)^T + DILATION I,    J = [[fx/z, 0, -fx x/z^2], [0, fy/z, -fy y/z^2]],

where x/z and y/z inside J alone are clamped to the frustum and a margin. A pixel at d from the
centre sees alpha = opacity exp(-d^T S^-1 d / 2). Lanes are Gaussians.
"""

from __future__ import annotations

import numpy as np

from magic_core.render import layout
from magic_core.render.jit import inlined, kernel
from magic_core.render.lanes import LANES
from magic_core.render.layout import CHUNK, RECORD, f32
from magic_core.render.simd import (
    absolute,
    bits,
    ceil,
    float_bits,
    floor,
    fma,
    fnma,
    maximum,
    minimum,
    select,
    splat,
    square_root,
    trailing_zeros,
)
from magic_core.render.simd_memory import atomic_add, claim, load, load3, load4, store
from magic_core.render.vecmath import log

_ZERO, _ONE, _TWO = f32(0.0), f32(1.0), f32(2.0)
_NEAR, _DILATION, _ALPHA_MIN = layout.NEAR_M, layout.DILATION, layout.ALPHA_MIN
_EIGHTH = f32(1.0 / 8.0)
_LARGEST = f32(1e18)  # beyond this a parameter counts as not finite: its square would overflow

# The view: one float32 array that all stages read.
ROTATION, TRANSLATION, FX, FY, CX, CY, CLAMPS = 0, 9, 12, 13, 14, 15, 16
VIEW_SIZE = 20

# Rows of the scratch of the projection, one vector each.
_INPUTS = 14  # mean 3, quaternion 4, scale 3, opacity, colour 3
_OUTPUT = _INPUTS * LANES
_BOUNDS = _OUTPUT + RECORD * LANES  # first and last column, first and last row
_SCRATCH = _BOUNDS + 4 * LANES


def view_of(camera, camera_from_world) -> np.ndarray:
    """(20,) float32: rotation (9), translation (3), fx, fy, cx, cy, clamps of x/z and y/z."""
    view = np.empty(VIEW_SIZE, np.float32)
    view[:9] = camera_from_world[:3, :3].ravel()
    view[9:12] = camera_from_world[:3, 3]
    view[12:16] = camera.fx, camera.fy, camera.cx, camera.cy
    margin_x = layout.FRUSTUM_MARGIN * 0.5 * camera.width / camera.fx
    margin_y = layout.FRUSTUM_MARGIN * 0.5 * camera.height / camera.fy
    view[16:] = (
        -(camera.cx + 0.5) / camera.fx - margin_x,
        (camera.width - 0.5 - camera.cx) / camera.fx + margin_x,
        -(camera.cy + 0.5) / camera.fy - margin_y,
        (camera.height - 0.5 - camera.cy) / camera.fy + margin_y,
    )
    return view


@inlined
def stage_inputs(scratch, means, quaternions, scales, opacities, colours, first, n):
    """Load LANES Gaussians from `first` on as rows of scratch; lanes past the end are culled."""
    if first + LANES <= n:
        x, y, z = load3(means, 3 * first)
        qw, qx, qy, qz = load4(quaternions, 4 * first)
        s0, s1, s2 = load3(scales, 3 * first)
        red, green, blue = load3(colours, 3 * first)
        rows = (x, y, z, qw, qx, qy, qz, s0, s1, s2, load(opacities, first), red, green, blue)
        for row in range(_INPUTS):
            store(scratch, row * LANES, rows[row])
        return
    for lane in range(LANES):
        g = min(first + lane, n - 1)
        for k in range(3):
            scratch[k * LANES + lane] = means[3 * g + k]
            scratch[(7 + k) * LANES + lane] = scales[3 * g + k]
            scratch[(11 + k) * LANES + lane] = colours[3 * g + k]
        for k in range(4):
            scratch[(3 + k) * LANES + lane] = quaternions[4 * g + k]
        scratch[10 * LANES + lane] = opacities[g] if first + lane < n else _ZERO


@inlined
def to_camera(view, x, y, z):
    """Points of the cloud's frame in the camera frame."""
    cx = fma(splat(view[0]), x, fma(splat(view[1]), y, fma(splat(view[2]), z, splat(view[9]))))
    cy = fma(splat(view[3]), x, fma(splat(view[4]), y, fma(splat(view[5]), z, splat(view[10]))))
    cz = fma(splat(view[6]), x, fma(splat(view[7]), y, fma(splat(view[8]), z, splat(view[11]))))
    return cx, cy, cz


@inlined
def rotation_entries(w, x, y, z):
    """The nine entries, row by row, of the rotation of unit quaternions."""
    one, two = splat(_ONE), splat(_TWO)
    x2, y2, z2 = two * x, two * y, two * z
    xx, yy, zz, xy, xz, yz = x * x2, y * y2, z * z2, x * y2, x * z2, y * z2
    wx, wy, wz = w * x2, w * y2, w * z2
    return (
        one - (yy + zz), xy - wz, xz + wy,
        xy + wz, one - (xx + zz), yz - wx,
        xz - wy, yz + wx, one - (xx + yy),
    )  # fmt: skip


@inlined
def rotate_column(view, row, a, b, c):
    """Component `row` of camera_from_frame rotation times the vector (a, b, c)."""
    return fma(splat(view[row]), a, fma(splat(view[row + 1]), b, splat(view[row + 2]) * c))


@inlined
def scaled_axes(view, entries, s0, s1, s2):
    """V, row by row: the Gaussian's axes in the camera frame, scaled."""
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = entries
    return (
        rotate_column(view, 0, r00, r10, r20) * s0,
        rotate_column(view, 0, r01, r11, r21) * s1,
        rotate_column(view, 0, r02, r12, r22) * s2,
        rotate_column(view, 3, r00, r10, r20) * s0,
        rotate_column(view, 3, r01, r11, r21) * s1,
        rotate_column(view, 3, r02, r12, r22) * s2,
        rotate_column(view, 6, r00, r10, r20) * s0,
        rotate_column(view, 6, r01, r11, r21) * s1,
        rotate_column(view, 6, r02, r12, r22) * s2,
    )


@inlined
def jacobian(view, ratio_x, ratio_y, inverse_z):
    """(J00, J02, J11, J12), with x/z and y/z clamped to the frustum and its margin."""
    clamped_x = minimum(maximum(ratio_x, splat(view[16])), splat(view[17]))
    clamped_y = minimum(maximum(ratio_y, splat(view[18])), splat(view[19]))
    j00, j11 = splat(view[12]) * inverse_z, splat(view[13]) * inverse_z
    zero = splat(_ZERO)
    return j00, zero - j00 * clamped_x, j11, zero - j11 * clamped_y


@inlined
def projected_axes(axes, j00, j02, j11, j12):
    """J V: the rows (A0, A1, A2) and (B0, B1, B2)."""
    v00, v01, v02, v10, v11, v12, v20, v21, v22 = axes
    return (
        fma(j00, v00, j02 * v20), fma(j00, v01, j02 * v21), fma(j00, v02, j02 * v22),
        fma(j11, v10, j12 * v20), fma(j11, v11, j12 * v21), fma(j11, v12, j12 * v22),
    )  # fmt: skip


@inlined
def covariance(rows):
    """(s11, s12, s22) of (J V)(J V)^T + DILATION I."""
    a0, a1, a2, b0, b1, b2 = rows
    s11 = fma(a0, a0, fma(a1, a1, fma(a2, a2, splat(_DILATION))))
    s12 = fma(a0, b0, fma(a1, b1, a2 * b2))
    s22 = fma(b0, b0, fma(b1, b1, fma(b2, b2, splat(_DILATION))))
    return s11, s12, s22


@inlined
def _sound(scratch):
    """The lanes whose fourteen parameters are all finite (and not absurdly large)."""
    largest = absolute(load(scratch, 0))
    broken = largest - largest
    for row in range(_INPUTS):
        value = load(scratch, row * LANES)
        broken = broken + (value - value)  # NaN for NaN and infinity, else 0
        largest = maximum(absolute(value), largest)
    return (broken >= splat(_ZERO)) & (largest <= splat(_LARGEST))


@inlined
def _project_lanes(scratch, view, width, height):
    """Fill the output rows of scratch; returns the bits of the sound and of the drawn lanes."""
    zero, one, out = splat(_ZERO), splat(_ONE), _OUTPUT
    sound = _sound(scratch)
    x, y, z = to_camera(view, load(scratch, 0), load(scratch, LANES), load(scratch, 2 * LANES))
    front = sound & (z > splat(_NEAR))
    opacity = load(scratch, 10 * LANES)
    front = front & (opacity >= splat(_ALPHA_MIN))
    if bits(front) == np.uint32(0):
        return bits(sound), np.uint32(0)
    inverse_z = one / select(front, z, one)
    qw, qx = load(scratch, 3 * LANES), load(scratch, 4 * LANES)
    qy, qz = load(scratch, 5 * LANES), load(scratch, 6 * LANES)
    norm = square_root(fma(qw, qw, fma(qx, qx, fma(qy, qy, qz * qz))))
    front = front & (norm > zero)
    unit = one / select(front, norm, one)
    entries = rotation_entries(qw * unit, qx * unit, qy * unit, qz * unit)
    s0, s1, s2 = load(scratch, 7 * LANES), load(scratch, 8 * LANES), load(scratch, 9 * LANES)
    axes = scaled_axes(view, entries, s0, s1, s2)
    ratio_x, ratio_y = x * inverse_z, y * inverse_z
    j00, j02, j11, j12 = jacobian(view, ratio_x, ratio_y, inverse_z)
    s11, s12, s22 = covariance(projected_axes(axes, j00, j02, j11, j12))
    determinant = fnma(s12, s12, s11 * s22)
    front = front & (determinant > zero) & (determinant <= splat(f32(1e30)))
    inverse = one / select(front, determinant, one)
    u = fma(splat(view[12]), ratio_x, splat(view[14]))
    v = fma(splat(view[13]), ratio_y, splat(view[15]))
    k = log(maximum(opacity, splat(_ALPHA_MIN))) * splat(_EIGHTH)
    a = s22 * inverse * splat(f32(-1.0 / 16.0))
    b = s12 * inverse * splat(f32(1.0 / 8.0))
    c = s11 * inverse * splat(f32(-1.0 / 16.0))
    store(scratch, out + layout.U * LANES, u)
    store(scratch, out + layout.V * LANES, v)
    store(scratch, out + layout.A * LANES, a)
    store(scratch, out + layout.B * LANES, b)
    store(scratch, out + layout.C * LANES, c)
    store(scratch, out + layout.K * LANES, k)
    store(scratch, out + layout.RED * LANES, load(scratch, 11 * LANES))
    store(scratch, out + layout.GREEN * LANES, load(scratch, 12 * LANES))
    store(scratch, out + layout.BLUE * LANES, load(scratch, 13 * LANES))
    store(scratch, out + layout.DEPTH * LANES, z)
    # On the line dx = const the quadratic is greatest at dy = SHEAR_Y dx, and the other way round.
    half = splat(f32(-0.5))
    store(scratch, out + layout.SHEAR_Y * LANES, half * b / select(front, c, one))
    store(scratch, out + layout.SHEAR_X * LANES, half * b / select(front, a, one))
    # alpha >= ALPHA_MIN within d^T S^-1 d <= reach; its extent along x is sqrt(reach s11).
    reach = maximum(splat(f32(16.0)) * (k - splat(layout.LOG_THRESHOLD)), zero)
    extent_x, extent_y = square_root(reach * s11), square_root(reach * s22)
    store(scratch, out + layout.RADIUS * LANES, maximum(extent_x, extent_y))
    last_x, last_y = splat(f32(width - 1)), splat(f32(height - 1))
    x0, x1 = ceil(u - extent_x), floor(u + extent_x)
    y0, y1 = ceil(v - extent_y), floor(v + extent_y)
    drawn = front & (x1 >= zero) & (x0 <= last_x) & (x0 <= x1)
    drawn = drawn & (y1 >= zero) & (y0 <= last_y) & (y0 <= y1)
    per_tile = splat(f32(1.0 / layout.TILE))
    store(scratch, _BOUNDS, floor(maximum(x0, zero) * per_tile))
    store(scratch, _BOUNDS + LANES, floor(minimum(x1, last_x) * per_tile))
    store(scratch, _BOUNDS + 2 * LANES, floor(maximum(y0, zero) * per_tile))
    store(scratch, _BOUNDS + 3 * LANES, floor(minimum(y1, last_y) * per_tile))
    return bits(sound), bits(drawn)


@kernel
def project(claimed, means, quaternions, scales, opacities, colours, view, width, height,
            tiles_x, records, record_ints, columns, rows, touched, keys, ids, chunks,
            corners):  # fmt: skip
    """Project all Gaussians, CHUNK at a time.

    Writes per Gaussian: its record, columns and rows of tiles (first | last << 16), touched
    tiles (0 when culled). Per chunk: keys (depth bits) and ids of the drawn Gaussians, packed from
    CHUNK * chunk on, and chunks[chunk] = (drawn, touched tiles, culled as not finite).
    corners (threads' sum, (tiles_y + 1) * (tiles_x + 1)) gets +1 -1 -1 +1 at the corners of each
    rectangle of tiles: its 2D prefix sum is the number of Gaussians per tile.
    """
    n = len(opacities)
    scratch = np.empty(_SCRATCH, np.float32)
    stride = tiles_x + 1
    own_corners = np.zeros(len(corners), np.int32)
    while True:
        chunk = claim(claimed, np.int64(1))
        begin = chunk * CHUNK
        if begin >= n:
            break
        drawn_count, slot, broken = 0, 0, 0
        for first in range(begin, min(begin + CHUNK, n), LANES):
            stage_inputs(scratch, means, quaternions, scales, opacities, colours, first, n)
            sound, drawn = _project_lanes(scratch, view, width, height)
            for lane in range(min(LANES, n - first)):
                touched[first + lane] = 0
            inside = min(LANES, n - first)
            all_lanes = np.uint32((1 << inside) - 1)
            missing = all_lanes & ~sound
            while missing != np.uint32(0):
                broken += 1
                missing &= missing - np.uint32(1)
            left = drawn & all_lanes
            while left != np.uint32(0):
                lane = trailing_zeros(left)
                left &= left - np.uint32(1)
                g = first + lane
                o = RECORD * g
                for field in range(12):
                    records[o + field] = scratch[_OUTPUT + field * LANES + lane]
                records[o + layout.RADIUS] = scratch[_OUTPUT + layout.RADIUS * LANES + lane]
                x0 = np.int32(scratch[_BOUNDS + lane])
                x1 = np.int32(scratch[_BOUNDS + LANES + lane])
                y0 = np.int32(scratch[_BOUNDS + 2 * LANES + lane])
                y1 = np.int32(scratch[_BOUNDS + 3 * LANES + lane])
                tiles = (x1 - x0 + 1) * (y1 - y0 + 1)
                record_ints[o + layout.SLOT] = slot
                record_ints[o + layout.SLOT_BASE] = slot - y0 * (x1 - x0 + 1) - x0
                record_ints[o + layout.ACROSS] = x1 - x0 + 1
                columns[g] = x0 | (x1 << 16)
                rows[g] = y0 | (y1 << 16)
                touched[g] = tiles
                slot += tiles
                own_corners[y0 * stride + x0] += 1
                own_corners[y0 * stride + x1 + 1] -= 1
                own_corners[(y1 + 1) * stride + x0] -= 1
                own_corners[(y1 + 1) * stride + x1 + 1] += 1
                keys[begin + drawn_count] = float_bits(
                    scratch[_OUTPUT + layout.DEPTH * LANES + lane]
                )
                ids[begin + drawn_count] = g
                drawn_count += 1
        chunks[3 * chunk] = drawn_count
        chunks[3 * chunk + 1] = slot
        chunks[3 * chunk + 2] = broken
    for i in range(len(corners)):
        atomic_add(corners, i, own_corners[i])
