"""The kernels behind `linearisation`: rows of residuals and their 9 x 9 Gram matrix.

A row is worked through in spans of pixels, and each stage is a loop over a span: project, sample,
compare, weigh depth, weigh each colour, Gram. Fast-math is right here: all inputs are finite, and
sums over thousands of pixels may be taken in any order. The equations are in `linearisation`.
"""

from __future__ import annotations

import numpy as np

from magic_core.render.jit import fast_kernel
from magic_core.render.simd_memory import claim

UNKNOWNS = 8  # translation (3), rotation (3), gain, bias
COLUMNS = UNKNOWNS + 1  # the residual itself is the last column of the Jacobian
# Sums behind the 9 x 9 Gram matrix: cost, then soft counts of the pixels that are visible in both
# views, of those with two depths, and of those whose depths agree.
COST, SUMS = COLUMNS * COLUMNS, 4

BLOCK_ROWS = 16

# A row is worked through in spans. The fields of a span lie in one flat array at offsets known to
# the compiler, which then needs no overlap checks and keeps all loops but one in vector registers.
_SPAN = 160
_U, _V = 0 * _SPAN, 1 * _SPAN  # the pixel of the new image
_RED, _GREEN, _BLUE, _DEPTH = 2 * _SPAN, 3 * _SPAN, 4 * _SPAN, 5 * _SPAN  # its values there
_ERROR_RED, _ERROR_DEPTH = 6 * _SPAN, 9 * _SPAN  # residuals: red, green, blue, depth
_MEASURED, _NORMAL = 10 * _SPAN, 13 * _SPAN  # three fields each
_VARIANCE, _MASK_COLOUR, _MASK_DEPTH = 16 * _SPAN, 17 * _SPAN, 18 * _SPAN
_INVERSE_Z, _GRADIENT = 19 * _SPAN, 20 * _SPAN  # of the reference: 1 / Z; two fields, du and dv
_JACOBIAN, _COLUMN = 22 * _SPAN, 4 * _SPAN  # nine columns: red, green, blue and depth in turn
_WORK = _JACOBIAN + COLUMNS * _COLUMN


@fast_kernel
def sum_blocks(claimed, reference, image, intrinsics, pose, inverse, photometric, model, blocks):
    """Claim blocks of rows and sum each: the Gram matrix (9 x 9, upper triangle), then `SUMS`."""
    last_row = reference.shape[1] - 1
    while True:
        block = claim(claimed, np.int64(1))
        if block >= len(blocks):
            return
        first = 1 + block * BLOCK_ROWS
        _sum_rows(
            first, min(first + BLOCK_ROWS, last_row),
            reference, image, intrinsics, pose, inverse, photometric, model, blocks[block],
        )  # fmt: skip


@fast_kernel
def _sum_rows(first, last, reference, image, intrinsics, pose, inverse, photometric, model, sums):
    """Add the rows [first, last) to `sums`."""
    inner = reference.shape[2] - 1
    work = np.zeros(_WORK, np.float32)
    for row in range(first, last):
        for start in range(1, inner, _SPAN):
            n = min(_SPAN, inner - start)
            _project(row, start, n, reference, intrinsics, pose, work)
            _sample(n, image, model, work)
            _compare(row, start, n, reference, intrinsics, inverse, photometric, model, work)
            if n < _SPAN:
                work[_JACOBIAN:] = np.float32(0.0)
            _weigh_depth(row, start, n, reference, model, work, sums)
            _weigh_red(row, start, n, reference, intrinsics, model, work, sums)
            _weigh_green(row, start, n, reference, intrinsics, model, work, sums)
            _weigh_blue(row, start, n, reference, intrinsics, model, work, sums)
            # Written out: only offsets that are constants after inlining vectorise.
            _add_gram_block(0, 0, work, sums)
            _add_gram_block(0, 3, work, sums)
            _add_gram_block(0, 6, work, sums)
            _add_gram_block(3, 3, work, sums)
            _add_gram_block(3, 6, work, sums)
            _add_gram_block(6, 6, work, sums)


@fast_kernel
def sample_rows(first, step, reference, image, intrinsics, pose, inverse, photometric, model):
    """(2, n) absolute residuals of every step-th row: mean colour, and depth in model deviations.

    -1 stands for none.
    """
    inner = reference.shape[2] - 1
    work = np.zeros(_WORK, np.float32)
    rows = (reference.shape[1] - 2 - first) // step + 1
    errors = np.full((2, rows, inner), np.float32(-1.0))
    for r in range(rows):
        row = first + r * step
        for start in range(1, inner, _SPAN):
            n = min(_SPAN, inner - start)
            _project(row, start, n, reference, intrinsics, pose, work)
            _sample(n, image, model, work)
            _compare(row, start, n, reference, intrinsics, inverse, photometric, model, work)
            for i in range(n):
                opaque = reference[4, row, start + i] > 0.7
                if opaque and work[_MASK_COLOUR + i] > 0.0:
                    total = np.float32(0.0)
                    for channel in range(3):
                        total += abs(work[_ERROR_RED + channel * _SPAN + i])
                    errors[0, r, start + i] = total / np.float32(3.0)
                if opaque and work[_MASK_DEPTH + i] > 0.0:
                    depth_error = abs(work[_ERROR_DEPTH + i])
                    errors[1, r, start + i] = depth_error / np.sqrt(work[_VARIANCE + i])
    return errors.reshape(2, -1)


@fast_kernel
def _project(row, start, n, reference, intrinsics, pose, work):
    """Where the points of a span of the reference are seen by the new camera, and whether."""
    f32 = np.float32
    zero, one, near = f32(0.0), f32(1.0), f32(0.05)
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    p0, p1, p2, p3, p4, p5 = pose[0], pose[1], pose[2], pose[3], pose[4], pose[5]
    p6, p7, p8, p9, p10, p11 = pose[6], pose[7], pose[8], pose[9], pose[10], pose[11]
    last_u, last_v = f32(reference.shape[2]) - f32(1.001), f32(reference.shape[1]) - f32(1.001)
    ray_y, inverse_fx, first_x = (f32(row) - cy) / fy, one / fx, f32(start) - cx
    depths = reference[3, row, start:]
    for i in range(n):
        z = depths[i]
        ray_x = (f32(i) + first_x) * inverse_fx
        seen_x = (p0 * ray_x + p1 * ray_y + p2) * z + p3
        seen_y = (p4 * ray_x + p5 * ray_y + p6) * z + p7
        seen_z = (p8 * ray_x + p9 * ray_y + p10) * z + p11
        inverse_z = one / max(seen_z, near)
        u, v = fx * seen_x * inverse_z + cx, fy * seen_y * inverse_z + cy
        inside = (u >= zero) & (v >= zero) & (u <= last_u) & (v <= last_v)
        inside = inside & (seen_z > near) & (z > zero)
        work[_U + i] = min(max(u, zero), last_u)
        work[_V + i] = min(max(v, zero), last_v)
        work[_MASK_COLOUR + i] = one if inside else zero


@fast_kernel
def _sample(n, image, model, work):
    """Bilinear samples of all four channels, and whether the depths around are steady.

    A loop of its own: its addresses are data, so it cannot run across pixels in vector
    registers, but the four interleaved channels of a pixel lie together.
    """
    f32, i32 = np.float32, np.int32
    flat, step = image.reshape(-1), model[11]
    stride = i32(4 * image.shape[1])
    for x in range(n):
        u, v = work[_U + x], work[_V + x]
        left, top = i32(u), i32(v)
        a, b = u - f32(left), v - f32(top)
        i = np.uint32(i32(4) * left + stride * top)
        j = np.uint32(i + np.uint32(stride))
        w00, w10 = (f32(1.0) - a) * (f32(1.0) - b), a * (f32(1.0) - b)
        w01, w11 = (f32(1.0) - a) * b, a * b
        d00, d10, d01, d11 = flat[i + 3], flat[i + 7], flat[j + 3], flat[j + 7]
        red = w00 * flat[i] + w10 * flat[i + 4] + w01 * flat[j] + w11 * flat[j + 4]
        green = w00 * flat[i + 1] + w10 * flat[i + 5] + w01 * flat[j + 1] + w11 * flat[j + 5]
        blue = w00 * flat[i + 2] + w10 * flat[i + 6] + w01 * flat[j + 2] + w11 * flat[j + 6]
        depth = w00 * d00 + w10 * d10 + w01 * d01 + w11 * d11
        nearest, farthest = min(min(d00, d10), min(d01, d11)), max(max(d00, d10), max(d01, d11))
        steady = (nearest > f32(0.0)) & (farthest - nearest < step * farthest)
        work[_RED + x] = red
        work[_GREEN + x] = green
        work[_BLUE + x] = blue
        work[_DEPTH + x] = depth
        work[_MASK_DEPTH + x] = f32(1.0) if steady else f32(0.0)


@fast_kernel
def _compare(row, start, n, reference, intrinsics, inverse, photometric, model, work):
    """Residuals, measured points, normals, depth mask and depth variance of one span."""
    f32 = np.float32
    zero, half, one, near = f32(0.0), f32(0.5), f32(1.0), f32(0.05)
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    gain, bias = photometric[0], photometric[1]
    k0, k2, slope2, step = model[2], model[3], model[4], model[11]
    i0, i1, i2, i3, i4, i5 = inverse[0], inverse[1], inverse[2], inverse[3], inverse[4], inverse[5]
    i6, i7, i8 = inverse[6], inverse[7], inverse[8]
    i9, i10, i11 = inverse[9], inverse[10], inverse[11]
    ray_y, inverse_fx, inverse_fy = (f32(row) - cy) / fy, one / fx, one / fy
    first_x = f32(start) - cx
    red, green = reference[0, row, start:], reference[1, row, start:]
    blue, depths = reference[2, row, start:], reference[3, row, start:]
    before, after = reference[3, row, start - 1 :], reference[3, row, start + 1 :]
    above, below = reference[3, row - 1, start:], reference[3, row + 1, start:]
    for i in range(n):
        work[_ERROR_RED + i] = red[i] - (gain * work[_RED + i] + bias)
        work[_ERROR_RED + _SPAN + i] = green[i] - (gain * work[_GREEN + i] + bias)
        work[_ERROR_RED + 2 * _SPAN + i] = blue[i] - (gain * work[_BLUE + i] + bias)
        depth = work[_DEPTH + i]
        ray_u, ray_v = (work[_U + i] - cx) * inverse_fx, (work[_V + i] - cy) * inverse_fy
        x_m = (i0 * ray_u + i1 * ray_v + i2) * depth + i3
        y_m = (i4 * ray_u + i5 * ray_v + i6) * depth + i7
        z_m = (i8 * ray_u + i9 * ray_v + i10) * depth + i11
        z = depths[i]
        ray_x = (f32(i) + first_x) * inverse_fx
        z_u, z_v = half * (after[i] - before[i]), half * (below[i] - above[i])
        inverse_z = one / max(z, near)
        work[_INVERSE_Z + i] = inverse_z
        n_x, n_y = -fx * z_u * inverse_z, -fy * z_v * inverse_z
        n_z = one - (n_x * ray_x + n_y * ray_y)
        # n . X = z by construction, so n . (X_measured - X) = n . X_measured - z.
        work[_ERROR_DEPTH + i] = n_x * x_m + n_y * y_m + n_z * z_m - z
        work[_MEASURED + i] = x_m
        work[_MEASURED + _SPAN + i] = y_m
        work[_MEASURED + 2 * _SPAN + i] = z_m
        work[_NORMAL + i] = n_x
        work[_NORMAL + _SPAN + i] = n_y
        work[_NORMAL + 2 * _SPAN + i] = n_z
        noise = k0 + k2 * z * z
        work[_VARIANCE + i] = noise * noise + slope2 * (z_u * z_u + z_v * z_v)
        nearest = min(min(before[i], after[i]), min(above[i], below[i]))
        smooth = (abs(z_u) + abs(z_v) < step * z) & (nearest > zero)
        work[_MASK_DEPTH + i] *= work[_MASK_COLOUR + i] if smooth else zero


@fast_kernel
def _weigh_depth(row, start, n, reference, model, work, sums):
    """Weighted depth columns of one span, the masks of its colours, and the soft counts."""
    f32 = np.float32
    zero, one = f32(0.0), f32(1.0)
    information, narrow, weight = model[1], model[6], model[8]
    gate2, agree2 = model[9], model[10]
    soft = reference[4, row, start:]
    column = _JACOBIAN + 3 * _SPAN
    cost = visible = measured = agreeing = zero
    for i in range(n):
        error = work[_ERROR_DEPTH + i]
        precision = information / work[_VARIANCE + i]
        squared = error * error * precision
        mask, seen = soft[i] * work[_MASK_DEPTH + i], soft[i] * work[_MASK_COLOUR + i]
        visible += seen
        measured += mask
        agreeing += mask if squared < agree2 else zero
        gated = (mask > zero) & (squared > gate2)
        work[_MASK_COLOUR + i] = zero if gated else seen
        trust = zero if gated else mask * weight
        tail = one / (one + squared * narrow)
        cost += f32(0.5) * trust * squared * tail
        root = np.sqrt(trust * precision) * tail
        n_x, n_y = root * work[_NORMAL + i], root * work[_NORMAL + _SPAN + i]
        n_z = root * work[_NORMAL + 2 * _SPAN + i]
        x_m, y_m = work[_MEASURED + i], work[_MEASURED + _SPAN + i]
        z_m = work[_MEASURED + 2 * _SPAN + i]
        work[column + i] = n_x
        work[column + 1 * _COLUMN + i] = n_y
        work[column + 2 * _COLUMN + i] = n_z
        work[column + 3 * _COLUMN + i] = y_m * n_z - z_m * n_y
        work[column + 4 * _COLUMN + i] = z_m * n_x - x_m * n_z
        work[column + 5 * _COLUMN + i] = x_m * n_y - y_m * n_x
        work[column + 6 * _COLUMN + i] = zero
        work[column + 7 * _COLUMN + i] = zero
        work[column + 8 * _COLUMN + i] = root * error
    sums[COST] += cost
    sums[COST + 1] += visible
    sums[COST + 2] += measured
    sums[COST + 3] += agreeing


@fast_kernel
def _differentiate(plane, row, start, n, reference, work):
    """Central differences of one plane of the reference."""
    half = np.float32(0.5)
    before, after = reference[plane, row, start - 1 :], reference[plane, row, start + 1 :]
    above, below = reference[plane, row - 1, start:], reference[plane, row + 1, start:]
    for i in range(n):
        work[_GRADIENT + i] = half * (after[i] - before[i])
        work[_GRADIENT + _SPAN + i] = half * (below[i] - above[i])


def _colour_weigher(channel: int):
    """The kernel for one channel: only with constant offsets does its loop use vectors."""
    error_at, sample_at = _ERROR_RED + channel * _SPAN, _RED + channel * _SPAN
    column = _JACOBIAN + channel * _SPAN

    @fast_kernel
    def weigh_colour(row, start, n, reference, intrinsics, model, work, sums):
        """Weighted columns of one colour channel of one span: (g_u, g_v) dpi/dX [I, -hat(X)]."""
        f32 = np.float32
        half, one = f32(0.5), f32(1.0)
        fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
        information, narrow, weight = model[0], model[5], model[7]
        ray_y, inverse_fx, first_x = (f32(row) - cy) / fy, one / fx, f32(start) - cx
        _differentiate(channel, row, start, n, reference, work)
        cost = f32(0.0)
        for i in range(n):
            error = work[error_at + i]
            squared = error * error * information
            tail = one / (one + squared * narrow)
            trust = work[_MASK_COLOUR + i] * weight
            cost += half * trust * squared * tail
            root = np.sqrt(trust * information) * tail
            inverse_z = work[_INVERSE_Z + i]
            ray_x = (f32(i) + first_x) * inverse_fx
            along_x = root * fx * work[_GRADIENT + i]
            along_y = root * fy * work[_GRADIENT + _SPAN + i]
            along_z = -(along_x * ray_x + along_y * ray_y)
            work[column + i] = along_x * inverse_z
            work[column + 1 * _COLUMN + i] = along_y * inverse_z
            work[column + 2 * _COLUMN + i] = along_z * inverse_z
            work[column + 3 * _COLUMN + i] = ray_y * along_z - along_y
            work[column + 4 * _COLUMN + i] = along_x - ray_x * along_z
            work[column + 5 * _COLUMN + i] = ray_x * along_y - ray_y * along_x
            work[column + 6 * _COLUMN + i] = -root * work[sample_at + i]
            work[column + 7 * _COLUMN + i] = -root
            work[column + 8 * _COLUMN + i] = root * error
        sums[COST] += cost

    return weigh_colour


_weigh_red, _weigh_green, _weigh_blue = (_colour_weigher(channel) for channel in range(3))


@fast_kernel
def _add_gram_block(i, j, work, sums):
    """Add rows i..i+2, columns j..j+2 of J^T J of one span to the 9 x 9 head of `sums`.

    Three by three at once: each loaded number takes part in three products.
    """
    a = _JACOBIAN + i * _COLUMN
    b = _JACOBIAN + j * _COLUMN
    s00 = s01 = s02 = s10 = s11 = s12 = s20 = s21 = s22 = np.float32(0.0)
    for k in range(_COLUMN):
        a0, a1, a2 = work[a + k], work[a + _COLUMN + k], work[a + 2 * _COLUMN + k]
        b0, b1, b2 = work[b + k], work[b + _COLUMN + k], work[b + 2 * _COLUMN + k]
        s00 += a0 * b0
        s01 += a0 * b1
        s02 += a0 * b2
        s10 += a1 * b0
        s11 += a1 * b1
        s12 += a1 * b2
        s20 += a2 * b0
        s21 += a2 * b1
        s22 += a2 * b2
    at = COLUMNS * i + j
    sums[at] += s00
    sums[at + 1] += s01
    sums[at + 2] += s02
    sums[at + COLUMNS] += s10
    sums[at + COLUMNS + 1] += s11
    sums[at + COLUMNS + 2] += s12
    sums[at + 2 * COLUMNS] += s20
    sums[at + 2 * COLUMNS + 1] += s21
    sums[at + 2 * COLUMNS + 2] += s22
