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
    centred_polynomial,
    exponent,
    inside_lanes,
    layout_scratch,
    start_transmittance,
)
from magic_core.render.jit import inlined, kernel
from magic_core.render.lanes import LANES
from magic_core.render.layout import (
    BLOCKS,
    CHUNK_SHIFT,
    PIXEL_VECTORS,
    PIXELS,
    RECORD,
    TILE,
    TILE_CENTRE,
    f32,
)
from magic_core.render.simd import (
    fma,
    fnma,
    minimum,
    reciprocal,
    splat,
    trailing_zeros,
    zero_unless,
)
from magic_core.render.simd_memory import (
    BLOCK_HEIGHT,
    BLOCK_WIDTH,
    claim,
    load,
    load_block,
    prefetch,
    read,
    store,
    store_sums10,
    write,
)
from magic_core.render.vecmath import exp_of_8

# Pair gradient, 16 float32: sum of s, then its moments x, y, x^2, x y, y^2 about the Gaussian's
# centre, then red, green, blue, depth.
PAIR_GRADIENT = 16

# State of a block, in vectors: T, remainder, gradients by red, green, blue, depth, alpha, then the
# constants x, y, x^2, x y, y^2 of its pixels, so that one address serves all.
_GRADIENTS, _PIXELS, _VECTORS = 2, 7, 16
_STATE = _VECTORS * LANES
_PARTIAL = BLOCKS * _STATE  # two vectors to gather a block at the border of the image
_SCRATCH = _PARTIAL + 2 * 16

_ZERO, _ONE = f32(0.0), f32(1.0)
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
            store(scratch, s + (_GRADIENTS + k) * LANES, g)
        store(scratch, s + LANES, remainder)


@inlined
def _copy_pixel_constants(scratch, pattern):
    """Lay the constants of each block's pixels beside its state."""
    for block in range(BLOCKS):
        for k in range(5):
            vector = load(pattern, PIXELS + block * PIXEL_VECTORS + k * LANES)
            store(scratch, block * _STATE + (_PIXELS + k) * LANES, vector)


@inlined
def _pair_sums(mask, scratch, records, o, centre_x, centre_y, out, to):
    """Walk the blocks of one pair and write its ten sums to out[to:to + 10]."""
    a, b = read(records, o + layout.A), read(records, o + layout.B)
    c, k = read(records, o + layout.C), read(records, o + layout.K)
    du, dv = centre_x - read(records, o + layout.U), centre_y - read(records, o + layout.V)
    q0, qx, qy = centred_polynomial(a, b, c, k, du, dv)
    q0, qx, qy, qa, qb, qc = splat(q0), splat(qx), splat(qy), splat(a), splat(b), splat(c)
    red, green = splat(read(records, o + layout.RED)), splat(read(records, o + layout.GREEN))
    blue, depth = splat(read(records, o + layout.BLUE)), splat(read(records, o + layout.DEPTH))
    one, zero = splat(_ONE), splat(_ZERO)
    threshold, largest, t_min = splat(_THRESHOLD), splat(_ALPHA_MAX), splat(_T_MIN)
    m0, mx, my, mxx, mxy, myy = zero, zero, zero, zero, zero, zero
    sum_red, sum_green, sum_blue, sum_depth = zero, zero, zero, zero
    while mask != np.uint64(0):
        s = trailing_zeros(mask) * _STATE
        mask &= mask - np.uint64(1)
        x, y = load(scratch, s + _PIXELS * LANES), load(scratch, s + (_PIXELS + 1) * LANES)
        t = exponent(q0, qx, qy, qa, qb, qc, x, y)
        transmittance = load(scratch, s)
        unclamped = exp_of_8(t)
        counts = (t >= threshold) & (transmittance >= t_min)
        alpha = zero_unless(counts, minimum(unclamped, largest))
        weight = alpha * transmittance
        g_red, g_green = load(scratch, s + 2 * LANES), load(scratch, s + 3 * LANES)
        g_blue, g_depth = load(scratch, s + 4 * LANES), load(scratch, s + 5 * LANES)
        value = fma(blue, g_blue, fma(depth, g_depth, load(scratch, s + 6 * LANES)))
        value = fma(red, g_red, fma(green, g_green, value))
        share = weight * value
        remainder = load(scratch, s + LANES) - share
        store(scratch, s, fnma(alpha, transmittance, transmittance))
        store(scratch, s + LANES, remainder)
        change = fnma(remainder, alpha * reciprocal(one - alpha), share)
        change = zero_unless(unclamped < largest, change)
        m0 = m0 + change
        mx = fma(change, x, mx)
        my = fma(change, y, my)
        mxx = fma(change, load(scratch, s + (_PIXELS + 2) * LANES), mxx)
        mxy = fma(change, load(scratch, s + (_PIXELS + 3) * LANES), mxy)
        myy = fma(change, load(scratch, s + (_PIXELS + 4) * LANES), myy)
        sum_red = fma(weight, g_red, sum_red)
        sum_green = fma(weight, g_green, sum_green)
        sum_blue = fma(weight, g_blue, sum_blue)
        sum_depth = fma(weight, g_depth, sum_depth)
    # Move the moments from the tile's centre to the Gaussian's: x <- x + du, y <- y + dv.
    du, dv = splat(du), splat(dv)
    moved_x, moved_y = fma(du, m0, mx), fma(dv, m0, my)
    mxx = fma(du, mx + moved_x, mxx)
    mxy = fma(du, my, fma(dv, moved_x, mxy))
    myy = fma(dv, my + moved_y, myy)
    store_sums10(
        out, to, m0, moved_x, moved_y, mxx, mxy, myy, sum_red, sum_green, sum_blue, sum_depth
    )


@kernel
def blend_backward(claimed, tiles, tiles_x, width, height, records, record_ints, lists, starts,
                   kept_counts, masks, slot_starts, pattern, image, gradient,
                   pair_gradients, pair_written):  # fmt: skip
    """Fill the slots of all pairs that `blend` kept.

    gradient is (5, h, w) flat like the image. pair_written is set for each slot that is filled.
    """
    scratch = layout_scratch(_SCRATCH)
    _copy_pixel_constants(scratch, pattern)
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
            prefetch(records, RECORD * np.int64(read(lists, i + PREFETCH_AHEAD)))
            mask = np.uint64(read(masks, i))
            if mask == np.uint64(0):
                continue
            g = np.int64(read(lists, i))
            o = RECORD * g
            slot = read(slot_starts, g >> CHUNK_SHIFT) + np.int64(
                read(record_ints, o + layout.SLOT_BASE)
            )
            slot += row * np.int64(read(record_ints, o + layout.ACROSS)) + column
            _pair_sums(
                mask, scratch, records, o, centre_x, centre_y,
                pair_gradients, PAIR_GRADIENT * slot,
            )  # fmt: skip
            write(pair_written, slot, np.uint8(1))
