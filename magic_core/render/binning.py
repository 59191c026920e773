"""Stage 3, bin: a list of Gaussians per tile, nearest first.

The number per tile is known from `project` (2D prefix sum of the corners), so one ordered scatter
is enough. Threads share it by rows of tiles: each walks all Gaussians in order of depth and
writes only into its own rows, hence the lists never depend on the number of threads.
"""

from __future__ import annotations

import numpy as np

from magic_core.render.jit import kernel
from magic_core.render.simd_memory import claim


@kernel
def tile_starts(corners, tiles_x, tiles_y, starts):
    """starts[t]: where tile t's list begins, (tiles + 1,); returns the number of pairs.

    corners is summed in place; it has one more row and column than there are tiles.
    """
    stride = tiles_x + 1
    total = 0
    for y in range(tiles_y):
        along_row = 0
        for x in range(tiles_x):
            along_row += corners[y * stride + x]
            above = corners[(y - 1) * stride + x] if y > 0 else 0
            corners[y * stride + x] = along_row + above
            starts[y * tiles_x + x] = total
            total += along_row + above
    starts[tiles_x * tiles_y] = total
    return total


@kernel
def chunk_slots(chunks, chunk_count, slot_starts):
    """slot_starts[chunk]: where the gradient slots of a chunk's Gaussians begin."""
    total = 0
    for chunk in range(chunk_count):
        slot_starts[chunk] = total
        total += chunks[3 * chunk + 1]
    return total


@kernel
def bin_gaussians(claimed, bands, order, count, columns, rows, tiles_x, tiles_y, starts, lists):
    """Write the id of each Gaussian into the list of every tile that it touches."""
    pairs = starts[tiles_x * tiles_y]
    cursor = np.empty(tiles_x * tiles_y, np.int32)
    while True:
        band = claim(claimed, np.int64(1))
        if band >= bands:
            break
        top = _row_at(pairs * band // bands, tiles_x, tiles_y, starts) if band > 0 else 0
        bottom = tiles_y
        if band < bands - 1:
            bottom = _row_at(pairs * (band + 1) // bands, tiles_x, tiles_y, starts)
        for tile in range(top * tiles_x, bottom * tiles_x):
            cursor[tile] = starts[tile]
        for i in range(count):
            g = order[i]
            y0, y1 = max(rows[g] & 0xFFFF, top), min(rows[g] >> 16, bottom - 1)
            x0, x1 = columns[g] & 0xFFFF, columns[g] >> 16
            for y in range(y0, y1 + 1):
                for tile in range(y * tiles_x + x0, y * tiles_x + x1 + 1):
                    to = cursor[tile]
                    cursor[tile] = to + 1
                    lists[to] = g


@kernel
def _row_at(pair, tiles_x, tiles_y, starts):
    """The first row of tiles whose lists begin at or after `pair`."""
    row = 0
    while row < tiles_y and starts[row * tiles_x] < pair:
        row += 1
    return row
