"""How many vector multiply-adds per second one thread can issue: the limit of the blend loops."""

from __future__ import annotations

import time

import numpy as np

from magic_core.render.jit import kernel
from magic_core.render.simd import fma, lane_sum, splat

_ROUNDS, _CHAINS = 100_000, 10


@kernel
def _multiply_adds(rounds, values):
    """`rounds` times ten independent vector multiply-adds on different values."""
    x, y = splat(values[10]), splat(values[11])
    a, b, c, d = splat(values[0]), splat(values[1]), splat(values[2]), splat(values[3])
    e, f, g, h = splat(values[4]), splat(values[5]), splat(values[6]), splat(values[7])
    i, j = splat(values[8]), splat(values[9])
    for _ in range(rounds):
        a, b, c, d, e = fma(a, x, y), fma(b, x, y), fma(c, x, y), fma(d, x, y), fma(e, x, y)
        f, g, h, i, j = fma(f, x, y), fma(g, x, y), fma(h, x, y), fma(i, x, y), fma(j, x, y)
    return lane_sum(a + b + c + d + e + f + g + h + i + j)


def multiply_add_rate() -> float:
    """Vector multiply-adds per second of one thread, now."""
    values = np.linspace(0.1, 0.9, _CHAINS + 2, dtype=np.float32)
    _multiply_adds(1, values)
    start = time.perf_counter()
    _multiply_adds(_ROUNDS, values)
    return _ROUNDS * _CHAINS / (time.perf_counter() - start)
