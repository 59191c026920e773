"""Exponential and logarithm of vectors, and the short exponential of the blend kernels."""

from __future__ import annotations

import numpy as np

from magic_core.render.jit import inlined
from magic_core.render.simd import (
    exponent_of,
    floor,
    fma,
    fnma,
    mantissa_of,
    maximum,
    minimum,
    power_of_two,
    select,
    splat,
)

f32 = np.float32

# exp(t) on [-ln(255)/8, 0] within 4e-7: minimax polynomial of degree 5.
_E0, _E1, _E2 = f32(0.9999999246716593), f32(0.9999928600637641), f32(0.49988656597514275)
_E3, _E4, _E5 = f32(0.1659912328815471), f32(0.039803025547104104), f32(0.005865515084323869)

_LOG2_E, _LN2 = f32(1.4426950408889634), f32(0.6931471805599453)
_LN2_HIGH, _LN2_LOW = f32(0.693359375), f32(-2.12194440e-4)
_HALF, _ONE, _SQRT2 = f32(0.5), f32(1.0), f32(1.41421356)

# Cephes expf and logf (S. Moshier): minimax coefficients for single precision.
_X0, _X1, _X2 = f32(1.9875691500e-4), f32(1.3981999507e-3), f32(8.3334519073e-3)
_X3, _X4, _X5 = f32(4.1665795894e-2), f32(1.6666665459e-1), f32(5.0000001201e-1)
_L0, _L1, _L2 = f32(7.0376836292e-2), f32(-1.1514610310e-1), f32(1.1676998740e-1)
_L3, _L4, _L5 = f32(-1.2420140846e-1), f32(1.4249322787e-1), f32(-1.6668057665e-1)
_L6, _L7, _L8 = f32(2.0000714765e-1), f32(-2.4999993993e-1), f32(3.3333331174e-1)


@inlined
def exp_of_8(t):
    """exp(8 t) for t in [-ln(255)/8, 0]; finite, and meaningless, elsewhere near it."""
    p = fma(splat(_E5), t, splat(_E4))
    p = fma(p, t, splat(_E3))
    p = fma(p, t, splat(_E2))
    p = fma(p, t, splat(_E1))
    p = fma(p, t, splat(_E0))
    p = p * p
    p = p * p
    return p * p


@inlined
def exp(x):
    """exp(x) within 2 ulp, x clamped to [-87, 88]."""
    x = minimum(maximum(x, splat(f32(-87.0))), splat(f32(88.0)))
    n = floor(fma(x, splat(_LOG2_E), splat(_HALF)))
    r = fnma(n, splat(_LN2_LOW), fnma(n, splat(_LN2_HIGH), x))
    p = fma(splat(_X0), r, splat(_X1))
    p = fma(p, r, splat(_X2))
    p = fma(p, r, splat(_X3))
    p = fma(p, r, splat(_X4))
    p = fma(p, r, splat(_X5))
    p = fma(p, r * r, r + splat(_ONE))
    return p * power_of_two(n)


@inlined
def log(x):
    """ln(x) of positive normal x within 2 ulp."""
    exponent, m = exponent_of(x), mantissa_of(x)
    large = m > splat(_SQRT2)
    m = select(large, m * splat(_HALF), m) - splat(_ONE)
    exponent = select(large, exponent + splat(_ONE), exponent)
    p = fma(splat(_L0), m, splat(_L1))
    p = fma(p, m, splat(_L2))
    p = fma(p, m, splat(_L3))
    p = fma(p, m, splat(_L4))
    p = fma(p, m, splat(_L5))
    p = fma(p, m, splat(_L6))
    p = fma(p, m, splat(_L7))
    p = fma(p, m, splat(_L8))
    z = m * m
    tail = fnma(splat(_HALF), z, p * (m * z))
    return fma(exponent, splat(_LN2), m + tail)
