"""Register tiles of matrix products for numba, in vectors as wide as this machine's."""

from __future__ import annotations

from llvmlite import binding, ir  # type: ignore[import-untyped]
from numba import config, types
from numba.core import cgutils
from numba.extending import intrinsic

from ._cpu_simd import FLOAT, emit_call, emit_pointer, emit_splat


def _has(feature):
    """Whether code is compiled for a processor with ``feature``."""
    if config.CPU_FEATURES is not None:
        return f"+{feature}" in config.CPU_FEATURES.split(",")
    return binding.get_host_cpu_features().get(feature, False)


# Sums fill the registers: 8 of AVX2's 16, 16 of AVX-512's 32.
LANES, ROWS, VECTORS = (16, 8, 2) if _has("avx512f") else (8, 4, 2)
COLUMNS = VECTORS * LANES
FLOATS = ir.VectorType(FLOAT, LANES)
ZERO = ir.Constant(FLOATS, [0.0] * LANES)


def make_tile(accumulate, relu):
    """A register tile of a matrix product: C[ROWS, COLUMNS] (+)= A[ROWS, n] @ B[n, COLUMNS], perhaps clipped at 0.

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

            def vector(j):
                return ir.Constant(n.type, LANES * j)

            places = [
                at(c, args[0], FLOATS, builder.add(c0, vector(j)), cr, i) for i in range(ROWS) for j in range(VECTORS)
            ]
            sums = [cgutils.alloca_once(builder, FLOATS) for _ in places]
            for place, total in zip(places, sums, strict=True):
                builder.store(builder.load(place, align=4) if accumulate else ZERO, total)
            with cgutils.for_range(builder, n) as loop:
                k = loop.index
                right = [
                    builder.load(at(b, args[7], FLOATS, builder.add(b0, vector(j)), bk, k), align=4)
                    for j in range(VECTORS)
                ]
                for i in range(ROWS):
                    left = emit_splat(builder, builder.load(at(a, args[3], FLOAT, a0, ar, i, ak, k)), FLOATS)
                    for j in range(VECTORS):
                        total = sums[i * VECTORS + j]
                        builder.store(emit_call(builder, "llvm.fmuladd", left, right[j], builder.load(total)), total)
            for place, total in zip(places, sums, strict=True):
                value = builder.load(total)
                if relu:
                    value = builder.select(builder.fcmp_ordered(">", value, ZERO), value, ZERO)
                builder.store(value, place, align=4)
            return context.get_dummy_value()

        return types.void(c, c0, cr, a, a0, ar, ak, b, b0, bk, n), generate

    return tile
