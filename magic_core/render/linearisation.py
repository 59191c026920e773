"""Normal equations of one RGB-D image against a reference view: the heart of the tracker.

A *reference view* is what a map (or a keyframe) shows from a known pose: colour R, depth Z and a
soft mask M, one value per pixel p. A new image with colour I and depth D is compared with it
through `camera_from_reference` T. The point X = Z(p) K^-1 p of the reference is seen by the new
camera at q = pi(T X). Two kinds of residual follow, both expressed in the reference frame:

    colour   e_c = R_c(p) - (gain I_c(q) + bias)                     for the three channels c
    depth    e_z = n . (T^-1 (D(q) K^-1 q) - X)                      point to plane, along z

with the plane normal n = (-fx Zu / Z, -fy Zv / Z, 1 + (fx X Zu + fy Y Zv) / Z^2), Zu and Zv being
the central differences of the reference depth. n is scaled so that n . X / Z = 1: an error of the
measured depth appears in e_z unchanged, and so does its variance.

The pose is perturbed on the reference's side, T^-1 <- exp(xi) T^-1 ("inverse compositional"), so
that image gradients are those of the *reference* alone; a rendered image has no sensor noise:

    d e_c / d xi = (Ru, Rv) dpi/dX [I, -hat(X)]      d e_z / d xi = n . [I, -hat(X_measured)]
    d e_c / d gain = -I_c(q)                         d e_c / d bias = -1

Every residual is divided by its standard deviation and robustly weighted (Geman-McClure with
c = `width`): rho(s) = s^2 / 2 / (1 + s^2 / c^2), weight 1 / (1 + s^2 / c^2)^2, and multiplied by
the reference's soft mask M(p), in the paper alpha^3. Pixels whose depth residual exceeds `gate`
standard deviations are left out whole, the paper's inlier mask. The depth's standard deviation
grows with z^2 (structured light, stereo) and with the slope of the surface:

    sigma_z(p)^2 = depth_sigma^2 ((k0 + k2 Z^2)^2 + (k_slope |grad Z|)^2)
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numba import njit
from numpy.typing import NDArray

from magic_core.geometry import Camera, se3
from magic_core.render import threads as thread_pool
from magic_core.render.simd import claim

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

_KERNEL = {"fastmath": True, "nogil": True, "cache": True, "error_model": "numpy"}

_UNKNOWNS = 8  # translation (3), rotation (3), gain, bias
_COLUMNS = _UNKNOWNS + 1  # the residual itself is the last column of the Jacobian
# Sums behind the 9 x 9 Gram matrix: cost, then soft counts of the pixels that are visible in both
# views, of those with two depths, and of those whose depths agree.
_COST, _SUMS = _COLUMNS * _COLUMNS, 4
_UPPER = np.triu(np.ones((_COLUMNS, _COLUMNS), bool))

_BLOCK_ROWS = 16
_WORTH_SHARING = 10_000  # pixels; smaller images are done before a second thread wakes up

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
_WORK = _JACOBIAN + _COLUMNS * _COLUMN


@dataclass(frozen=True, slots=True)
class ResidualModel:
    """What is assumed of the residuals; the two sigmas are estimated from the data."""

    colour_sigma: float = 0.03
    """Standard deviation of a colour residual, in units of full scale."""
    depth_sigma: float = 1.0
    """Factor on the depth noise model below, dimensionless."""
    k0_m: float = 0.0015
    """Depth noise at zero range, metres."""
    k2_per_m: float = 0.002
    """Growth of depth noise with z^2, 1 / m."""
    k_slope: float = 0.1
    """Sideways error of a depth pixel, in pixels; counts in proportion to the depth's gradient."""
    colour_width: float = 4.0
    """Geman-McClure width of colour residuals, in standard deviations."""
    depth_width: float = 4.0
    """Geman-McClure width of depth residuals, in standard deviations."""
    colour_weight: float = 1.0
    """Factor on colour information."""
    depth_weight: float = 1.0
    """Factor on depth information."""
    gate: float = 50.0
    """Depth residuals beyond this many standard deviations leave their pixel out."""
    agree: float = 3.5
    """Depth residuals within this many deviations count as agreeing; the noise model's own ones,
    not scaled by `depth_sigma`, or else any two surfaces would agree."""
    depth_step: float = 0.05
    """Neighbouring depths that differ by more than this share of the depth are an edge: unused."""

    def with_gate(self, gate: float) -> ResidualModel:
        """The same model with another inlier gate, in standard deviations."""
        return replace(self, gate=gate)


@dataclass(frozen=True, slots=True)
class NormalEquations:
    """Sums over all pixels; unknowns are (translation, rotation, gain, bias)."""

    hessian: Float64  # (8, 8)
    gradient: Float64  # (8,) J^T W e
    cost: float
    """Sum of the robust costs."""
    visible: float
    """Soft count (sum of the mask) of reference pixels that fall into the new image."""
    measured: float
    """Soft count of those where both views have a depth."""
    agreeing: float
    """Soft count of those whose depths agree, by `ResidualModel.agree`."""

    @property
    def mean_cost(self) -> float:
        """Robust cost per visible pixel, comparable between poses."""
        return self.cost / max(self.visible, 1e-9)


def linearise(
    reference: Float32,
    image: Float32,
    *,
    camera: Camera,
    camera_from_reference: Float64,
    model: ResidualModel,
    gain: float = 1.0,
    bias: float = 0.0,
    threads: int | None = None,
) -> NormalEquations:
    """Sum the normal equations of an RGB-D image against a reference view of the same camera.

    Args:
        reference: (5, h, w) planes R, G, B in [0, 1], depth in metres (not accumulated; 0 = none)
            and the soft mask in [0, 1].
        image: (h, w, 4) R, G, B in [0, 1] and depth in metres (0 = no reading), interleaved.
        camera: intrinsics of both.
        camera_from_reference: (4, 4) pose at which to linearise.
        model: noise, robust widths and masks.
        gain, bias: the photometric correction applied to the image.
        threads: how many cores to use (default: `threads.default_threads()`); sums are the same
            whatever their number, because each block of rows is summed on its own.
    """
    height, width = reference.shape[1:]
    blocks = np.zeros((-(-(height - 2) // _BLOCK_ROWS), _COST + _SUMS))
    packed = _packed(camera, camera_from_reference, gain, bias)
    if height * width < _WORTH_SHARING:
        threads = 1
    elif threads is None:
        threads = thread_pool.default_threads()
    arguments = (reference, image, *packed, _packed_model(model), blocks)
    thread_pool.run(_sum_blocks, arguments, threads=threads)
    sums = blocks.sum(axis=0)
    upper = sums[:_COST].reshape(_COLUMNS, _COLUMNS)
    gram = np.where(_UPPER, upper, upper.T)
    return NormalEquations(
        gram[:_UNKNOWNS, :_UNKNOWNS], gram[:_UNKNOWNS, _UNKNOWNS], *sums[_COST:].tolist()
    )


def estimate_scales(
    reference: Float32,
    image: Float32,
    *,
    camera: Camera,
    camera_from_reference: Float64,
    model: ResidualModel,
    gain: float = 1.0,
    bias: float = 0.0,
    samples: int = 2000,
) -> ResidualModel:
    """Replace the model's sigmas by 1.4826 x the median absolute residual at this pose.

    About `samples` pixels of evenly spaced rows are looked at. Scales are kept within bounds so
    that a few perfect or a few absurd pixels cannot make all others worthless.
    """
    height, width = reference.shape[1:]
    step = max(1, round((height - 2) * width / samples))
    packed = _packed(camera, camera_from_reference, gain, bias)
    errors = _sample_rows(1 + step // 2, step, reference, image, *packed, _packed_model(model))
    colour, depth = errors[0][errors[0] >= 0.0], errors[1][errors[1] >= 0.0]
    return replace(
        model,
        colour_sigma=_sigma(colour, 0.004, 0.5, otherwise=model.colour_sigma),
        depth_sigma=_sigma(depth, 0.2, 50.0, otherwise=model.depth_sigma),
    )


def _sigma(absolute: Float32, low: float, high: float, *, otherwise: float) -> float:
    if len(absolute) < 32:
        return otherwise
    middle = len(absolute) // 2
    median = float(np.partition(absolute, middle)[middle])
    return min(max(1.4826 * median, low), high)


def _packed(
    camera: Camera, camera_from_reference: Float64, gain: float, bias: float
) -> tuple[Float32, Float32, Float32, Float32]:
    """(intrinsics, camera_from_reference rows, its inverse's rows, photometric) as float32."""
    inverse = se3.inverse(camera_from_reference)
    return (
        _packed_camera(camera),
        np.ascontiguousarray(camera_from_reference[:3], np.float32).reshape(12),
        np.ascontiguousarray(inverse[:3], np.float32).reshape(12),
        np.array([gain, bias], np.float32),
    )


@lru_cache(maxsize=64)
def _packed_camera(camera: Camera) -> Float32:
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32)


@lru_cache(maxsize=64)
def _packed_model(model: ResidualModel) -> Float32:
    return np.array(
        [
            1.0 / model.colour_sigma**2, 1.0 / model.depth_sigma**2,
            model.k0_m, model.k2_per_m, model.k_slope**2,
            1.0 / model.colour_width**2, 1.0 / model.depth_width**2,
            model.colour_weight, model.depth_weight,
            model.gate**2, (model.agree / model.depth_sigma) ** 2, model.depth_step,
        ],
        np.float32,
    )  # fmt: skip


@njit(**_KERNEL)
def _sum_blocks(claimed, reference, image, intrinsics, pose, inverse, photometric, model, blocks):
    """Claim blocks of rows and sum each: the Gram matrix (9 x 9, upper triangle), then `_SUMS`."""
    last_row = reference.shape[1] - 1
    while True:
        block = claim(claimed, np.int64(1))
        if block >= len(blocks):
            return
        first = 1 + block * _BLOCK_ROWS
        _sum_rows(
            first, min(first + _BLOCK_ROWS, last_row),
            reference, image, intrinsics, pose, inverse, photometric, model, blocks[block],
        )  # fmt: skip


@njit(**_KERNEL)
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


@njit(**_KERNEL)
def _sample_rows(first, step, reference, image, intrinsics, pose, inverse, photometric, model):
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


@njit(**_KERNEL)
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


@njit(**_KERNEL)
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


@njit(**_KERNEL)
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


@njit(**_KERNEL)
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
    sums[_COST] += cost
    sums[_COST + 1] += visible
    sums[_COST + 2] += measured
    sums[_COST + 3] += agreeing


@njit(**_KERNEL)
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

    @njit(**_KERNEL)
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
        sums[_COST] += cost

    return weigh_colour


_weigh_red, _weigh_green, _weigh_blue = (_colour_weigher(channel) for channel in range(3))


@njit(**_KERNEL)
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
    at = _COLUMNS * i + j
    sums[at] += s00
    sums[at + 1] += s01
    sums[at + 2] += s02
    sums[at + _COLUMNS] += s10
    sums[at + _COLUMNS + 1] += s11
    sums[at + _COLUMNS + 2] += s12
    sums[at + 2 * _COLUMNS] += s20
    sums[at + 2 * _COLUMNS + 1] += s21
    sums[at + 2 * _COLUMNS + 2] += s22
