"""Stage 5, blend backward: from the image's gradient to each (tile, Gaussian) pair's.

For one pixel let G be the gradient of the loss by (colour, depth, alpha), w_i = T_i alpha_i, and
q_i = G . (colour_i, z_i, 1). Walking front to back with the remainder R_i = sum_{j>i} w_j q_j
(it starts as G . image, so nothing has to be stored per Gaussian):

    dL/dcolour_i = w_i G_colour,   dL/dz_i = w_i G_depth,
    dL/dalpha_i = T_i q_i - R_i / (1 - alpha_i).

With s_i = alpha_i dL/dalpha_i (0 where alpha was clamped) the exponent 8 t of the record needs only
six moments over the pixels, sum s (1, x, y, x^2, x y, y^2), with (x, y) from the Gaussian's centre.
They are taken from the tile's centre, where x and y are constants, and shifted once per pair.

Lanes are pixels. The Gaussian loop is outside and keeps ten sums in registers; the pixels' state
of a tile stays in the first-level cache. Each pair has its own slot, so that no two threads meet.
"""

from __future__ import annotations

import numpy as np

from magic_core.render import layout
from magic_core.render.blend import (
    PREFETCH_AHEAD,
    exponent,
    inside_lanes,
    layout_scratch,
    start_transmittance,
)
from magic_core.render.jit import inlined, kernel
from magic_core.render.lanes import LANES
from magic_core.render.layout import (
    BLOCKS,
    CHUNK,
    PIXEL_VECTORS,
    PIXELS,
    RECORD,
    TILE,
    TILE_CENTRE,
    f32,
)
from magic_core.render.simd import (
    BLOCK_HEIGHT,
    BLOCK_WIDTH,
    claim,
    fma,
    fnma,
    load,
    load_block,
    minimum,
    prefetch,
    reciprocal,
    splat,
    store,
    store_sums10,
    trailing_zeros,
    zero_unless,
)
from magic_core.render.vecmath import exp_of_8

# Pair gradient, 16 float32: sum of s, then its moments x, y, x^2, x y, y^2 about the Gaussian's
# centre, then red, green, blue, depth.
PAIR_GRADIENT = 16

# State of a block: T, remainder, gradients by red, green, blue, depth, alpha.
_STATE = 7 * LANES
_PARTIAL = BLOCKS * _STATE  # two vectors to gather a block at the border of the image
_SCRATCH = _PARTIAL + 2 * 16

_ZERO, _ONE, _TWO = f32(0.0), f32(1.0), f32(2.0)
_THRESHOLD, _ALPHA_MAX, _T_MIN = (
    layout.LOG_THRESHOLD, layout.ALPHA_MAX, layout.TRANSMITTANCE_MIN
)  # fmt: skip


@inlined
def _load_pixels(scratch, at, plane, index, width, columns, rows):
    """A block of an image plane; lanes outside the image are 0."""
    if columns == BLOCK_WIDTH and rows == BLOCK_HEIGHT:
        return load_block(plane, index, width)
    store(scratch, at, splat(_ZERO))
    for row in range(rows):
        for column in range(columns):
            scratch[at + BLOCK_WIDTH * row + column] = plane[index + row * width + column]
    return load(scratch, at)


@inlined
def _begin_tile(scratch, left, top, width, height, image, gradient):
    """Load each block's gradients and its remainder G . image; T starts at 1."""
    for block in range(BLOCKS):
        x, y, columns, rows = inside_lanes(block, left, top, width, height)
        if columns <= 0 or rows <= 0:
            continue
        s = block * _STATE
        start_transmittance(scratch, s, columns, rows)
        remainder = splat(_ZERO)
        for k in range(5):
            index = (k * height + y) * width + x
            g = _load_pixels(scratch, _PARTIAL, gradient, index, width, columns, rows)
            value = _load_pixels(scratch, _PARTIAL + 16, image, index, width, columns, rows)
            remainder = fma(g, value, remainder)
            store(scratch, s + (2 + k) * LANES, g)
        store(scratch, s + LANES, remainder)


@inlined
def _pair_sums(mask, scratch, records, o, centre_x, centre_y, pattern, out, to):
    """Walk the blocks of one pair and write its ten sums (moments about the tile's centre)."""
    a, b, c = records[o + layout.A], records[o + layout.B], records[o + layout.C]
    du, dv = centre_x - records[o + layout.U], centre_y - records[o + layout.V]
    q0 = splat((a * du + b * dv) * du + (c * dv * dv + records[o + layout.K]))
    qx, qy = splat(_TWO * a * du + b * dv), splat(_TWO * c * dv + b * du)
    qa, qb, qc = splat(a), splat(b), splat(c)
    red, green = splat(records[o + layout.RED]), splat(records[o + layout.GREEN])
    blue, depth = splat(records[o + layout.BLUE]), splat(records[o + layout.DEPTH])
    one, zero = splat(_ONE), splat(_ZERO)
    threshold, largest, t_min = splat(_THRESHOLD), splat(_ALPHA_MAX), splat(_T_MIN)
    m0, mx, my, mxx, mxy, myy = zero, zero, zero, zero, zero, zero
    sum_red, sum_green, sum_blue, sum_depth = zero, zero, zero, zero
    while mask != np.uint64(0):
        block = trailing_zeros(mask)
        mask &= mask - np.uint64(1)
        s, at = block * _STATE, PIXELS + block * PIXEL_VECTORS
        t = exponent(q0, qx, qy, qa, qb, qc, load(pattern, at), load(pattern, at + LANES))
        transmittance = load(scratch, s)
        counts = (t >= threshold) & (transmittance >= t_min)
        unclamped = exp_of_8(t)
        alpha = zero_unless(counts, minimum(unclamped, largest))
        weight = alpha * transmittance
        g_red, g_green = load(scratch, s + 2 * LANES), load(scratch, s + 3 * LANES)
        g_blue, g_depth = load(scratch, s + 4 * LANES), load(scratch, s + 5 * LANES)
        value = fma(blue, g_blue, fma(depth, g_depth, load(scratch, s + 6 * LANES)))
        value = fma(red, g_red, fma(green, g_green, value))
        share = weight * value
        remainder = load(scratch, s + LANES) - share
        store(scratch, s, transmittance - weight)
        store(scratch, s + LANES, remainder)
        change = fnma(remainder, alpha * reciprocal(one - alpha), share)
        change = zero_unless(unclamped < largest, change)
        m0 = m0 + change
        mx = fma(change, load(pattern, at), mx)
        my = fma(change, load(pattern, at + LANES), my)
        mxx = fma(change, load(pattern, at + 2 * LANES), mxx)
        mxy = fma(change, load(pattern, at + 3 * LANES), mxy)
        myy = fma(change, load(pattern, at + 4 * LANES), myy)
        sum_red = fma(weight, g_red, sum_red)
        sum_green = fma(weight, g_green, sum_green)
        sum_blue = fma(weight, g_blue, sum_blue)
        sum_depth = fma(weight, g_depth, sum_depth)
    store_sums10(out, to, m0, mx, my, mxx, mxy, myy, sum_red, sum_green, sum_blue, sum_depth)


@inlined
def _shift_moments(out, to, du, dv):
    """Move the moments from the tile's centre to the Gaussian's: x <- x + du, y <- y + dv."""
    m0, mx, my = out[to], out[to + 1], out[to + 2]
    out[to + 3] += du * (_TWO * mx + du * m0)
    out[to + 4] += du * my + dv * (mx + du * m0)
    out[to + 5] += dv * (_TWO * my + dv * m0)
    out[to + 1] = mx + du * m0
    out[to + 2] = my + dv * m0


@kernel
def blend_backward(claimed, tiles, tiles_x, width, height, records, record_ints, lists, starts,
                   kept_counts, masks, slot_starts, pattern, image, gradient,
                   pair_gradients, pair_written):  # fmt: skip
    """Fill the slots of all pairs that `blend` kept.

    gradient is (5, h, w) flat like the image. The slot of (Gaussian, tile) is the Gaussian's first
    slot plus the tile's number within the Gaussian's rectangle of tiles; pair_written is set there.
    """
    scratch = layout_scratch(_SCRATCH)
    while True:
        tile = claim(claimed, np.int64(1))
        if tile >= tiles:
            break
        begin = np.int64(starts[tile])
        end = begin + kept_counts[tile]
        if begin == end:
            continue
        column, row = tile % tiles_x, tile // tiles_x
        left, top = TILE * column, TILE * row
        centre_x, centre_y = f32(left) + TILE_CENTRE, f32(top) + TILE_CENTRE
        _begin_tile(scratch, left, top, width, height, image, gradient)
        for i in range(begin, end):
            prefetch(records, RECORD * np.int64(lists[min(i + PREFETCH_AHEAD, end - 1)]))
            g = np.int64(lists[i])
            o = RECORD * g
            packed, first_row = record_ints[o + layout.COLUMNS], record_ints[o + layout.ROWS]
            first_column = packed & 0xFFFF
            across = (packed >> 16) - first_column + 1
            slot = slot_starts[g // CHUNK] + record_ints[o + layout.SLOT]
            slot += (row - (first_row & 0xFFFF)) * across + (column - first_column)
            to = PAIR_GRADIENT * np.int64(slot)
            _pair_sums(
                np.uint64(masks[i]), scratch, records, o, centre_x, centre_y, pattern,
                pair_gradients, to,
            )  # fmt: skip
            _shift_moments(
                pair_gradients, to,
                centre_x - records[o + layout.U], centre_y - records[o + layout.V],
            )  # fmt: skip
            pair_written[slot] = 1
