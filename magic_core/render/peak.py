"""How many vector multiply-adds per second one thread can issue: the limit of the blend loops."""

from __future__ import annotations

import time

import numpy as np

from magic_core.render.jit import kernel
from magic_core.render.layout import f32
from magic_core.render.simd import fma, lane_sum, splat

_ROUNDS, _CHAINS = 200_000, 10


@kernel
def _multiply_adds(rounds, factor):
    """`rounds` times ten independent vector multiply-adds; the result keeps them alive."""
    x, y = splat(f32(factor)), splat(f32(1e-3))
    a, b, c, d, e = y, y, y, y, y
    f, g, h, i, j = y, y, y, y, y
    for _ in range(rounds):
        a, b, c, d, e = fma(a, x, y), fma(b, x, y), fma(c, x, y), fma(d, x, y), fma(e, x, y)
        f, g, h, i, j = fma(f, x, y), fma(g, x, y), fma(h, x, y), fma(i, x, y), fma(j, x, y)
    return lane_sum(a + b + c + d + e + f + g + h + i + j)


def multiply_add_rate() -> float:
    """Vector multiply-adds per second of one thread, now."""
    _multiply_adds(1, np.float32(0.5))
    start = time.perf_counter()
    _multiply_adds(_ROUNDS, np.float32(0.5))
    return _ROUNDS * _CHAINS / (time.perf_counter() - start)
