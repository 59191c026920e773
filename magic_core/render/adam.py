"""One Adam step over all parameters of all Gaussians that were drawn.

The optimiser's parameters are mean, quaternion, log(scale), logit(opacity) and colour: 14 per
Gaussian. Gradients arrive by natural values and are chained here. A Gaussian that was not drawn
keeps its parameters and moments (as if it had not been in the problem); each counts its own
steps, so that the bias correction is right for Gaussians that joined later:

    m <- b1 m + (1 - b1) g,  v <- b2 v + (1 - b2) g^2,
    p <- p - rate m / (1 - b1^t) / (sqrt(v / (1 - b2^t)) + eps).

The scale regularisation of the paper, sum_k |s_k - mean s|_1 / n, is added to the gradient here.
State is planar, (row, capacity); the natural values are written interleaved for the next render.
"""

from __future__ import annotations

import numpy as np

from magic_core.render.jit import inlined, kernel
from magic_core.render.lanes import LANES
from magic_core.render.layout import CHUNK, f32
from magic_core.render.simd import (
    absolute,
    bits,
    fma,
    lane_sum,
    maximum,
    minimum,
    select,
    splat,
    square_root,
)
from magic_core.render.simd_memory import claim, load, load3, load4, store, store3, store4
from magic_core.render.vecmath import exp

# Rows of the planar state.
MEAN, QUATERNION, LOG_SCALE, LOGIT, COLOUR, ROWS = 0, 3, 7, 10, 11, 14

# Entries of the settings array: five learning rates, then the numbers of the regularisation.
RATE_MEAN, RATE_QUATERNION, RATE_SCALE, RATE_OPACITY, RATE_COLOUR = range(5)
SCALE_MEAN, SCALE_SHARE, MEAN_SIGN, SETTINGS = range(5, 9)

LOGIT_LIMIT = f32(12.0)
LOG_SCALE_MIN, LOG_SCALE_MAX = f32(-12.0), f32(3.0)

_BETA1, _BETA2, _EPSILON = f32(0.9), f32(0.999), f32(1e-15)
_LOG_BETA1, _LOG_BETA2 = f32(np.log(0.9)), f32(np.log(0.999))
_ZERO, _ONE = f32(0.0), f32(1.0)


@kernel
def scale_statistics(scales, count):
    """(mean, sum of |s - mean|, mean of sign(s - mean)) of `count` flat scales, in fixed order."""
    whole = count // LANES * LANES
    sums = splat(_ZERO)
    total = 0.0
    for i in range(0, whole, LANES):
        sums = sums + load(scales, i)
        if i % 1024 == 0:  # float32 lanes hold short sums only
            total += np.float64(lane_sum(sums))
            sums = splat(_ZERO)
    total += np.float64(lane_sum(sums))
    for i in range(whole, count):
        total += np.float64(scales[i])
    mean = f32(total / max(count, 1))
    above, below, deviation = 0.0, 0.0, 0.0
    over, under, away = splat(_ZERO), splat(_ZERO), splat(_ZERO)
    one, zero, centre = splat(_ONE), splat(_ZERO), splat(mean)
    for i in range(0, whole, LANES):
        difference = load(scales, i) - centre
        over = over + select(difference > zero, one, zero)
        under = under + select(difference < zero, one, zero)
        away = away + absolute(difference)
        if i % 1024 == 0:
            deviation += np.float64(lane_sum(away))
            away = zero
    above, below = np.float64(lane_sum(over)), np.float64(lane_sum(under))
    deviation += np.float64(lane_sum(away))
    for i in range(whole, count):
        difference = scales[i] - mean
        above += np.float64(difference > _ZERO)
        below += np.float64(difference < _ZERO)
        deviation += np.float64(abs(difference))
    return mean, deviation, f32((above - below) / max(count, 1))


@inlined
def _moved(state, moments, squares, at, gradient, rate, drawn):
    """Advance one row of LANES parameters; returns their new values.

    rate is the learning rate and both bias corrections folded into two vectors.
    """
    step, correction = rate
    old_m, old_v, old = load(moments, at), load(squares, at), load(state, at)
    m = fma(splat(_ONE - _BETA1), gradient - old_m, old_m)
    v = fma(splat(_ONE - _BETA2), gradient * gradient - old_v, old_v)
    store(moments, at, select(drawn, m, old_m))
    store(squares, at, select(drawn, v, old_v))
    new = old - step * m / (square_root(v * correction) + splat(_EPSILON))
    return select(drawn, new, old)


@inlined
def _regularised(gradient, scale, settings):
    """Add the scale regularisation's gradient, then chain to the logarithm."""
    one, zero = splat(_ONE), splat(_ZERO)
    difference = scale - splat(settings[SCALE_MEAN])
    sign = select(difference > zero, one, zero) - select(difference < zero, one, zero)
    pull = splat(settings[SCALE_SHARE]) * (sign - splat(settings[MEAN_SIGN]))
    return (gradient + pull) * scale


@inlined
def _drawn_lanes(touched, steps, first, n, scratch):
    """The mask of lanes to step, and the number of their step, counted here."""
    for lane in range(LANES):
        g = first + lane
        scratch[lane] = _ONE if g < n and touched[g] > 0 else _ZERO
    drawn = load(scratch, 0) > splat(_ZERO)
    count = load(steps, first) + load(scratch, 0)
    store(steps, first, count)
    count = maximum(count, splat(_ONE))
    return drawn, count


@kernel
def adam_step(claimed, n, touched, d_means, d_quaternions, d_scales, d_opacities, d_colours,
              settings, room, state, moments, squares, steps,
              means, quaternions, scales, opacities, colours):  # fmt: skip
    """Step every drawn Gaussian and write its natural values.

    state, moments, squares: flat (ROWS, room); all arrays have room for LANES more than n.
    """
    scratch = np.zeros(LANES, np.float32)
    one = splat(_ONE)
    while True:
        chunk = claim(claimed, np.int64(1))
        begin = chunk * CHUNK
        if begin >= n:
            break
        for first in range(begin, min(begin + CHUNK, n), LANES):
            drawn, count = _drawn_lanes(touched, steps, first, n, scratch)
            if bits(drawn) == np.uint32(0):
                continue
            correction1 = one / (one - exp(count * splat(_LOG_BETA1)))
            correction2 = one / (one - exp(count * splat(_LOG_BETA2)))

            rate = (splat(settings[RATE_MEAN]) * correction1, correction2)
            g = load3(d_means, 3 * first)
            x = _moved(state, moments, squares, (MEAN + 0) * room + first, g[0], rate, drawn)
            y = _moved(state, moments, squares, (MEAN + 1) * room + first, g[1], rate, drawn)
            z = _moved(state, moments, squares, (MEAN + 2) * room + first, g[2], rate, drawn)
            _keep3(state, MEAN * room + first, room, x, y, z)
            store3(means, 3 * first, x, y, z)

            rate = (splat(settings[RATE_QUATERNION]) * correction1, correction2)
            q = load4(d_quaternions, 4 * first)
            at = QUATERNION * room + first
            qw = _moved(state, moments, squares, at, q[0], rate, drawn)
            qx = _moved(state, moments, squares, at + room, q[1], rate, drawn)
            qy = _moved(state, moments, squares, at + 2 * room, q[2], rate, drawn)
            qz = _moved(state, moments, squares, at + 3 * room, q[3], rate, drawn)
            norm = square_root(fma(qw, qw, fma(qx, qx, fma(qy, qy, qz * qz))))
            unit = select(drawn, one / norm, one)
            qw, qx, qy, qz = qw * unit, qx * unit, qy * unit, qz * unit
            store(state, at, qw)
            _keep3(state, at + room, room, qx, qy, qz)
            store4(quaternions, 4 * first, qw, qx, qy, qz)

            rate = (splat(settings[RATE_SCALE]) * correction1, correction2)
            g = load3(d_scales, 3 * first)
            s = load3(scales, 3 * first)
            at = LOG_SCALE * room + first
            g0, g1 = _regularised(g[0], s[0], settings), _regularised(g[1], s[1], settings)
            g2 = _regularised(g[2], s[2], settings)
            l0 = _limited_scale(_moved(state, moments, squares, at, g0, rate, drawn))
            l1 = _limited_scale(_moved(state, moments, squares, at + room, g1, rate, drawn))
            l2 = _limited_scale(_moved(state, moments, squares, at + 2 * room, g2, rate, drawn))
            _keep3(state, at, room, l0, l1, l2)
            e0, e1 = select(drawn, exp(l0), s[0]), select(drawn, exp(l1), s[1])
            store3(scales, 3 * first, e0, e1, select(drawn, exp(l2), s[2]))

            rate = (splat(settings[RATE_OPACITY]) * correction1, correction2)
            o = load(opacities, first)
            at = LOGIT * room + first
            by_logit = load(d_opacities, first) * o * (one - o)
            logit = _moved(state, moments, squares, at, by_logit, rate, drawn)
            logit = minimum(maximum(logit, splat(-LOGIT_LIMIT)), splat(LOGIT_LIMIT))
            store(state, at, logit)
            sigmoid = one / (one + exp(splat(_ZERO) - logit))
            store(opacities, first, select(drawn, sigmoid, o))

            rate = (splat(settings[RATE_COLOUR]) * correction1, correction2)
            g = load3(d_colours, 3 * first)
            at = COLOUR * room + first
            red = _unit(_moved(state, moments, squares, at, g[0], rate, drawn))
            green = _unit(_moved(state, moments, squares, at + room, g[1], rate, drawn))
            blue = _unit(_moved(state, moments, squares, at + 2 * room, g[2], rate, drawn))
            _keep3(state, at, room, red, green, blue)
            store3(colours, 3 * first, red, green, blue)


@inlined
def _keep3(state, at, room, a, b, c):
    """Store three rows of the state."""
    store(state, at, a)
    store(state, at + room, b)
    store(state, at + 2 * room, c)


@inlined
def _limited_scale(log_scale):
    """Keep a scale between 6 micrometres and 20 metres: beyond, gradients overflow."""
    return minimum(maximum(log_scale, splat(LOG_SCALE_MIN)), splat(LOG_SCALE_MAX))


@inlined
def _unit(colour):
    """Keep a colour in [0, 1]."""
    return minimum(maximum(colour, splat(_ZERO)), splat(_ONE))
