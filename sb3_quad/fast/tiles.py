"""Products of matrices, tile by tile: the sums of a tile stay in registers, which numba's own loops
do not achieve.
"""

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.registry import cpu_target
from numba.extending import intrinsic

from sb3_quad.base.compiled import inner

HEIGHT = 4
"""Rows of a tile; matrices have a multiple of it as rows and as columns."""
_, _, _FEATURES = cpu_target.target_context.codegen().magic_tuple()
# Columns of a tile whose sums fill eight registers of 256 bits, and of the processor's widest
_MEDIUM = 16
_WIDE = 32 if "+avx512f" in _FEATURES else _MEDIUM
# Terms of a sum in one go, so that what a column of tiles reads stays in the L1 cache
_TERMS = 256
_FIRST = ir.IntType(32)(0)
_FUSED = {"flags": ("contract",)}


def _tile(width: int, chains: int) -> Any:
    """Return a compiled function for tiles of ``width`` columns.

    A processor is busy with eight registers of sums at a time, and has eight more for factors. A
    narrower tile has ``chains`` sums for each number, which are added up in the end.
    """
    vector_type = ir.VectorType(ir.FloatType(), width)
    all_the_first = ir.Constant(ir.VectorType(_FIRST.type, width), [0] * width)

    @intrinsic
    def add_to_tile(
        typing_context: Any,
        a: Any,
        b: Any,
        c: Any,
        j: Any,
        i: Any,
        first: Any,
        last: Any,
        adds: Any,
    ) -> Any:
        """Add ``a[:, first:last] @ b[first:last]`` to the tile of ``c`` that begins at row j,
        column i, or write it there unless ``adds``.
        """
        signature = types.void(a, b, c, *[types.intp] * 4, types.boolean)

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            kinds = signature.args
            arrays = [
                context.make_array(kinds[k])(context, builder, arguments[k]) for k in range(3)
            ]
            j, i, first, last, adds = arguments[3:]

            def place(k: int, row: Any, column: Any) -> Any:
                inside = [row, column]
                return cgutils.get_item_pointer(context, builder, kinds[k], arrays[k], inside)

            def vector(k: int, row: Any) -> Any:
                return builder.bitcast(place(k, row, i), vector_type.as_pointer())

            rows = [builder.add(j, j.type(row)) for row in range(HEIGHT)]
            zero = vector_type([0.0] * width)
            sums = [[cgutils.alloca_once_value(builder, zero) for _ in rows] for _ in range(chains)]
            with cgutils.for_range_slice(builder, first, last, first.type(chains)) as (start, _):
                for chain, totals in enumerate(sums):
                    k = builder.add(start, start.type(chain))
                    factor = builder.load(vector(1, k), align=4)
                    for row, total in zip(rows, totals, strict=True):
                        empty = vector_type(ir.Undefined)
                        number = builder.load(place(0, row, k))
                        number = builder.insert_element(empty, number, _FIRST)
                        numbers = builder.shuffle_vector(number, empty, all_the_first)
                        product = builder.fmul(numbers, factor, **_FUSED)
                        builder.store(builder.fadd(builder.load(total), product, **_FUSED), total)
            for row, *totals in zip(rows, *sums, strict=True):
                before = builder.load(vector(2, row), align=4)
                result = builder.select(adds, before, zero)
                for total in totals:
                    result = builder.fadd(result, builder.load(total))
                builder.store(result, vector(2, row), align=4)
            return context.get_dummy_value()

        return signature, generate

    return add_to_tile


def padded(size: int) -> int:
    """Return the least multiple of ``HEIGHT`` that is not below ``size``."""
    return -(-size // HEIGHT) * HEIGHT


_add_to_wide = _tile(_WIDE, 1)
_add_to_medium = _tile(_MEDIUM, 1)
_add_to_narrow = _tile(HEIGHT, 2)


@inner
def multiply(a, b, c, adds):
    """c = a b, or c += a b if ``adds``; float32 matrices.

    Neighbouring columns of b and c are neighbours in memory.
    """
    rows = a.shape[0]
    columns = b.shape[1]
    wide = columns // _WIDE * _WIDE
    medium = columns // _MEDIUM * _MEDIUM
    for first in range(0, b.shape[0], _TERMS):
        last = min(b.shape[0], first + _TERMS)
        adds_here = adds or first > 0
        for i in range(0, wide, _WIDE):
            for j in range(0, rows, HEIGHT):
                _add_to_wide(a, b, c, j, i, first, last, adds_here)
        for i in range(wide, medium, _MEDIUM):
            for j in range(0, rows, HEIGHT):
                _add_to_medium(a, b, c, j, i, first, last, adds_here)
        for i in range(medium, columns, HEIGHT):
            for j in range(0, rows, HEIGHT):
                _add_to_narrow(a, b, c, j, i, first, last, adds_here)
