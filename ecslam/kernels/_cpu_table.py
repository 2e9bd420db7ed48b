"""Reading and adding to rows of the hash table for numba, eight at a time."""

from __future__ import annotations

from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.extending import intrinsic

from ._cpu_simd import FLOAT, INT, LANES, emit_pointer, emit_shuffle, f32x8

PAIR = ir.VectorType(FLOAT, 2)


def _row(context, builder, kind, table, index):
    """Pointer to a table row of two floats."""
    data = context.make_array(kind)(context, builder, table).data
    return builder.gep(builder.bitcast(data, PAIR.as_pointer()), [builder.sext(index, ir.IntType(64))])


@intrinsic
def gather(typing, table, rows, start):
    """Both floats of the rows ``rows[start : start + 8]`` of a flat table of rows of two.

    The row numbers come from memory, one load each: cheaper than taking a vector apart, which LLVM would rather do
    when it sees them being stored, hence the (free) monotonic loads.
    """

    def generate(context, builder, signature, args):
        start = context.cast(builder, args[2], signature.args[2], types.intp)
        pairs = []
        for i in range(LANES):
            at = builder.add(start, ir.Constant(start.type, i))
            index = builder.load_atomic(emit_pointer(context, builder, rows, args[1], at, INT), "monotonic", 4)
            pairs.append(builder.load(_row(context, builder, table, args[0], index), align=4))

        def join(order):
            left, right = (emit_shuffle(builder, pairs[a], pairs[b], range(4)) for a, b in (order[:2], order[2:]))
            return emit_shuffle(builder, left, right, range(8))

        low, high = join((0, 1, 4, 5)), join((2, 3, 6, 7))
        first = emit_shuffle(builder, low, high, [0, 2, 8, 10, 4, 6, 12, 14])
        second = emit_shuffle(builder, low, high, [1, 3, 9, 11, 5, 7, 13, 15])
        return context.make_tuple(builder, signature.return_type, [first, second])

    return types.UniTuple(f32x8, 2)(table, rows, start), generate


@intrinsic
def scatter_add(typing, table, rows, start, a, b):
    """Add a and b to the two floats of the rows ``rows[start : start + 8]`` of a flat table."""

    def generate(context, builder, signature, args):
        start = context.cast(builder, args[2], signature.args[2], types.intp)
        for i in range(LANES):
            at = builder.add(start, ir.Constant(start.type, i))
            index = builder.load(emit_pointer(context, builder, rows, args[1], at, INT), align=4)
            pointer = _row(context, builder, table, args[0], index)
            term = emit_shuffle(builder, args[3], args[4], [i, LANES + i])
            builder.store(builder.fadd(builder.load(pointer, align=4), term), pointer, align=4)
        return context.get_dummy_value()

    return types.void(table, rows, start, a, b), generate
