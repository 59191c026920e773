"""Stage 2, sort: the drawn Gaussians in order of depth, nearest first, ties in order of index.

A stable least-significant-digit radix sort on the bits of the float32 depth, which are ordered like
the depth itself because it is positive. Only the digits in which the keys differ are sorted.
"""

from __future__ import annotations

import numpy as np

from magic_core.render.jit import kernel
from magic_core.render.layout import CHUNK

_DIGIT_BITS = 12  # at most: 4,096 counters of 4 bytes stay in the first-level cache


@kernel
def sort_by_depth(chunks, chunk_count, keys, ids, key_buffers, id_buffers):
    """Sort the (key, id) pairs that `project` left at the start of each chunk.

    key_buffers and id_buffers are (2, capacity). Returns (which buffer holds the result, count).
    """
    lowest, highest, count = np.uint32(0xFFFFFFFF), np.uint32(0), 0
    for chunk in range(chunk_count):
        drawn = chunks[3 * chunk]
        count += drawn
        for i in range(CHUNK * chunk, CHUNK * chunk + drawn):
            lowest, highest = min(lowest, keys[i]), max(highest, keys[i])
    if count == 0:
        return 0, 0
    significant = 1
    while significant < 32 and ((highest - lowest) >> np.uint32(significant)) != np.uint32(0):
        significant += 1
    passes = (significant + _DIGIT_BITS - 1) // _DIGIT_BITS
    bits = np.uint32((significant + passes - 1) // passes)
    size = 1 << int(bits)
    digit_mask = np.uint32(size - 1)
    starts = np.zeros((passes, size), np.int32)
    for chunk in range(chunk_count):
        for i in range(CHUNK * chunk, CHUNK * chunk + chunks[3 * chunk]):
            key = keys[i] - lowest
            for step in range(passes):
                starts[step, (key >> (np.uint32(step) * bits)) & digit_mask] += 1
    for step in range(passes):
        total = 0
        for digit in range(size):
            here = starts[step, digit]
            starts[step, digit] = total
            total += here
    for chunk in range(chunk_count):  # the first digit, gathering the chunks
        for i in range(CHUNK * chunk, CHUNK * chunk + chunks[3 * chunk]):
            key = keys[i] - lowest
            digit = key & digit_mask
            to = starts[0, digit]
            starts[0, digit] = to + 1
            key_buffers[0, to] = key
            id_buffers[0, to] = ids[i]
    source = 0
    for step in range(1, passes):
        shift = np.uint32(step) * bits
        for i in range(count):
            key = key_buffers[source, i]
            digit = (key >> shift) & digit_mask
            to = starts[step, digit]
            starts[step, digit] = to + 1
            key_buffers[1 - source, to] = key
            id_buffers[1 - source, to] = id_buffers[source, i]
        source = 1 - source
    return source, count
