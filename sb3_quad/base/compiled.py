"""The decorator of all compiled functions, where compiled code is kept, and atomic operations,
which numba lacks.
"""

import functools
import hashlib
import re
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numba
from numba import types
from numba.core import event
from numba.core.caching import IndexDataCacheFile
from numba.core.registry import CPUDispatcher
from numba.extending import intrinsic

from sb3_quad.base.process import print_once
from sb3_quad.base.wide_vectors import WideCompiler

# Rows of a block: a multiple of every vector width, and few enough for a block to stay in the L1
# cache
LANES = 64
# An import of this package at the top of a file
_IMPORT = re.compile(rb"^from (sb3_quad[\w.]*) import", re.MULTILINE)


def compiled(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """Compile with ``numba.njit`` without the GIL, and keep the result in a cache that notices a
    change in the function's module, or in a module of this package that it imports.

    Numba itself looks only at the file of the function, but the code of functions from other files
    is compiled in. Every call is inlined, unless you say otherwise: a cached and a freshly compiled
    copy may round differently under ``fastmath``.
    """
    if function is None:
        return functools.partial(compiled, **options)
    options = {"forceinline": True, "no_cfunc_wrapper": True, **options}
    dispatcher = numba.njit(
        error_model="numpy", nogil=True, pipeline_class=WideCompiler, **options
    )(function)
    if "no_cpython_wrapper" in options:
        dispatcher.__class__ = _Inner
    try:
        dispatcher.enable_caching()
    except RuntimeError:
        # Neither the package's folder nor the user's cache folder is writable.
        print_once(
            "compiled code cannot be cached and is compiled at every start, for a minute or so;"
            " set NUMBA_CACHE_DIR to a folder"
        )
        _Notice.kept = ""
    else:
        cache_file = dispatcher._cache._cache_file
        cache_file._source_stamp = _source_stamp(function.__module__)
        cache_file.__class__ = _CacheFile
    return dispatcher


class _Inner(CPUDispatcher):
    """A function that Python cannot call: without what that needs, it compiles in half the time."""

    def __call__(self, *arguments: Any) -> Any:
        raise TypeError(f"{self.__name__}: only compiled functions can call it")


class _CacheFile(IndexDataCacheFile):
    """Treats files that a crash or a full disk left broken as missing."""

    def _load_index(self) -> Any:
        with suppress(Exception):
            return super()._load_index()
        return {}

    def load(self, key: Any) -> Any:
        with suppress(Exception):
            return super().load(key)


@functools.cache
def _source_stamp(module: str) -> str:
    """Return a digest of the sources of a module and of all in this package that it imports. It is
    the same for a copy of the package elsewhere.
    """
    digest = hashlib.sha256()
    seen = [module]
    for name in seen:
        source, imports = _read(name)
        digest.update(source)
        seen += [name for name in imports if name not in seen]
    return digest.hexdigest()


@functools.cache
def _read(module: str) -> tuple[bytes, list[str]]:
    """Return the source of an imported module, and what it imports of this package at its top."""
    source = Path(sys.modules[module].__file__ or "").read_bytes()
    return source, [name.decode() for name in _IMPORT.findall(source)]


inner = compiled(no_cpython_wrapper=True)
"""Compile a function that only compiled functions call."""
fast = inner(fastmath=True)
"""Compile such a function whose sums may be reordered, which vectorises its loops over lanes."""
called = inner(forceinline=False)
"""Compile such a function without putting its code into every caller, which takes long to compile.
"""
inlined = compiled(inline="always")
"""Compile a function that numba inlines, with the options of its caller."""


class _Notice(event.Listener):
    """Says when the outermost function begins to compile, and how long it took."""

    kept = "; it is kept for later runs"

    def __init__(self) -> None:
        self._depth = 0
        self._start = 0.0

    def on_start(self, event: event.Event) -> None:
        if self._depth == 0:
            self._start = time.perf_counter()
            print_once(f"compiling once, a minute or so if a core is idle{self.kept}")
        self._depth += 1

    def on_end(self, event: event.Event) -> None:
        self._depth -= 1
        if self._depth == 0:
            print_once(f"compiled in {time.perf_counter() - self._start:.0f} s")


def compile_notice() -> Any:
    """Return a context for a call that may compile, which then prints what takes so long."""
    return event.install_listener("numba:compile", _Notice())


@intrinsic
def atomic_add(typing_context: Any, array: Any, index: Any, value: Any) -> Any:
    """Add to a number of an int64 array that other threads change as well; return the number
    before.
    """

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        return builder.atomic_rmw("add", builder.gep(data, [args[1]]), args[2], "seq_cst")

    return types.int64(array, types.int64, types.int64), codegen


# The operating system's function by which a thread yields its core.
_YIELD = "SwitchToThread" if sys.platform == "win32" else "sched_yield"
give_way = types.ExternalFunction(_YIELD, types.int32())
"""Yield the core. It is resolved by its symbol name, so cached code works in any process."""
