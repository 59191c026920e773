"""A vector of LANES float32 values, and a vector of LANES booleans, as numba value types.

LLVM maps `Vector` to one AVX-512 register (16 lanes), one AVX register or two NEON registers
(8 lanes). Arithmetic is plain IEEE (no reassociation, no contraction), so that the forward and
the backward blend round alike and both widths give the same image; `fma` is one rounding.
Comparisons are ordered: false when a NaN takes part.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic as _numba_intrinsic
from numba.extending import lower_builtin, models, register_model

from magic_core.render.lanes import LANES

_f32, _i32, _i64, _i1 = ir.FloatType(), *(ir.IntType(bits) for bits in (32, 64, 1))
_floats = ir.VectorType(_f32, LANES)
_ints = ir.VectorType(_i32, LANES)
_bools = ir.VectorType(_i1, LANES)


def intrinsic(function: Callable) -> Any:
    """numba's decorator, typed loosely: what it returns is called without the typing context."""
    return _numba_intrinsic(function)


class VectorType(types.Type):
    """LANES float32 values."""

    def __init__(self) -> None:
        super().__init__(name=f"Vector{LANES}")


class MaskType(types.Type):
    """LANES booleans."""

    def __init__(self) -> None:
        super().__init__(name=f"Mask{LANES}")


Vector, Mask = VectorType(), MaskType()


@register_model(VectorType)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager, fe_type):
        super().__init__(manager, fe_type, _floats)


@register_model(MaskType)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, manager, fe_type):
        super().__init__(manager, fe_type, _bools)


# --- operators ---------------------------------------------------------------------------------


_typed: Any = infer_global


def _define_operator(symbol, argument, result, emit) -> None:
    """Give `symbol` a meaning for two values of type `argument`."""

    @_typed(symbol)
    class _Typing(AbstractTemplate):
        def generic(self, args, kws):
            if len(args) == 2 and args[0] is argument and args[1] is argument:
                return signature(result, argument, argument)
            return None

    @lower_builtin(symbol, argument, argument)
    def _lower(context, builder, sig, args):
        return emit(builder, args[0], args[1])


_define_operator(operator.add, Vector, Vector, lambda b, x, y: b.fadd(x, y))
_define_operator(operator.sub, Vector, Vector, lambda b, x, y: b.fsub(x, y))
_define_operator(operator.mul, Vector, Vector, lambda b, x, y: b.fmul(x, y))
_define_operator(operator.truediv, Vector, Vector, lambda b, x, y: b.fdiv(x, y))
_define_operator(operator.ge, Vector, Mask, lambda b, x, y: b.fcmp_ordered(">=", x, y))
_define_operator(operator.gt, Vector, Mask, lambda b, x, y: b.fcmp_ordered(">", x, y))
_define_operator(operator.le, Vector, Mask, lambda b, x, y: b.fcmp_ordered("<=", x, y))
_define_operator(operator.lt, Vector, Mask, lambda b, x, y: b.fcmp_ordered("<", x, y))
_define_operator(operator.and_, Mask, Mask, lambda b, x, y: b.and_(x, y))
_define_operator(operator.or_, Mask, Mask, lambda b, x, y: b.or_(x, y))


def _broadcast(builder, scalar, vector_type):
    undefined = ir.Constant(vector_type, ir.Undefined)
    first = builder.insert_element(undefined, scalar, ir.Constant(_i32, 0))
    return builder.shuffle_vector(first, undefined, ir.Constant(_ints, [0] * LANES))


def _llvm(builder, name, result, *arguments):
    """Call an LLVM intrinsic by name."""
    function_type = ir.FunctionType(result, [a.type for a in arguments])
    function = cgutils.get_or_insert_function(builder.module, function_type, name)
    return builder.call(function, arguments)


def _suffix() -> str:
    return f"v{LANES}f32"


@intrinsic
def splat(typing, scalar):
    """Every lane holds the float32 `scalar`."""

    def emit(context, builder, sig, args):
        return _broadcast(builder, args[0], _floats)

    return Vector(types.float32), emit


@intrinsic
def fma(typing, a, b, c):
    """a * b + c, rounded once."""

    def emit(context, builder, sig, args):
        return _llvm(builder, f"llvm.fma.{_suffix()}", _floats, *args)

    return Vector(Vector, Vector, Vector), emit


@intrinsic
def fnma(typing, a, b, c):
    """c - a * b, rounded once."""

    def emit(context, builder, sig, args):
        return _llvm(builder, f"llvm.fma.{_suffix()}", _floats, builder.fneg(args[0]), *args[1:])

    return Vector(Vector, Vector, Vector), emit


@intrinsic
def minimum(typing, a, b):
    """The lesser of each lane; b where a NaN takes part."""

    def emit(context, builder, sig, args):
        return builder.select(builder.fcmp_ordered("<", *args), *args)

    return Vector(Vector, Vector), emit


@intrinsic
def maximum(typing, a, b):
    """The greater of each lane; b where a NaN takes part."""

    def emit(context, builder, sig, args):
        return builder.select(builder.fcmp_ordered(">", *args), *args)

    return Vector(Vector, Vector), emit


@intrinsic
def select(typing, mask, a, b):
    """a where the mask is set, else b."""

    def emit(context, builder, sig, args):
        return builder.select(*args)

    return Vector(Mask, Vector, Vector), emit


@intrinsic
def zero_unless(typing, mask, a):
    """a where the mask is set, else 0."""

    def emit(context, builder, sig, args):
        return builder.select(args[0], args[1], ir.Constant(_floats, [0.0] * LANES))

    return Vector(Mask, Vector), emit


def _define_unary(name):
    @intrinsic
    def unary(typing, a):
        def emit(context, builder, sig, args):
            return _llvm(builder, f"llvm.{name}.{_suffix()}", _floats, args[0])

        return Vector(Vector), emit

    return unary


square_root, floor, ceil, absolute = (_define_unary(n) for n in ("sqrt", "floor", "ceil", "fabs"))


@intrinsic
def reciprocal(typing, a):
    """1 / a, to 6e-5 relative at worst: AVX-512's estimate as it is, else estimate and Newton step.

    For gradients only. The two Newton operations would cost a twentieth of the backward blend.
    """

    def emit(context, builder, sig, args):
        if LANES == 16:
            everything = ir.Constant(ir.IntType(16), -1)
            zero = ir.Constant(_floats, [0.0] * LANES)
            name = "llvm.x86.avx512.rcp14.ps.512"
            return _llvm(builder, name, _floats, args[0], zero, everything)
        one = ir.Constant(_floats, [1.0] * LANES)
        return builder.fdiv(one, args[0], flags=("fast",))

    return Vector(Vector), emit


@intrinsic
def power_of_two(typing, a):
    """2 ** a of integer-valued lanes in [-126, 127]."""

    def emit(context, builder, sig, args):
        exponent = builder.fptosi(args[0], _ints)
        biased = builder.add(exponent, ir.Constant(_ints, [127] * LANES))
        shifted = builder.shl(biased, ir.Constant(_ints, [23] * LANES))
        return builder.bitcast(shifted, _floats)

    return Vector(Vector), emit


@intrinsic
def exponent_of(typing, a):
    """floor(log2(a)) of positive normal lanes."""

    def emit(context, builder, sig, args):
        raw = builder.lshr(builder.bitcast(args[0], _ints), ir.Constant(_ints, [23] * LANES))
        return builder.sitofp(builder.sub(raw, ir.Constant(_ints, [127] * LANES)), _floats)

    return Vector(Vector), emit


@intrinsic
def mantissa_of(typing, a):
    """a / 2 ** exponent_of(a), in [1, 2), of positive normal lanes."""

    def emit(context, builder, sig, args):
        raw = builder.bitcast(args[0], _ints)
        fraction = builder.and_(raw, ir.Constant(_ints, [0x7FFFFF] * LANES))
        return builder.bitcast(
            builder.or_(fraction, ir.Constant(_ints, [0x3F800000] * LANES)), _floats
        )

    return Vector(Vector), emit


# --- masks -------------------------------------------------------------------------------------


@intrinsic
def bits(typing, mask):
    """The mask as an integer, lane 0 in bit 0."""

    def emit(context, builder, sig, args):
        return builder.zext(builder.bitcast(args[0], ir.IntType(LANES)), _i32)

    return types.uint32(Mask), emit


@intrinsic
def column_bits(typing, words, index, bit):
    """Bit `bit` of the LANES uint32 words from `index` on, gathered into one integer."""

    def emit(context, builder, sig, args):
        pointer = _pointer(context, builder, sig.args[0], args[0], args[1], _ints)
        loaded = builder.load(pointer, align=4)
        one_bit = builder.shl(ir.Constant(_i32, 1), args[2])
        picked = builder.and_(loaded, _broadcast(builder, one_bit, _ints))
        is_set = builder.icmp_unsigned("!=", picked, ir.Constant(_ints, [0] * LANES))
        return builder.zext(builder.bitcast(is_set, ir.IntType(LANES)), _i32)

    return types.uint32(words, types.int64, types.uint32), emit


@intrinsic
def trailing_zeros(typing, word):
    """The number of the lowest set bit of a non-zero uint32 or uint64."""
    width = word.bitwidth

    def emit(context, builder, sig, args):
        undefined_at_zero = ir.Constant(_i1, 1)
        count = _llvm(builder, f"llvm.cttz.i{width}", ir.IntType(width), args[0], undefined_at_zero)
        return builder.zext(count, _i64) if width < 64 else count

    return types.int64(word), emit


# --- memory ------------------------------------------------------------------------------------


def _pointer(context, builder, array_type, array, index, pointee):
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index], inbounds=True), pointee.as_pointer())


def _shuffled(builder, a, b, lanes):
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(_i32, len(lanes)), lanes))


@intrinsic
def load(typing, array, index):
    """LANES values of a flat float32 array from `index` on (no alignment asked)."""

    def emit(context, builder, sig, args):
        pointer = _pointer(context, builder, sig.args[0], args[0], args[1], _floats)
        return builder.load(pointer, align=4)

    return Vector(array, types.int64), emit


@intrinsic
def store(typing, array, index, vector):
    """Write the lanes to a flat float32 array from `index` on."""

    def emit(context, builder, sig, args):
        pointer = _pointer(context, builder, sig.args[0], args[0], args[1], _floats)
        builder.store(args[2], pointer, align=4)
        return context.get_dummy_value()

    return types.void(array, types.int64, Vector), emit


@intrinsic
def store_integers(typing, array, index, vector):
    """Write integer-valued lanes to a flat int32 array from `index` on."""

    def emit(context, builder, sig, args):
        pointer = _pointer(context, builder, sig.args[0], args[0], args[1], _ints)
        builder.store(builder.fptosi(args[2], _ints), pointer, align=4)
        return context.get_dummy_value()

    return types.void(array, types.int64, Vector), emit


def _strided_load(count):
    """A load of `count` interleaved streams: element k of lane i lies at index + count * i + k."""

    @intrinsic
    def load_interleaved(typing, array, index):
        def emit(context, builder, sig, args):
            flat = ir.VectorType(_f32, count * LANES)
            pointer = _pointer(context, builder, sig.args[0], args[0], args[1], flat)
            loaded = builder.load(pointer, align=4)
            streams = [
                _shuffled(builder, loaded, loaded, [count * lane + k for lane in range(LANES)])
                for k in range(count)
            ]
            return context.make_tuple(builder, sig.return_type, streams)

        return types.UniTuple(Vector, count)(array, types.int64), emit

    return load_interleaved


load3, load4 = _strided_load(3), _strided_load(4)


def _concatenated(builder, vectors):
    """One long vector of several equally long ones (their number is a power of two)."""
    while len(vectors) > 1:
        width = 2 * vectors[0].type.count
        vectors = [
            _shuffled(builder, a, b, list(range(width)))
            for a, b in zip(vectors[0::2], vectors[1::2], strict=True)
        ]
    return vectors[0]


def _store_interleaved(context, builder, sig, args):
    """The inverse of the interleaved load: args = (array, index, stream, stream, ...)."""
    streams = list(args[2:])
    count = len(streams)
    joined = _concatenated(builder, streams + [streams[-1]] * (4 - count))
    order = [LANES * k + lane for lane in range(LANES) for k in range(count)]
    flat = _shuffled(builder, joined, joined, order)
    pointer = _pointer(context, builder, sig.args[0], args[0], args[1], flat.type)
    builder.store(flat, pointer, align=4)
    return context.get_dummy_value()


@intrinsic
def store3(typing, array, index, a, b, c):
    """Write three streams interleaved: lane i of stream k goes to index + 3 * i + k."""
    return types.void(array, types.int64, Vector, Vector, Vector), _store_interleaved


@intrinsic
def store4(typing, array, index, a, b, c, d):
    """Write four streams interleaved: lane i of stream k goes to index + 4 * i + k."""
    return types.void(array, types.int64, Vector, Vector, Vector, Vector), _store_interleaved


BLOCK_WIDTH = 4
BLOCK_HEIGHT = LANES // BLOCK_WIDTH
_row = ir.VectorType(_f32, BLOCK_WIDTH)


def _row_pointer(context, builder, array_type, place, row):
    array, index, stride = place
    offset = builder.mul(stride, ir.Constant(_i64, row))
    return _pointer(context, builder, array_type, array, builder.add(index, offset), _row)


@intrinsic
def load_block(typing, array, index, stride):
    """A block of 4 pixels by BLOCK_HEIGHT rows of an image plane, its rows `stride` apart."""

    def emit(context, builder, sig, args):
        rows = [
            builder.load(_row_pointer(context, builder, sig.args[0], args[:3], row), align=4)
            for row in range(BLOCK_HEIGHT)
        ]
        return _concatenated(builder, rows)

    return Vector(array, types.int64, types.int64), emit


@intrinsic
def store_block(typing, array, index, stride, vector):
    """Write a block of 4 pixels by BLOCK_HEIGHT rows to an image plane."""

    def emit(context, builder, sig, args):
        for row in range(BLOCK_HEIGHT):
            lanes = list(range(BLOCK_WIDTH * row, BLOCK_WIDTH * (row + 1)))
            pointer = _row_pointer(context, builder, sig.args[0], args[:3], row)
            builder.store(_shuffled(builder, args[3], args[3], lanes), pointer, align=4)
        return context.get_dummy_value()

    return types.void(array, types.int64, types.int64, Vector), emit


@intrinsic
def read(typing, array, index):
    """array[index] of a flat array without Python's rule for negative indices (and its cost)."""

    def emit(context, builder, sig, args):
        element = context.get_data_type(sig.return_type)
        return builder.load(_pointer(context, builder, sig.args[0], args[0], args[1], element))

    return array.dtype(array, types.int64), emit


@intrinsic
def write(typing, array, index, value):
    """array[index] = value, likewise."""

    def emit(context, builder, sig, args):
        element = context.get_data_type(sig.args[2])
        builder.store(args[2], _pointer(context, builder, sig.args[0], args[0], args[1], element))
        return context.get_dummy_value()

    return types.void(array, types.int64, array.dtype), emit


@intrinsic
def store_columns(typing, array, index, words, shift):
    """The transpose of `column_bits`: write LANES uint32 whose bit b is a bit of words[b].

    Element array[index + i] gets bit shift + i of each of the uint64 words[0:256 / LANES].
    """
    blocks = 256 // LANES

    def emit(context, builder, sig, args):
        narrow = ir.IntType(LANES)
        total = ir.Constant(_ints, [0] * LANES)
        for block in range(blocks):
            at = ir.Constant(_i64, block)
            word = builder.load(_pointer(context, builder, sig.args[2], args[2], at, _i64))
            lanes = builder.bitcast(builder.trunc(builder.lshr(word, args[3]), narrow), _bools)
            bit = ir.Constant(_ints, [1 << block] * LANES)
            total = builder.or_(total, builder.select(lanes, bit, ir.Constant(_ints, [0] * LANES)))
        pointer = _pointer(context, builder, sig.args[0], args[0], args[1], _ints)
        builder.store(total, pointer, align=4)
        return context.get_dummy_value()

    return types.void(array, types.int64, words, types.int64), emit


@intrinsic
def prefetch(typing, array, index):
    """Ask for the cache line of array[index]; never faults."""

    def emit(context, builder, sig, args):
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        pointer = builder.bitcast(builder.gep(data, [args[1]]), ir.IntType(8).as_pointer())
        hints = [ir.Constant(_i32, value) for value in (0, 3, 1)]  # read, keep, data
        arguments = [pointer, *hints]
        function_type = ir.FunctionType(ir.VoidType(), [a.type for a in arguments])
        name = "llvm.prefetch.p0"
        function = cgutils.get_or_insert_function(builder.module, function_type, name)
        builder.call(function, arguments)
        return context.get_dummy_value()

    return types.void(array, types.int64), emit


@intrinsic
def float_bits(typing, value):
    """The bit pattern of a float32 (ordered like the number itself when it is positive)."""

    def emit(context, builder, sig, args):
        return builder.bitcast(args[0], _i32)

    return types.uint32(types.float32), emit


@intrinsic
def claim(typing, counter, step):
    """Atomically add `step` to counter[0] and return its old value: a thread's next piece."""

    def emit(context, builder, sig, args):
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        return builder.atomic_rmw("add", data, args[1], "monotonic")

    return types.int64(counter, types.int64), emit


# --- sums --------------------------------------------------------------------------------------


def _fold(builder, a, b, held):
    """Halve the partial sums of two vectors that hold `held` quantities each, and join them.

    Quantity q has its partial sums in lanes q * LANES / held and on. The result holds the
    quantities of a, then those of b, with half as many partial sums each.
    """
    step, half = LANES // held, LANES // held // 2
    first = [source * LANES + q * step + j
             for source in (0, 1) for q in range(held) for j in range(half)]  # fmt: skip
    second = [lane + half for lane in first]
    return builder.fadd(_shuffled(builder, a, b, first), _shuffled(builder, a, b, second))


def _lane_sums(builder, vectors):
    """A vector whose lane k is the sum of the lanes of vectors[k], for at most LANES vectors."""
    held = 1
    while held < LANES:
        if len(vectors) % 2:
            vectors = [*vectors, vectors[-1]]
        pairs = zip(vectors[0::2], vectors[1::2], strict=True)
        vectors = [_fold(builder, a, b, held) for a, b in pairs]
        held *= 2
    return vectors[0]


@intrinsic
def store_sums10(typing, array, index, a, b, c, d, e, f, g, h, i, j):
    """Write the sums over the lanes of ten vectors to array[index:index + 10] (16 are written)."""

    def emit(context, builder, sig, args):
        vectors = list(args[2:])
        for start in range(0, 16, LANES):
            pointer = _pointer(
                context, builder, sig.args[0], args[0],
                builder.add(args[1], ir.Constant(_i64, start)), _floats,
            )  # fmt: skip
            sums = _lane_sums(builder, vectors[start : start + LANES])
            builder.store(sums, pointer, align=4)
        return context.get_dummy_value()

    return types.void(array, types.int64, *[Vector] * 10), emit


@intrinsic
def lane_sum(typing, a):
    """The sum of all lanes (in a fixed tree order), as a float32."""

    def emit(context, builder, sig, args):
        return builder.extract_element(_lane_sums(builder, [args[0]]), ir.Constant(_i32, 0))

    return types.float32(Vector), emit


@intrinsic
def atomic_add(typing, array, index, value):
    """array[index] += value for an int32 array that several threads write."""

    def emit(context, builder, sig, args):
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        pointer = builder.gep(data, [args[1]], inbounds=True)
        builder.atomic_rmw("add", pointer, args[2], "monotonic")
        return context.get_dummy_value()

    return types.void(array, types.int64, types.int32), emit
