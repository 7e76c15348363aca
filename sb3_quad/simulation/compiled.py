"""What compiled code here needs beyond numba's own: pointers, atomic numbers, and a decorator.

A block (:mod:`.block`) is reached through one pointer, and every array in it has a constant shape and place. LLVM then knows
each distance between two rows, needs no test for overlap, and vectorises the loops over lanes.
"""

import functools
import hashlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from sb3_quad.simulation.cache import Cache, tell_unkept

LANES = 64  # rows of a block; a multiple of every vector width, small enough for a block to stay in the first cache


def compiled(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """``numba.njit`` with a cache that notices a change in any of this package's compiled modules.

    Numba looks only at the file of the function itself, but keeps what it calls, from other files, compiled in. All calls are
    inlined, whatever LLVM thinks of it: a function left to be called would in the process that compiles be another copy of
    it than in one that loads its caller from the cache, and two copies can round differently under ``fastmath``.
    """
    if function is None:
        return lambda inner: compiled(inner, **options)
    dispatcher = numba.njit(error_model="numpy", nogil=True, forceinline=True, **options)(function)
    try:
        dispatcher._cache = Cache(function, _source_stamp())
    except RuntimeError:
        tell_unkept("no folder for it can be written")
    return dispatcher


@functools.cache
def _source_stamp() -> str:
    """A digest of what is compiled in: the same for copies of it, such as those that a cluster's nodes are sent."""
    package, digest = Path(__file__).resolve().parents[1], hashlib.sha256()
    for folder in ("base", "vehicles", "simulation", "experts", "algorithms/networks"):
        for path in sorted((package / folder).rglob("*.py")):
            digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


@intrinsic
def pointer(typing_context: Any, address: Any) -> Any:
    """A pointer from an address (int64)."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.inttoptr(args[0], ir.PointerType(ir.IntType(8)))

    return types.voidptr(types.int64), codegen


def _atomic(operation: str) -> Any:
    @intrinsic
    def change(typing_context: Any, array: Any, index: Any, value: Any) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            data = context.make_array(signature.args[0])(context, builder, args[0]).data
            return builder.atomic_rmw(operation, builder.gep(data, [args[1]]), args[2], "seq_cst")

        return types.int64(array, types.int64, types.int64), codegen

    return change


atomic_add = _atomic("add")  # (array, index, value): adds to one number of an int64 array and gives the number before
atomic_set = _atomic("xchg")  # likewise, sets it


@intrinsic
def atomic_get(typing_context: Any, array: Any, index: Any) -> Any:
    """One number of an int64 array that other threads write."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        return builder.load_atomic(builder.gep(data, [args[1]]), "seq_cst", 8, typ=ir.IntType(64))

    return types.int64(array, types.int64), codegen


give_way = types.ExternalFunction("SwitchToThread" if sys.platform == "win32" else "sched_yield", types.int32())
"""Let another thread have this core; the operating system's, found by its name wherever the code was compiled."""
