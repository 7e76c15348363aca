"""Products of matrices, tile by tile: the sums of a tile stay in registers, which numba's own loops
do not achieve.
"""

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

HEIGHT, WIDTH = 4, 16
"""Size of a tile: eight registers of 256 bits, so that eight more are left for factors."""
_VECTOR = ir.VectorType(ir.FloatType(), WIDTH)
_FIRST = ir.IntType(32)(0)
_ALL_THE_FIRST = ir.Constant(ir.VectorType(_FIRST.type, WIDTH), [0] * WIDTH)
_FUSED = {"flags": ("contract",)}


@intrinsic
def add_to_tile(
    typing_context: Any, w: Any, x: Any, h: Any, j: Any, i: Any, first: Any, last: Any
) -> Any:
    """Add ``w[:, first:last] @ x[first:last]`` to the tile of ``h`` that begins at row j, column i.

    All are float32 matrices, and neighbouring columns of x and h are neighbours in memory. If
    ``first`` is 0, the product replaces what was there.
    """
    signature = types.void(w, x, h, *[types.intp] * 4)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kinds = signature.args
        arrays = [context.make_array(kinds[k])(context, builder, arguments[k]) for k in range(3)]
        j, i, first, last = arguments[3:]

        def place(k: int, row: Any, column: Any) -> Any:
            inside = [row, column]
            return cgutils.get_item_pointer(context, builder, kinds[k], arrays[k], inside)

        def vector(k: int, row: Any) -> Any:
            return builder.bitcast(place(k, row, i), _VECTOR.as_pointer())

        rows = [builder.add(j, j.type(row)) for row in range(HEIGHT)]
        begins = builder.icmp_signed("==", first, first.type(0))
        sums = []
        for row in rows:
            before = builder.load(vector(2, row), align=4)
            before = builder.select(begins, _VECTOR([0.0] * WIDTH), before)
            sums.append(cgutils.alloca_once_value(builder, before))
        with cgutils.for_range_slice(builder, first, last, first.type(1)) as (k, _):
            factor = builder.load(vector(1, k), align=4)
            for row, total in zip(rows, sums, strict=True):
                empty = _VECTOR(ir.Undefined)
                weight = builder.insert_element(empty, builder.load(place(0, row, k)), _FIRST)
                weights = builder.shuffle_vector(weight, empty, _ALL_THE_FIRST)
                product = builder.fmul(weights, factor, **_FUSED)
                builder.store(builder.fadd(builder.load(total), product, **_FUSED), total)
        for row, total in zip(rows, sums, strict=True):
            builder.store(builder.load(total), vector(2, row), align=4)
        return context.get_dummy_value()

    return signature, generate
