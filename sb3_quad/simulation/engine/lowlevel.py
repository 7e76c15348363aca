"""What compiled code here needs beyond numba's own: pointers, bit casts, atomic counters, and a decorator.

The block functions take one pointer to scratch memory and cut arrays of constant shape out of it. LLVM then knows every
distance between two rows, needs no test for overlap, and vectorises the loops over lanes.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba import carray, types
from numba.extending import intrinsic

import sb3_quad

LANES = 64  # rows of a block; a multiple of every vector width, small enough for a block to stay in the first cache


def compiled(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """``numba.njit`` with a cache that notices a change in any of this package's compiled modules.

    Numba looks only at the file of the function itself, but holds what it calls, from other files, compiled in.
    """
    if function is None:
        return lambda inner: compiled(inner, **options)
    dispatcher = numba.njit(cache=True, error_model="numpy", nogil=True, **options)(function)
    with contextlib.suppress(AttributeError):  # another version of numba: its own rule then holds
        dispatcher._cache._cache_file._source_stamp = _source_stamp()
    return dispatcher


def _source_stamp() -> tuple[tuple[str, float, int], ...]:
    names = ("simulation/*.py", "simulation/engine/*.py", "vehicles/*.py")
    files = sorted(path for root in sb3_quad.__path__ for name in names for path in Path(root).glob(name))
    return tuple((path.name, os.stat(path).st_mtime, os.stat(path).st_size) for path in files)


@intrinsic
def pointer(typing_context: Any, address: Any) -> Any:
    """A pointer from an address (int64)."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.inttoptr(args[0], ir.PointerType(ir.IntType(8)))

    return types.voidptr(types.int64), codegen


@intrinsic
def shifted(typing_context: Any, base: Any, count: Any) -> Any:
    """A pointer ``count`` bytes behind another."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.gep(args[0], [args[1]], source_etype=ir.IntType(8))

    return types.voidptr(types.voidptr, types.int64), codegen


@intrinsic
def as_float32(typing_context: Any, bits: Any) -> Any:
    """The float32 of 32 bits."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.bitcast(args[0], ir.FloatType())

    return types.float32(types.int32), codegen


@intrinsic
def as_int32(typing_context: Any, value: Any) -> Any:
    """The 32 bits of a float32."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.bitcast(args[0], ir.IntType(32))

    return types.int32(types.float32), codegen


@intrinsic
def atomic_add(typing_context: Any, array: Any, index: Any, value: Any) -> Any:
    """Add to one number of an int64 array; the number before."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        return builder.atomic_rmw("add", builder.gep(data, [args[1]]), args[2], "seq_cst")

    return types.int64(array, types.int64, types.int64), codegen


@intrinsic
def atomic_set(typing_context: Any, array: Any, index: Any, value: Any) -> Any:
    """Set one number of an int64 array; the number before."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        return builder.atomic_rmw("xchg", builder.gep(data, [args[1]]), args[2], "seq_cst")

    return types.int64(array, types.int64, types.int64), codegen


@intrinsic
def atomic_get(typing_context: Any, array: Any, index: Any) -> Any:
    """One number of an int64 array that other threads write."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        return builder.load_atomic(builder.gep(data, [args[1]]), "seq_cst", 8, typ=ir.IntType(64))

    return types.int64(array, types.int64), codegen


FLOAT64_ROWS = 88  # dynamics/blocks.py says which row holds what
FLOAT32_ROWS = 80
UINT32_ROWS = 24
_FLOAT32_START = FLOAT64_ROWS * LANES * 8
_UINT32_START = _FLOAT32_START + FLOAT32_ROWS * LANES * 4
SCRATCH_SIZE = (_UINT32_START + UINT32_ROWS * LANES * 4) // 8  # in float64


@compiled
def scratch_pointer(scratch):
    """The first address of a scratch array at a cache line; the array holds ``SCRATCH_SIZE + 8`` float64."""
    return pointer((scratch.ctypes.data + 63) // 64 * 64)


@compiled(forceinline=True)
def float64_rows(scratch):
    """The float64 rows of scratch memory, (FLOAT64_ROWS, LANES)."""
    return carray(scratch, (FLOAT64_ROWS, LANES), np.float64)


@compiled(forceinline=True)
def float32_rows(scratch):
    """The float32 rows of scratch memory, (FLOAT32_ROWS, LANES)."""
    return carray(shifted(scratch, _FLOAT32_START), (FLOAT32_ROWS, LANES), np.float32)


@compiled(forceinline=True)
def uint32_rows(scratch):
    """The uint32 rows of scratch memory, (UINT32_ROWS, LANES)."""
    return carray(shifted(scratch, _UINT32_START), (UINT32_ROWS, LANES), np.uint32)
