"""The SIMD value type against numpy, lane by lane, and its special functions against float64."""

import io
import os
import subprocess
import sys

import numba
import numpy as np
import pytest

from magic_core.render import simd, vecmath
from magic_core.render import simd_memory as memory
from magic_core.render.lanes import LANES, choose_lanes

f32 = np.float32
njit = numba.njit(error_model="numpy")


def vectors(count, seed=0):
    return np.random.default_rng(seed).normal(size=(count, LANES)).astype(np.float32)


@njit
def _arithmetic(a, b, c, out):
    x, y, z = memory.load(a, 0), memory.load(b, 0), memory.load(c, 0)
    memory.store(out, 0, x + y)
    memory.store(out, LANES, x - y)
    memory.store(out, 2 * LANES, x * y)
    memory.store(out, 3 * LANES, x / y)
    memory.store(out, 4 * LANES, simd.fma(x, y, z))
    memory.store(out, 5 * LANES, simd.fnma(x, y, z))
    memory.store(out, 6 * LANES, simd.minimum(x, y))
    memory.store(out, 7 * LANES, simd.maximum(x, y))
    memory.store(out, 8 * LANES, simd.select(x > y, z, x))
    memory.store(out, 9 * LANES, simd.zero_unless((x >= y) & (z < x), z))
    memory.store(out, 10 * LANES, simd.square_root(simd.absolute(x)))
    memory.store(out, 11 * LANES, simd.floor(x))
    memory.store(out, 12 * LANES, simd.ceil(x))
    memory.store(out, 13 * LANES, simd.splat(a[3]))
    return simd.bits(x <= y), simd.bits((x < y) | (x > z))


def test_arithmetic_is_that_of_numpy_lane_by_lane():
    a, b, c = vectors(3)
    out = np.zeros(14 * LANES, np.float32)
    at_most, either = _arithmetic(a, b, c, out)
    exact = (a.astype(np.float64) * b + c).astype(np.float32)
    exact_minus = (c - a.astype(np.float64) * b).astype(np.float32)
    expected = [
        a + b, a - b, a * b, a / b, exact, exact_minus, np.minimum(a, b), np.maximum(a, b),
        np.where(a > b, c, a), np.where((a >= b) & (c < a), c, 0), np.sqrt(np.abs(a)),
        np.floor(a), np.ceil(a), np.full(LANES, a[3]),
    ]  # fmt: skip
    np.testing.assert_array_equal(out.reshape(14, LANES), np.stack(expected))
    lanes = 1 << np.arange(LANES)
    assert at_most == lanes[a <= b].sum()
    assert either == lanes[(a < b) | (a > c)].sum()


@njit
def _comparisons(a, b):
    x, y = memory.load(a, 0), memory.load(b, 0)
    return simd.bits(x > y) | simd.bits(x >= y) | simd.bits(x < y) | simd.bits(x <= y)


def test_comparisons_with_nan_are_false():
    a = vectors(1)[0]
    b = np.full(LANES, np.nan, np.float32)
    assert _comparisons(a, b) == 0
    assert _comparisons(b, b) == 0


@njit
def _interleaved(source, three, four):
    a, b, c = memory.load3(source, 0)
    memory.store3(three, 0, c, a, b)
    a, b, c, d = memory.load4(source, 0)
    memory.store4(four, 0, d, c, b, a)


def test_interleaved_streams_come_apart_and_together():
    source = vectors(4).ravel()
    three, four = np.zeros(3 * LANES, np.float32), np.zeros(4 * LANES, np.float32)
    _interleaved(source, three, four)
    np.testing.assert_array_equal(
        three.reshape(-1, 3), source[: 3 * LANES].reshape(-1, 3)[:, [2, 0, 1]]
    )
    np.testing.assert_array_equal(four.reshape(-1, 4), source.reshape(-1, 4)[:, ::-1])


@njit
def _blocks(plane, copy, width):
    memory.store_block(copy, 2 * width + 3, width, memory.load_block(plane, width + 5, width))


def test_blocks_are_four_pixels_wide():
    plane = np.arange(12 * 20, dtype=np.float32).reshape(12, 20)
    copy = np.zeros_like(plane)
    _blocks(plane.ravel(), copy.reshape(-1), 20)
    height = memory.BLOCK_HEIGHT
    expected = np.zeros_like(plane)
    expected[2 : 2 + height, 3:7] = plane[1 : 1 + height, 5:9]
    np.testing.assert_array_equal(copy, expected)
    assert memory.BLOCK_WIDTH * height == LANES


@njit
def _sums(a, out):
    memory.store_sums10(
        out, 0, memory.load(a, 0), memory.load(a, LANES), memory.load(a, 2 * LANES),
        memory.load(a, 3 * LANES), memory.load(a, 4 * LANES), memory.load(a, 5 * LANES),
        memory.load(a, 6 * LANES), memory.load(a, 7 * LANES), memory.load(a, 8 * LANES),
        memory.load(a, 9 * LANES),
    )  # fmt: skip
    return simd.lane_sum(memory.load(a, 0))


def test_sums_over_lanes_land_in_order():
    a = vectors(10)
    out = np.zeros(16, np.float32)
    first = _sums(a.reshape(-1), out)
    np.testing.assert_allclose(out[:10], a.astype(np.float64).sum(axis=1), atol=1e-5)
    assert first == out[0]


@njit
def _bit_columns(words, columns, back):
    for bit in range(256 // LANES):
        for part in range(64 // LANES):
            column = memory.column_bits(words, part * LANES, np.uint32(bit))
            columns[bit] |= np.uint64(column) << np.uint64(part * LANES)
    for part in range(0, 64, LANES):
        memory.store_columns(back, part, columns, part)


def test_bit_matrices_transpose_and_return():
    blocks = 256 // LANES
    words = np.random.default_rng(0).integers(0, 1 << blocks, 64).astype(np.uint32)
    columns, back = np.zeros(blocks, np.uint64), np.zeros(64, np.uint32)
    _bit_columns(words, columns, back)
    for bit in range(blocks):
        expected = sum(1 << i for i in range(64) if words[i] >> bit & 1)
        assert int(columns[bit]) == expected
    np.testing.assert_array_equal(back, words)


@njit
def _functions(x, out, n):
    for i in range(0, n, LANES):
        v = memory.load(x, i)
        memory.store(out, i, vecmath.exp(v))
        memory.store(out, n + i, vecmath.log(simd.absolute(v) + simd.splat(f32(1e-6))))
        memory.store(out, 2 * n + i, simd.reciprocal(v))


def test_exponential_and_logarithm_are_accurate():
    n = 4096
    x = np.random.default_rng(0).uniform(-80, 80, n).astype(np.float32)
    out = np.zeros(3 * n, np.float32)
    _functions(x, out, n)
    wide = x.astype(np.float64)
    np.testing.assert_allclose(out[:n], np.exp(wide), rtol=3e-7)
    logs = np.log((np.abs(x) + f32(1e-6)).astype(np.float64))
    np.testing.assert_allclose(out[n : 2 * n], logs, rtol=3e-7, atol=1e-7)
    np.testing.assert_allclose(out[2 * n :], 1 / wide, rtol=1e-4)


@njit
def _short_exponential(t, out, n):
    for i in range(0, n, LANES):
        memory.store(out, i, vecmath.exp_of_8(memory.load(t, i)))


def test_the_short_exponential_is_accurate_on_its_range():
    n = 4096
    t = np.linspace(-np.log(255) / 8, 0, n, dtype=np.float32)
    out = np.zeros(n, np.float32)
    _short_exponential(t, out, n)
    np.testing.assert_allclose(out, np.exp(8 * t.astype(np.float64)), rtol=2e-6)


@njit
def _first_free(counter):
    return memory.claim(counter, np.int64(1))


def test_claims_count_up():
    counter = np.zeros(1, np.int64)
    assert [_first_free(counter) for _ in range(3)] == [0, 1, 2]


def test_lanes_follow_the_target_processor(monkeypatch):
    from numba.core import config

    monkeypatch.delenv("MAGIC_LANES", raising=False)
    wide = "+avx2,+avx512f,+avx512bw,+avx512dq,+avx512vl"
    for features, lanes in ((wide, 16), ("+avx2,+fma", 8), ("+avx512f", 8), ("-avx512f", 8)):
        monkeypatch.setattr(config, "CPU_FEATURES", features, raising=False)
        assert choose_lanes() == lanes
    monkeypatch.setenv("MAGIC_LANES", "12")
    with pytest.raises(ValueError, match="expected 8 or 16"):
        choose_lanes()


@pytest.mark.skipif(LANES != 16, reason="this machine has no 16-lane path to compare with")
def test_the_eight_lane_path_draws_the_same_image():
    """Compiled for AVX2 alone in another process; only sums over lanes may round differently."""
    from magic_core.render.benchmark import _AVX2_TARGET

    script = (
        "import sys, numpy as np\n"
        "from magic_core.render.benchmark import Subject\n"
        "from magic_core.render.lanes import LANES\n"
        "s = Subject.of((67, 45, 800), 1)\n"
        "view = s.rasteriser.render(s.cloud, s.camera, np.eye(4))\n"
        "g = s.rasteriser.backward(s.gradient)\n"
        "np.savez(sys.stdout.buffer, lanes=LANES, image=view.image, visible=view.visible,\n"
        "         means=g.means, quaternions=g.quaternions, scales=g.scales,\n"
        "         opacities=g.opacities, colours=g.colours, pose=g.pose)\n"
    )
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", script], env={**os.environ, **environment},
            stdout=subprocess.PIPE,
        )
        for environment in ({}, _AVX2_TARGET)
    ]  # fmt: skip
    outputs = [process.communicate(timeout=300)[0] for process in processes]
    assert [process.returncode for process in processes] == [0, 0]
    wide, narrow = (np.load(io.BytesIO(output)) for output in outputs)
    assert (int(wide["lanes"]), int(narrow["lanes"])) == (16, 8)
    np.testing.assert_array_equal(wide["image"], narrow["image"])
    np.testing.assert_array_equal(wide["visible"], narrow["visible"])
    for name in ("means", "quaternions", "scales", "opacities", "colours", "pose"):
        scale = np.linalg.norm(wide[name])
        assert np.linalg.norm(wide[name] - narrow[name]) < 1e-3 * scale, name
