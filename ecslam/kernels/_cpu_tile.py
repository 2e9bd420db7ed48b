"""Register tiles of matrix products for numba, in the vectors of ``_cpu_simd``."""

from __future__ import annotations

from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from ._cpu_simd import FLOAT, FLOATS, LANES, emit_call, emit_pointer, emit_splat


def make_tile(rows, columns, accumulate, relu):
    """A register tile of a matrix product: C[rows, 8 columns] (+)= A[rows, n] @ B[n, 8 columns], perhaps clipped at 0.

    The jitted function takes (C, start, row stride, A, start, row stride, term stride, B, start, row stride, n), all
    arrays flat float32. One such tile serves the forward pass and both backward passes of the first layer.
    """

    @intrinsic
    def tile(typing, c, c0, cr, a, a0, ar, ak, b, b0, bk, n):
        def generate(context, builder, signature, args):
            numbers = [context.cast(builder, args[i], signature.args[i], types.intp) for i in (1, 2, 4, 5, 6, 8, 9, 10)]
            c0, cr, a0, ar, ak, b0, bk, n = numbers

            def at(kind, array, element, *terms):
                index = terms[0]
                for step, count in zip(terms[1::2], terms[2::2], strict=True):
                    factor = count if isinstance(count, ir.Value) else ir.Constant(step.type, count)
                    index = builder.add(index, builder.mul(step, factor))
                return emit_pointer(context, builder, kind, array, index, element)

            places = [
                at(c, args[0], FLOATS, builder.add(c0, ir.Constant(n.type, LANES * j)), cr, i)
                for i in range(rows)
                for j in range(columns)
            ]
            sums = [cgutils.alloca_once(builder, FLOATS) for _ in places]
            for place, total in zip(places, sums, strict=True):
                start = builder.load(place, align=4) if accumulate else ir.Constant(FLOATS, [0.0] * LANES)
                builder.store(start, total)
            with cgutils.for_range(builder, n) as loop:
                k = loop.index
                right = [
                    builder.load(
                        at(b, args[7], FLOATS, builder.add(b0, ir.Constant(n.type, LANES * j)), bk, k), align=4
                    )
                    for j in range(columns)
                ]
                for i in range(rows):
                    value = builder.load(at(a, args[3], FLOAT, a0, ar, i, ak, k))
                    left = emit_splat(builder, value, FLOATS)
                    for j in range(columns):
                        total = sums[i * columns + j]
                        builder.store(emit_call(builder, "llvm.fmuladd", left, right[j], builder.load(total)), total)
            zero = ir.Constant(FLOATS, [0.0] * LANES)
            for place, total in zip(places, sums, strict=True):
                value = builder.load(total)
                if relu:
                    value = builder.select(builder.fcmp_ordered(">", value, zero), value, zero)
                builder.store(value, place, align=4)
            return context.get_dummy_value()

        return types.void(c, c0, cr, a, a0, ar, ak, b, b0, bk, n), generate

    return tile
