"""Moving `Vector`s between registers and arrays: loads, stores, blocks of pixels, atomic counters.

Arrays are flat. Offsets are counted in elements; nothing is checked, and no alignment is asked.
"""

from __future__ import annotations

from llvmlite import ir
from numba import types
from numba.core import cgutils

from magic_core.render.lanes import LANES
from magic_core.render.simd import Vector, broadcast, intrinsic, lane_sums, shuffled

_f32, _i32, _i64 = ir.FloatType(), ir.IntType(32), ir.IntType(64)
_floats, _ints = ir.VectorType(_f32, LANES), ir.VectorType(_i32, LANES)
_bools = ir.VectorType(ir.IntType(1), LANES)


def _pointer(context, builder, array_type, array, index, pointee):
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index], inbounds=True), pointee.as_pointer())


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
                shuffled(builder, loaded, loaded, [count * lane + k for lane in range(LANES)])
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
            shuffled(builder, a, b, list(range(width)))
            for a, b in zip(vectors[0::2], vectors[1::2], strict=True)
        ]
    return vectors[0]


def _store_interleaved(context, builder, sig, args):
    """The inverse of the interleaved load: args = (array, index, stream, stream, ...)."""
    streams = list(args[2:])
    count = len(streams)
    joined = _concatenated(builder, streams + [streams[-1]] * (4 - count))
    order = [LANES * k + lane for lane in range(LANES) for k in range(count)]
    flat = shuffled(builder, joined, joined, order)
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
            builder.store(shuffled(builder, args[3], args[3], lanes), pointer, align=4)
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
def claim(typing, counter, step):
    """Atomically add `step` to counter[0] and return its old value: a thread's next piece."""

    def emit(context, builder, sig, args):
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        return builder.atomic_rmw("add", data, args[1], "monotonic")

    return types.int64(counter, types.int64), emit


@intrinsic
def column_bits(typing, words, index, bit):
    """Bit `bit` of the LANES uint32 words from `index` on, gathered into one integer."""

    def emit(context, builder, sig, args):
        pointer = _pointer(context, builder, sig.args[0], args[0], args[1], _ints)
        loaded = builder.load(pointer, align=4)
        one_bit = builder.shl(ir.Constant(_i32, 1), args[2])
        picked = builder.and_(loaded, broadcast(builder, one_bit, _ints))
        is_set = builder.icmp_unsigned("!=", picked, ir.Constant(_ints, [0] * LANES))
        return builder.zext(builder.bitcast(is_set, ir.IntType(LANES)), _i32)

    return types.uint32(words, types.int64, types.uint32), emit


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
            sums = lane_sums(builder, vectors[start : start + LANES])
            builder.store(sums, pointer, align=4)
        return context.get_dummy_value()

    return types.void(array, types.int64, *[Vector] * 10), emit


@intrinsic
def atomic_add(typing, array, index, value):
    """array[index] += value for an int32 array that several threads write."""

    def emit(context, builder, sig, args):
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        pointer = builder.gep(data, [args[1]], inbounds=True)
        builder.atomic_rmw("add", pointer, args[2], "monotonic")
        return context.get_dummy_value()

    return types.void(array, types.int64, types.int32), emit
