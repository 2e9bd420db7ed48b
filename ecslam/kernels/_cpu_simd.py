"""Vectors for numba: numbers of type ``f32x8``, ``i32x8`` and ``f32x16`` that jitted code can load, combine and store.

numba leaves vectorising to LLVM's heuristics; these types state it. They lower to LLVM vectors. Eight lanes are one AVX
register or two of SSE or NEON, sixteen are one of AVX-512 or two of AVX.
"""

from __future__ import annotations

import operator

from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, lower_builtin, models, register_model, type_callable

LANES = 8
FAST = ("contract", "nsz")
FLOAT, INT = ir.FloatType(), ir.IntType(32)
FLOATS, INTS, WIDE = ir.VectorType(FLOAT, LANES), ir.VectorType(INT, LANES), ir.VectorType(FLOAT, 2 * LANES)


class FloatVector(types.Type):  # type: ignore[misc]
    """Eight float32."""

    def __init__(self):
        super().__init__("f32x8")


class IntVector(types.Type):  # type: ignore[misc]
    """Eight int32."""

    def __init__(self):
        super().__init__("i32x8")


class WideVector(types.Type):  # type: ignore[misc]
    """Sixteen float32: of hidden units, or rows of two of the hash table for eight points."""

    def __init__(self):
        super().__init__("f32x16")


@register_model(FloatVector)
class _FloatModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager, kind):
        super().__init__(manager, kind, FLOATS)


@register_model(IntVector)
class _IntModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager, kind):
        super().__init__(manager, kind, INTS)


@register_model(WideVector)
class _WideModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager, kind):
        super().__init__(manager, kind, WIDE)


f32x8, i32x8, f32x16 = FloatVector(), IntVector(), WideVector()


def _operator(function, kind, emit):
    @type_callable(function)
    def type_of(context):
        return lambda a, b: kind if a == kind and b == kind else None

    @lower_builtin(function, kind, kind)
    def lower(context, builder, signature, args):
        return emit(builder, *args)


for _kind in (f32x8, f32x16):
    _operator(operator.add, _kind, lambda b, x, y: b.fadd(x, y, flags=FAST))
    _operator(operator.sub, _kind, lambda b, x, y: b.fsub(x, y, flags=FAST))
    _operator(operator.mul, _kind, lambda b, x, y: b.fmul(x, y, flags=FAST))
_operator(operator.truediv, f32x8, lambda b, x, y: b.fdiv(x, y, flags=FAST))
_operator(operator.add, i32x8, lambda b, x, y: b.add(x, y))
_operator(operator.sub, i32x8, lambda b, x, y: b.sub(x, y))
_operator(operator.mul, i32x8, lambda b, x, y: b.mul(x, y))
_operator(operator.xor, i32x8, lambda b, x, y: b.xor(x, y))
_operator(operator.and_, i32x8, lambda b, x, y: b.and_(x, y))


def emit_splat(builder, value, kind):
    one = builder.insert_element(ir.Constant(kind, ir.Undefined), value, INT(0))
    return emit_shuffle(builder, one, one, [0] * kind.count)


def emit_shuffle(builder, a, b, lanes):
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(INT, len(lanes)), list(lanes)))


def emit_pointer(context, builder, kind, array, index, element):
    data = context.make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), element.as_pointer())


def emit_call(builder, name, *args):
    vector = args[0].type
    kind = ir.FunctionType(vector, [vector] * len(args))
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"{name}.v{vector.count}f32"), args)


def _splats(number, vector):
    """How to make a vector of a number that is cast first."""

    def generate(context, builder, signature, args):
        return emit_splat(builder, context.cast(builder, args[0], signature.args[0], number), vector)

    return generate


def _loads(vector):
    """How to read a vector from an array at an index."""

    def generate(context, builder, signature, args):
        array, index = signature.args
        at = context.cast(builder, args[1], index, types.intp)
        return builder.load(emit_pointer(context, builder, array, args[0], at, vector), align=4)

    return generate


def _bits(builder, truth):
    """Eight truth values as an int64, the first the lowest bit."""
    return builder.zext(builder.bitcast(truth, ir.IntType(LANES)), ir.IntType(64))


@intrinsic
def splat(typing, value):
    """The float ``value`` in every lane."""
    return f32x8(value), _splats(types.float32, FLOATS)


@intrinsic
def splat16(typing, value):
    """The float ``value`` in every lane of sixteen."""
    return f32x16(value), _splats(types.float32, WIDE)


@intrinsic
def isplat(typing, value):
    """The integer ``value`` in every lane."""
    return i32x8(value), _splats(types.int32, INTS)


@intrinsic
def load(typing, array, index):
    """Lanes array[index : index + 8] of a contiguous one-dimensional float32 array."""
    return f32x8(array, index), _loads(FLOATS)


@intrinsic
def load16(typing, array, index):
    """Lanes array[index : index + 16] of a contiguous one-dimensional float32 array."""
    return f32x16(array, index), _loads(WIDE)


@intrinsic
def store(typing, array, index, value):
    """Write the lanes to array[index :]."""

    def generate(context, builder, signature, args):
        index = context.cast(builder, args[1], signature.args[1], types.intp)
        builder.store(args[2], emit_pointer(context, builder, array, args[0], index, args[2].type), align=4)
        return context.get_dummy_value()

    return types.void(array, index, value), generate


@intrinsic
def fma(typing, a, b, c):
    """a * b + c, never reordered (fused wherever the machine can)."""
    return f32x8(a, b, c), lambda context, builder, signature, args: emit_call(builder, "llvm.fmuladd", *args)


@intrinsic
def exact_fma(typing, a, b, c):
    """a * b + c, rounded once on every machine; slow on those without such an instruction."""
    return f32x8(a, b, c), lambda context, builder, signature, args: emit_call(builder, "llvm.fma", *args)


@intrinsic
def floor(typing, a):
    """Largest whole number not above each lane."""
    return f32x8(a), lambda context, builder, signature, args: emit_call(builder, "llvm.floor", *args)


@intrinsic
def to_int(typing, a):
    """Each lane cut to an integer."""
    return i32x8(a), lambda context, builder, signature, args: builder.fptosi(args[0], INTS)


@intrinsic
def lowest(typing, a, b):
    """Lane-wise minimum; where a is not a number, b."""

    def generate(context, builder, signature, args):
        x, y = args
        less = builder.fcmp_ordered("<", x, y) if a == f32x8 else builder.icmp_signed("<", x, y)
        return builder.select(less, x, y)

    return a(a, b), generate


@intrinsic
def highest(typing, a, b):
    """Lane-wise maximum; where a is not a number, b."""

    def generate(context, builder, signature, args):
        x, y = args
        more = builder.fcmp_ordered(">", x, y) if a == f32x8 else builder.icmp_signed(">", x, y)
        return builder.select(more, x, y)

    return a(a, b), generate


@intrinsic
def where_positive(typing, a, b):
    """b where a > 0, else 0."""

    def generate(context, builder, signature, args):
        zero = ir.Constant(args[0].type, [0.0] * args[0].type.count)
        return builder.select(builder.fcmp_ordered(">", args[0], zero), args[1], zero)

    return a(a, b), generate


@intrinsic
def power_of_two(typing, a):
    """2 ** a for whole numbers a in -126..127."""

    def generate(context, builder, signature, args):
        bias, shift = ir.Constant(INTS, [127] * LANES), ir.Constant(INTS, [23] * LANES)
        exponent = builder.add(builder.fptosi(args[0], INTS), bias)
        return builder.bitcast(builder.shl(exponent, shift), FLOATS)

    return f32x8(a), generate


@intrinsic
def twice(typing, a):
    """Each lane two times, one beside the other."""

    def generate(context, builder, signature, args):
        return emit_shuffle(builder, args[0], args[0], [i // 2 for i in range(2 * LANES)])

    return f32x16(a), generate


@intrinsic
def unzip(typing, a):
    """The first and the second of each pair of lanes."""

    def generate(context, builder, signature, args):
        parts = [emit_shuffle(builder, args[0], args[0], range(i, 2 * LANES, 2)) for i in range(2)]
        return context.make_tuple(builder, signature.return_type, parts)

    return types.UniTuple(f32x8, 2)(a), generate


@intrinsic
def fold(typing, a):
    """The first eight lanes plus the last."""

    def generate(context, builder, signature, args):
        low, high = (emit_shuffle(builder, args[0], args[0], range(i, i + LANES)) for i in (0, LANES))
        return builder.fadd(low, high, flags=FAST)

    return f32x8(a), generate


# The three butterfly stages of an 8 x 8 transpose.
STAGES = [
    ([0, 8, 2, 10, 4, 12, 6, 14], [1, 9, 3, 11, 5, 13, 7, 15], 1),
    ([0, 1, 8, 9, 4, 5, 12, 13], [2, 3, 10, 11, 6, 7, 14, 15], 2),
    ([0, 1, 2, 3, 8, 9, 10, 11], [4, 5, 6, 7, 12, 13, 14, 15], 4),
]


@intrinsic
def row_sums(typing, a, b, c, d, e, f, g, h):
    """Lane i holds the sum of the lanes of the i-th vector."""

    def generate(context, builder, signature, args):
        rows = list(args)
        for even, odd, _ in STAGES:
            pairs = zip(rows[::2], rows[1::2], strict=True)
            rows = [builder.fadd(emit_shuffle(builder, x, y, even), emit_shuffle(builder, x, y, odd)) for x, y in pairs]
        return rows[0]

    return f32x8(a, b, c, d, e, f, g, h), generate


@intrinsic
def transpose(typing, source, at, stride, target, to, pitch):
    """target[to + j * pitch + i] = source[at + i * stride + j] for i, j in 0..7."""

    def generate(context, builder, signature, args):
        kinds = signature.args
        at, stride, to, pitch = (context.cast(builder, args[i], kinds[i], types.intp) for i in (1, 2, 4, 5))

        def place(kind, array, start, step, i):
            index = builder.add(start, builder.mul(step, ir.Constant(step.type, i)))
            return emit_pointer(context, builder, kind, array, index, FLOATS)

        rows = [builder.load(place(source, args[0], at, stride, i), align=4) for i in range(LANES)]
        for even, odd, step in STAGES:
            new = list(rows)
            for i in (i for i in range(LANES) if not i & step):
                new[i] = emit_shuffle(builder, rows[i], rows[i + step], even)
                new[i + step] = emit_shuffle(builder, rows[i], rows[i + step], odd)
            rows = new
        for i in range(LANES):
            builder.store(rows[i], place(target, args[3], to, pitch, i), align=4)
        return context.get_dummy_value()

    return types.void(source, at, stride, target, to, pitch), generate


@intrinsic
def slide(typing, before, a):
    """The last lane of ``before``, then the first seven of a."""
    lanes = range(LANES - 1, 2 * LANES - 1)
    return a(before, a), lambda context, builder, signature, args: emit_shuffle(builder, args[0], args[1], lanes)


@intrinsic
def same_bits(typing, a, b):
    """Bit i is set where lane i of two integer vectors is equal."""

    def generate(context, builder, signature, args):
        return _bits(builder, builder.icmp_signed("==", *args))

    return types.int64(a, b), generate


@intrinsic
def zero_bits(typing, a):
    """Bit i is set where lane i is zero."""

    def generate(context, builder, signature, args):
        return _bits(builder, builder.fcmp_ordered("==", args[0], ir.Constant(FLOATS, [0.0] * LANES)))

    return types.int64(a), generate


@intrinsic
def lanes(typing, a, b, c, d, e, f, g, h):
    """The vector of eight given floats."""

    def generate(context, builder, signature, args):
        values = [context.cast(builder, v, k, types.float32) for v, k in zip(args, signature.args, strict=True)]
        vector = ir.Constant(FLOATS, ir.Undefined)
        for i, value in enumerate(values):
            vector = builder.insert_element(vector, value, INT(i))
        return vector

    return f32x8(a, b, c, d, e, f, g, h), generate


@intrinsic
def fetch_add(typing, array, index):
    """Take a number: array[index] += 1 (int64), atomically; the old value."""

    def generate(context, builder, signature, args):
        index = context.cast(builder, args[1], signature.args[1], types.intp)
        pointer = emit_pointer(context, builder, array, args[0], index, ir.IntType(64))
        return builder.atomic_rmw("add", pointer, ir.IntType(64)(1), "monotonic")

    return types.int64(array, index), generate
