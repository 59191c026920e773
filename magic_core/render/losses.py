"""The mapping losses and their gradient by the rendered image, one row of pixels at a time.

With x the rendered and y the observed image, W a weight per pixel, N pixels, M of them with depth:

    colour = (1 - l) sum W |x - y| / 3N + l sum W (1 - SSIM(x, y)) / 3N,
    depth  = sum W |z - a d| / M over the pixels with depth d (z accumulated depth, a alpha).

Comparing z with d itself would trade opacity against distance: at alpha 0.99 surfaces 2 m away end
2 cm too far, which tracking then follows. z - a d is zero exactly where z / a, the expected depth,
is right.

SSIM (Wang et al. 2004) with a Gaussian window of 11 pixels, sigma 1.5, zero padding, as in 3DGS.
With E the windowed mean, mu = E x, and

    S = A1 A2 / (B1 B2),  A1 = 2 mu_x mu_y + c1,  A2 = 2 (E xy - mu_x mu_y) + c2,
    B1 = mu_x^2 + mu_y^2 + c1,  B2 = E xx - mu_x^2 + E yy - mu_y^2 + c2,

the gradient is dS/dx = E' [dS/dmu_x] + 2 x E' [dS/dE xx] + y E' [dS/dE xy], with E' = E as the
window is symmetric. So one pass writes three maps and the next one windows them: each first down
the columns (lanes are neighbouring columns), then along the row in a buffer with zero margins.

`image` and `target` have room for LANES values past their ends, which vectors may read.
"""

from __future__ import annotations

import numpy as np

from magic_core.render.jit import inlined, kernel
from magic_core.render.lanes import LANES
from magic_core.render.layout import f32
from magic_core.render.simd import absolute, fma, fnma, lane_sum, select, splat, zero_unless
from magic_core.render.simd_memory import claim, load, read, store

RADIUS = 5
_C1, _C2 = f32(0.01**2), f32(0.03**2)
_ZERO, _ONE, _TWO = f32(0.0), f32(1.0), f32(2.0)

# Sums of one row, float64: W |x - y|, W S, W |z - a d|.
ROW_SUMS = 3


def ssim_window() -> np.ndarray:
    """(11,) float32 Gaussian weights, sigma 1.5, that sum to 1."""
    offsets = np.arange(-RADIUS, RADIUS + 1)
    weights = np.exp(-0.5 * (offsets / 1.5) ** 2)
    return (weights / weights.sum()).astype(np.float32)


@inlined
def padded_width(width):
    """The image's width rounded up to whole vectors."""
    return (width + LANES - 1) // LANES * LANES


@kernel
def prepare_target(claimed, colour, width, height, depth, target, valid_counts):
    """Turn (h, w, 3) uint8 colour into three float planes 0 to 1; count valid depths per row."""
    plane = width * height
    scale = _ONE / f32(255.0)
    while True:
        row = claim(claimed, np.int64(1))
        if row >= height:
            break
        begin = row * width
        for k in range(3):
            for i in range(begin, begin + width):
                target[k * plane + i] = f32(colour[3 * i + k]) * scale
        valid = 0
        for i in range(begin, begin + width):
            valid += np.int64(depth[i] > _ZERO)
        valid_counts[row] = valid


@inlined
def _along_row(line, start, window):
    """The window along a row whose element `start + RADIUS` belongs to the first lane."""
    total = load(line, start) * splat(window[0])
    for k in range(1, 2 * RADIUS + 1):
        total = fma(load(line, start + k), splat(window[k]), total)
    return total


@inlined
def _fill_line(line, values, begin, width, given):
    """Copy a row of an image into `line`, or ones if it is not given; its margin stays zero."""
    for x in range(width):
        line[x] = values[begin + x] if given else _ONE


@inlined
def _clear_margins(lines, count, stride, width):
    """Zero what lies past the image's last column in `count` buffers of windowed columns."""
    for k in range(count):
        for x in range(RADIUS + width, stride):
            lines[k * stride + x] = _ZERO


@inlined
def _sign(difference):
    """-1, 0 or 1 per lane."""
    one, zero = splat(_ONE), splat(_ZERO)
    return select(difference > zero, one, zero) - select(difference < zero, one, zero)


@inlined
def _similarity(mu_x, mu_y, e_xx, e_yy, e_xy):
    """S and its derivatives by mu_x, E xx and E xy."""
    two = splat(_TWO)
    product, squares = mu_x * mu_y, fma(mu_x, mu_x, mu_y * mu_y)
    a1, b1 = fma(two, product, splat(_C1)), squares + splat(_C1)
    a2 = fma(two, e_xy - product, splat(_C2))
    b2 = (e_xx + e_yy) - squares + splat(_C2)
    inverse = splat(_ONE) / (b1 * b2)
    similarity = a1 * a2 * inverse
    by_xy = two * a1 * inverse
    by_xx = splat(_ZERO) - similarity * b1 * inverse
    by_mu = fnma(two * mu_x, similarity * b2 * inverse, two * mu_y * a2 * inverse)
    by_mu = fnma(mu_y, by_xy, fnma(two * mu_x, by_xx, by_mu))
    return similarity, by_mu, by_xx, by_xy


@kernel
def ssim_maps(claimed, image, target, width, height, weight, has_weight, window,
              share, maps, row_sums):  # fmt: skip
    """maps (3 channels x 3 maps, h, padded): share W (dS/dmu_x, dS/dE xx, dS/dE xy); sums of W S.

    share is the loss's derivative by one pixel's S; padded is `padded_width(width)`.
    """
    plane, padded = width * height, padded_width(width)
    stride = padded + 2 * RADIUS + LANES
    lines = np.zeros(5 * stride, np.float32)
    weights = np.zeros(padded, np.float32)
    while True:
        row = claim(claimed, np.int64(1))
        if row >= height:
            break
        first, last = max(row - RADIUS, 0), min(row + RADIUS, height - 1)
        _fill_line(weights, weight, row * width, width, has_weight)
        total = splat(_ZERO)
        for channel in range(3):
            for x in range(0, padded, LANES):
                m_x, m_y = splat(_ZERO), splat(_ZERO)
                m_xx, m_yy, m_xy = splat(_ZERO), splat(_ZERO), splat(_ZERO)
                for r in range(first, last + 1):
                    w = splat(read(window, r - row + RADIUS))
                    a = load(image, channel * plane + r * width + x)
                    b = load(target, channel * plane + r * width + x)
                    wa, wb = w * a, w * b
                    m_x, m_y = m_x + wa, m_y + wb
                    m_xx, m_yy, m_xy = fma(wa, a, m_xx), fma(wb, b, m_yy), fma(wa, b, m_xy)
                to = RADIUS + x
                store(lines, to, m_x)
                store(lines, stride + to, m_y)
                store(lines, 2 * stride + to, m_xx)
                store(lines, 3 * stride + to, m_yy)
                store(lines, 4 * stride + to, m_xy)
            _clear_margins(lines, 5, stride, width)
            for x in range(0, padded, LANES):
                similarity, by_mu, by_xx, by_xy = _similarity(
                    _along_row(lines, x, window), _along_row(lines, stride + x, window),
                    _along_row(lines, 2 * stride + x, window),
                    _along_row(lines, 3 * stride + x, window),
                    _along_row(lines, 4 * stride + x, window),
                )  # fmt: skip
                w = load(weights, x)  # 0 past the last column
                total = fma(w, similarity, total)
                w = w * splat(share)
                to = (3 * channel * height + row) * padded + x
                store(maps, to, w * by_mu)
                store(maps, to + height * padded, w * by_xx)
                store(maps, to + 2 * height * padded, w * by_xy)
        row_sums[row, 1] = np.float64(lane_sum(total))


@kernel
def image_gradient(claimed, image, target, width, height, depth, weight, has_weight, window,
                   maps, l1_share, depth_share, gradient, row_sums):  # fmt: skip
    """gradient (5, h, w) of the weighted losses by the image; sums of the L1 terms per row.

    l1_share and depth_share are the loss's derivatives by one pixel's |x - y| and |z - a d|.
    """
    plane, padded = width * height, padded_width(width)
    stride = padded + 2 * RADIUS + LANES
    lines = np.zeros(3 * stride, np.float32)
    out, weights = np.zeros(padded, np.float32), np.zeros(padded, np.float32)
    depths, by_alpha = np.zeros(padded, np.float32), np.zeros(padded, np.float32)
    while True:
        row = claim(claimed, np.int64(1))
        if row >= height:
            break
        first, last = max(row - RADIUS, 0), min(row + RADIUS, height - 1)
        begin = row * width
        _fill_line(weights, weight, begin, width, has_weight)
        _fill_line(depths, depth, begin, width, True)
        total = splat(_ZERO)
        for channel in range(3):
            for k in range(3):
                top = (3 * channel + k) * height * padded
                for x in range(0, padded, LANES):
                    windowed = splat(_ZERO)
                    for r in range(first, last + 1):
                        w = splat(read(window, r - row + RADIUS))
                        windowed = fma(load(maps, top + r * padded + x), w, windowed)
                    store(lines, k * stride + RADIUS + x, windowed)
            base = channel * plane + begin
            for x in range(0, padded, LANES):
                by_mu = _along_row(lines, x, window)
                by_xx = _along_row(lines, stride + x, window)
                by_xy = _along_row(lines, 2 * stride + x, window)
                a, b, w = load(image, base + x), load(target, base + x), load(weights, x)
                slope = fma(b, by_xy, fma(splat(_TWO) * a, by_xx, by_mu))
                total = fma(w, absolute(a - b), total)
                store(out, x, fma(w * splat(l1_share), _sign(a - b), slope))
            for x in range(width):
                gradient[base + x] = out[x]
        row_sums[row, 0] = np.float64(lane_sum(total))
        total = splat(_ZERO)
        for x in range(0, padded, LANES):
            d = load(depths, x)
            w = zero_unless(d > splat(_ZERO), load(weights, x))
            z, alpha = load(image, 3 * plane + begin + x), load(image, 4 * plane + begin + x)
            difference = fnma(alpha, d, z)
            total = fma(w, absolute(difference), total)
            by_depth = w * splat(depth_share) * _sign(difference)
            store(out, x, by_depth)
            store(by_alpha, x, splat(_ZERO) - by_depth * d)
        for x in range(width):
            gradient[3 * plane + begin + x] = out[x]
            gradient[4 * plane + begin + x] = by_alpha[x]
        row_sums[row, 2] = np.float64(lane_sum(total))
