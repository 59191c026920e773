"""Stage 4, blend: colour, depth and alpha of every pixel, front to back.

For the Gaussians of a tile, nearest first, with alpha_i = min(exp(8 t_i), ALPHA_MAX), 0 if below
ALPHA_MIN, and the transmittance T_i = prod_{j<i} (1 - alpha_j) (the pixel is finished at
T < TRANSMITTANCE_MIN):

    colour = sum T_i alpha_i colour_i,   depth = sum T_i alpha_i z_i,   alpha = 1 - T_end.

Layout: a tile's list is taken in batches of 64. For each Gaussian one vector test (lanes are
blocks) gives the exact mask of the blocks that its ellipse meets; those that meet none leave the
list for good. Then lanes are pixels: for each block the 64 masks are one word, and the loop over
its bits keeps the block's state (T, colour, depth) in registers. The list and the masks stay for
the backward pass.

In a tile the exponent is a polynomial of the pixel's offset (x, y) from the tile's centre:
t = q0 + qx x + qy y + a x^2 + b x y + c y^2.
"""

from __future__ import annotations

import numpy as np

from magic_core.render import layout
from magic_core.render.jit import inlined, kernel
from magic_core.render.lanes import LANES
from magic_core.render.layout import (
    BLOCK_LEFT,
    BLOCK_TOP,
    BLOCKS,
    BLOCKS_PER_ROW,
    PIXEL_VECTORS,
    PIXELS,
    RECORD,
    TILE,
    TILE_CENTRE,
    f32,
)
from magic_core.render.simd import (
    bits,
    fma,
    fnma,
    maximum,
    minimum,
    select,
    splat,
    trailing_zeros,
    zero_unless,
)
from magic_core.render.simd_memory import (
    BLOCK_HEIGHT,
    BLOCK_WIDTH,
    claim,
    column_bits,
    load,
    prefetch,
    read,
    store,
    store_block,
    store_columns,
    write,
)
from magic_core.render.vecmath import exp_of_8

BATCH = 64
PREFETCH_AHEAD = 12

# Scratch of one thread: the state of each block, then the polynomials of a batch.
_STATE = 5 * LANES  # transmittance, red, green, blue, depth
_PAIRS = BLOCKS * _STATE
PAIR = 16  # q0, qx, qy, a, b, c, red, green, blue, depth
_SCRATCH = _PAIRS + BATCH * PAIR

_ZERO, _ONE, _TWO = f32(0.0), f32(1.0), f32(2.0)
_THRESHOLD, _SLACK = layout.LOG_THRESHOLD, layout.MASK_SLACK
_ALPHA_MAX, _T_MIN = layout.ALPHA_MAX, layout.TRANSMITTANCE_MIN
_BLOCK_X, _BLOCK_Y = f32(BLOCK_WIDTH - 1), f32(BLOCK_HEIGHT - 1)
_PARTS = BLOCKS // LANES


@inlined
def block_mask(records, o, centre_x, centre_y, pattern):
    """Bit b: the ellipse alpha >= ALPHA_MIN of record o meets block b's rectangle.

    The quadratic is concave, so its maximum over a rectangle is at the centre or on one of the two
    edges nearest to it, at the point where it is stationary along that edge.
    """
    a, b, c = (
        splat(read(records, o + layout.A)),
        splat(read(records, o + layout.B)),
        splat(read(records, o + layout.C)),
    )
    shear_x, shear_y = (
        splat(read(records, o + layout.SHEAR_X)),
        splat(read(records, o + layout.SHEAR_Y)),
    )
    limit = splat(_THRESHOLD - _SLACK - read(records, o + layout.K))
    du, dv = (
        splat(centre_x - read(records, o + layout.U)),
        splat(centre_y - read(records, o + layout.V)),
    )
    zero = splat(_ZERO)
    mask = np.uint32(0)
    for part in range(_PARTS):
        left = load(pattern, BLOCK_LEFT + part * LANES) + du
        top = load(pattern, BLOCK_TOP + part * LANES) + dv
        right, bottom = left + splat(_BLOCK_X), top + splat(_BLOCK_Y)
        near_x = maximum(left, minimum(zero, right))
        near_y = maximum(top, minimum(zero, bottom))
        along_y = maximum(top, minimum(shear_y * near_x, bottom))
        along_x = maximum(left, minimum(shear_x * near_y, right))
        first = fma(fma(a, near_x, b * along_y), near_x, c * along_y * along_y)
        second = fma(fma(a, along_x, b * near_y), along_x, c * near_y * near_y)
        meets = bits(maximum(first, second) >= limit)
        mask |= meets << np.uint32(part * LANES)
    return np.uint32(mask)


@inlined
def exponent(q0, qx, qy, a, b, c, x, y):
    """t at offsets (x, y) from the tile's centre; the same roundings forward and backward."""
    inner = fma(a, x, fma(b, y, qx))
    return fma(inner, x, fma(fma(c, y, qy), y, q0))


@inlined
def centred_polynomial(a, b, c, k, du, dv):
    """(q0, qx, qy) of the exponent about a tile's centre, (du, dv) from the Gaussian's."""
    x, y = a * du + b * dv, c * dv
    return x * du + (y * dv + k), x + a * du, y + (b * du + y)


@inlined
def write_pair(scratch, p, records, o, centre_x, centre_y):
    """The polynomial and the colours of record o for one tile, to scratch[p:p + 10]."""
    a, b = read(records, o + layout.A), read(records, o + layout.B)
    c, k = read(records, o + layout.C), read(records, o + layout.K)
    du, dv = centre_x - read(records, o + layout.U), centre_y - read(records, o + layout.V)
    q0, qx, qy = centred_polynomial(a, b, c, k, du, dv)
    write(scratch, p, q0)
    write(scratch, p + 1, qx)
    write(scratch, p + 2, qy)
    write(scratch, p + 3, a)
    write(scratch, p + 4, b)
    write(scratch, p + 5, c)
    write(scratch, p + 6, read(records, o + layout.RED))
    write(scratch, p + 7, read(records, o + layout.GREEN))
    write(scratch, p + 8, read(records, o + layout.BLUE))
    write(scratch, p + 9, read(records, o + layout.DEPTH))


@inlined
def inside_lanes(block, left, top, width, height):
    """How many columns and rows of a block lie in the image (0 and less: none)."""
    x = left + BLOCK_WIDTH * (block % BLOCKS_PER_ROW)
    y = top + BLOCK_HEIGHT * (block // BLOCKS_PER_ROW)
    return x, y, min(BLOCK_WIDTH, width - x), min(BLOCK_HEIGHT, height - y)


@inlined
def start_transmittance(scratch, at, columns, rows):
    """T = 1 for pixels of the image and 0 for lanes outside, which then never contribute."""
    store(scratch, at, splat(_ONE))
    if columns == BLOCK_WIDTH and rows == BLOCK_HEIGHT:
        return
    for lane in range(LANES):
        if lane % BLOCK_WIDTH >= columns or lane // BLOCK_WIDTH >= rows:
            scratch[at + lane] = _ZERO


@inlined
def _begin_tile(scratch, left, top, width, height):
    """Reset the state of all blocks; returns the mask of those inside the image."""
    alive = np.uint32(0)
    for block in range(BLOCKS):
        _, _, columns, rows = inside_lanes(block, left, top, width, height)
        s = block * _STATE
        start_transmittance(scratch, s, columns, rows)
        for k in range(1, 5):
            store(scratch, s + k * LANES, splat(_ZERO))
        if columns > 0 and rows > 0:
            alive |= np.uint32(1) << np.uint32(block)
    return np.uint32(alive)


@inlined
def _next_batch(at, end, kept, alive, records, lists, masks, centre_x, centre_y, pattern):
    """Keep up to BATCH Gaussians that meet a living block, moving them to lists[kept:].

    Returns (next to read, end of the kept ones). lists has PREFETCH_AHEAD elements of any content
    past its end.
    """
    full = kept + BATCH
    while at < end and kept < full:
        prefetch(records, RECORD * np.int64(read(lists, at + PREFETCH_AHEAD)))
        g = read(lists, at)
        mask = block_mask(records, RECORD * np.int64(g), centre_x, centre_y, pattern) & alive
        write(lists, kept, g)
        write(masks, kept, np.uint32(mask))
        kept += np.int64(mask != np.uint32(0))
        at += 1
    return at, kept


@inlined
def _blend_block(word, scratch, s, pattern, block):
    """Blend the Gaussians of a batch whose bits are set in `word` into one block.

    Returns the bits of those that reached at least one pixel, and whether any pixel goes on.
    """
    at = PIXELS + block * PIXEL_VECTORS
    x, y = load(pattern, at), load(pattern, at + LANES)
    transmittance = load(scratch, s)
    red, green = load(scratch, s + LANES), load(scratch, s + 2 * LANES)
    blue, depth = load(scratch, s + 3 * LANES), load(scratch, s + 4 * LANES)
    threshold, largest, t_min = splat(_THRESHOLD), splat(_ALPHA_MAX), splat(_T_MIN)
    reached = np.uint64(0)
    while word != np.uint64(0):
        i = trailing_zeros(word)
        word &= word - np.uint64(1)
        p = _PAIRS + PAIR * i
        t = exponent(
            splat(read(scratch, p)), splat(read(scratch, p + 1)), splat(read(scratch, p + 2)),
            splat(read(scratch, p + 3)), splat(read(scratch, p + 4)), splat(read(scratch, p + 5)),
            x, y,
        )  # fmt: skip
        drawn = t >= threshold
        alpha = zero_unless(drawn, minimum(exp_of_8(t), largest))
        # T waits only for one comparison and one product from the Gaussian before.
        open_ = transmittance >= t_min
        weight = zero_unless(open_, alpha * transmittance)
        passed = fnma(alpha, transmittance, transmittance)
        transmittance = select(open_, passed, transmittance)
        red = fma(weight, splat(read(scratch, p + 6)), red)
        green = fma(weight, splat(read(scratch, p + 7)), green)
        blue = fma(weight, splat(read(scratch, p + 8)), blue)
        depth = fma(weight, splat(read(scratch, p + 9)), depth)
        reached |= np.uint64(bits(drawn & open_) != np.uint32(0)) << np.uint64(i)
    store(scratch, s, transmittance)
    store(scratch, s + LANES, red)
    store(scratch, s + 2 * LANES, green)
    store(scratch, s + 3 * LANES, blue)
    store(scratch, s + 4 * LANES, depth)
    return reached, bits(transmittance >= t_min) != np.uint32(0)


@inlined
def _block_word(masks, first, count, block):
    """Bit i: Gaussian i of the batch meets the block. Bits past the batch are cleared."""
    word = np.uint64(0)
    for part in range(BATCH // LANES):
        column = column_bits(masks, first + part * LANES, np.uint32(block))
        word |= np.uint64(column) << np.uint64(part * LANES)
    if count < BATCH:
        word &= (np.uint64(1) << np.uint64(count)) - np.uint64(1)
    return word


@inlined
def _write_block(image, plane, scratch, s, block, left, top, width, height):
    """Copy a block's state to the image planes (alpha is 1 - T)."""
    x, y, columns, rows = inside_lanes(block, left, top, width, height)
    if columns <= 0 or rows <= 0:
        return
    store(scratch, s, splat(_ONE) - load(scratch, s))
    for k in range(5):
        source = s + LANES * ((k + 1) % 5)
        to = k * plane + y * width + x
        if columns == BLOCK_WIDTH and rows == BLOCK_HEIGHT:
            store_block(image, to, width, load(scratch, source))
        else:
            for row in range(rows):
                for column in range(columns):
                    image[to + row * width + column] = scratch[source + BLOCK_WIDTH * row + column]


@kernel
def blend(claimed, tiles, tiles_x, width, height, records, lists, starts, pattern,
          image, masks, kept_counts, visible):  # fmt: skip
    """Blend every tile.

    lists is reordered in place: the kept Gaussians of tile t move to its beginning,
    kept_counts[t] says how many, masks[i] has the bits of the blocks where Gaussian lists[i]
    reached a pixel. lists and masks have BATCH elements more than there are pairs.
    visible[g] is set to 1 for each Gaussian that reached a pixel.
    """
    scratch = layout_scratch(_SCRATCH)
    hit_words = np.zeros(BLOCKS, np.uint64)
    hit_masks = np.zeros(BATCH, np.uint32)
    while True:
        tile = claim(claimed, np.int64(1))
        if tile >= tiles:
            break
        left, top = TILE * (tile % tiles_x), TILE * (tile // tiles_x)
        centre_x, centre_y = f32(left) + TILE_CENTRE, f32(top) + TILE_CENTRE
        alive = _begin_tile(scratch, left, top, width, height)
        at, end, kept = np.int64(starts[tile]), np.int64(starts[tile + 1]), np.int64(starts[tile])
        while at < end and alive != np.uint32(0):
            first = kept
            at, kept = _next_batch(
                at, end, kept, alive, records, lists, masks, centre_x, centre_y, pattern
            )
            for i in range(kept - first):
                o = RECORD * np.int64(read(lists, first + i))
                write_pair(scratch, _PAIRS + PAIR * i, records, o, centre_x, centre_y)
            reached = np.uint64(0)
            for block in range(BLOCKS):
                hits = np.uint64(0)
                if alive >> np.uint32(block) & np.uint32(1) != np.uint32(0):
                    word = _block_word(masks, first, kept - first, block)
                    if word != np.uint64(0):
                        hits, goes_on = _blend_block(word, scratch, block * _STATE, pattern, block)
                        reached |= hits
                        if not goes_on:
                            alive &= ~(np.uint32(1) << np.uint32(block))
                write(hit_words, block, hits)
            for part in range(0, kept - first, LANES):
                store_columns(hit_masks, part, hit_words, part)
            # One by one: a whole vector would reach into the next tile's masks, which another
            # thread may have written already.
            for i in range(kept - first):
                write(masks, first + i, read(hit_masks, i))
            while reached != np.uint64(0):
                g = np.int64(read(lists, first + trailing_zeros(reached)))
                write(visible, g, np.uint8(1))
                reached &= reached - np.uint64(1)
        kept_counts[tile] = kept - starts[tile]
        for block in range(BLOCKS):
            _write_block(
                image, width * height, scratch, block * _STATE, block, left, top, width, height
            )


@inlined
def layout_scratch(count):
    """A float32 scratch array that begins on a cache line."""
    raw = np.empty(count + 16, np.float32)
    skip = ((64 - raw.ctypes.data % 64) % 64) // 4
    return raw[skip : skip + count]
