"""Reading and adding to rows of the hash table for numba, eight at a time."""

from __future__ import annotations

from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.extending import intrinsic

from ._cpu_simd import FLOAT, INT, LANES, emit_pointer, emit_shuffle, f32x16

PAIR = ir.VectorType(FLOAT, 2)


def _row(context, builder, kind, table, index):
    """Pointer to a table row of two floats."""
    data = context.make_array(kind)(context, builder, table).data
    return builder.gep(builder.bitcast(data, PAIR.as_pointer()), [builder.sext(index, ir.IntType(64))])


@intrinsic
def gather(typing, table, rows, start):
    """The rows ``rows[start : start + 8]`` of a flat table of rows of two."""

    def generate(context, builder, signature, args):
        start = context.cast(builder, args[2], signature.args[2], types.intp)
        parts = []
        for i in range(LANES):
            at = builder.add(start, ir.Constant(start.type, i))
            index = builder.load(emit_pointer(context, builder, rows, args[1], at, INT), align=4)
            parts.append(builder.load(_row(context, builder, table, args[0], index), align=4))
        while len(parts) > 1:
            width = 2 * parts[0].type.count
            parts = [emit_shuffle(builder, a, b, range(width)) for a, b in zip(parts[::2], parts[1::2], strict=True)]
        return parts[0]

    return f32x16(table, rows, start), generate


@intrinsic
def scatter_add(typing, table, rows, start, a, b):
    """Add a and b to the two floats of the rows ``rows[start :: 8]``, eight of them, of a flat table."""

    def generate(context, builder, signature, args):
        start = context.cast(builder, args[2], signature.args[2], types.intp)
        for i in range(LANES):
            at = builder.add(start, ir.Constant(start.type, LANES * i))
            index = builder.load(emit_pointer(context, builder, rows, args[1], at, INT), align=4)
            pointer = _row(context, builder, table, args[0], index)
            term = emit_shuffle(builder, args[3], args[4], [i, LANES + i])
            builder.store(builder.fadd(builder.load(pointer, align=4), term), pointer, align=4)
        return context.get_dummy_value()

    return types.void(table, rows, start, a, b), generate
