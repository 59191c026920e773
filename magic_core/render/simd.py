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


def broadcast(builder, scalar, vector_type):
    """IR of a vector that holds `scalar` in every lane."""
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
        return broadcast(builder, args[0], _floats)

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
def trailing_zeros(typing, word):
    """The number of the lowest set bit of a non-zero uint32 or uint64."""
    width = word.bitwidth

    def emit(context, builder, sig, args):
        undefined_at_zero = ir.Constant(_i1, 1)
        count = _llvm(builder, f"llvm.cttz.i{width}", ir.IntType(width), args[0], undefined_at_zero)
        return builder.zext(count, _i64) if width < 64 else count

    return types.int64(word), emit


@intrinsic
def float_bits(typing, value):
    """The bit pattern of a float32 (ordered like the number itself when it is positive)."""

    def emit(context, builder, sig, args):
        return builder.bitcast(args[0], _i32)

    return types.uint32(types.float32), emit


# --- sums --------------------------------------------------------------------------------------


def shuffled(builder, a, b, lanes):
    """IR of the named lanes of two vectors, those of b counted on from those of a."""
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(_i32, len(lanes)), lanes))


def _fold(builder, a, b, held):
    """Halve the partial sums of two vectors that hold `held` quantities each, and join them.

    Quantity q has its partial sums in lanes q * LANES / held and on. The result holds the
    quantities of a, then those of b, with half as many partial sums each.
    """
    step, half = LANES // held, LANES // held // 2
    first = [source * LANES + q * step + j
             for source in (0, 1) for q in range(held) for j in range(half)]  # fmt: skip
    second = [lane + half for lane in first]
    return builder.fadd(shuffled(builder, a, b, first), shuffled(builder, a, b, second))


def lane_sums(builder, vectors):
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
def lane_sum(typing, a):
    """The sum of all lanes (in a fixed tree order), as a float32."""

    def emit(context, builder, sig, args):
        return builder.extract_element(lane_sums(builder, [args[0]]), ir.Constant(_i32, 0))

    return types.float32(Vector), emit
