"""The decorator of all compiled functions, where compiled code is kept, and atomic operations,
which numba lacks.
"""

import functools
import hashlib
import importlib
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numba
from numba import types
from numba.core import event
from numba.core.caching import IndexDataCacheFile
from numba.extending import intrinsic

from sb3_quad.base.process import print_once

# Rows of a block: a multiple of every vector width, and few enough for a block to stay in the L1
# cache
LANES = 64
# What a file contains that compiles functions by this module
_IMPORT = b"from sb3_quad.base.compiled import"


def compiled(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """Compile with ``numba.njit`` without the GIL, and keep the result in a cache that notices a
    change in any module of a folder with compiled functions.

    Numba itself looks only at the file of the function, but the code of functions from other files
    is compiled in. Every call is inlined: otherwise a cached and a freshly compiled copy may round
    differently under ``fastmath``.
    """
    if function is None:
        return functools.partial(compiled, **options)
    dispatcher = numba.njit(error_model="numpy", nogil=True, forceinline=True, **options)(function)
    try:
        dispatcher.enable_caching()
    except RuntimeError:
        # Neither the package's folder nor the user's cache folder is writable.
        print_once(
            "compiled code cannot be cached and is compiled at every start, in 15 s or more;"
            " set NUMBA_CACHE_DIR to a folder"
        )
        _Notice.kept = ""
    else:
        cache_file = dispatcher._cache._cache_file
        cache_file._source_stamp = _source_stamp()
        cache_file.__class__ = _CacheFile
    return dispatcher


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
def _source_stamp() -> str:
    """Return a digest of the sources. It is the same for a copy of the package elsewhere."""
    digest = hashlib.sha256()
    for folder in _compiled_folders():
        for path in sorted(folder.glob("*.py")):
            digest.update(path.name.encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()


def _compiled_folders() -> list[Path]:
    """Return the folders of this package in which files compile functions."""
    # Compiled code reads the names of a vehicle's parameters.
    folders = {Path(root) for root in importlib.import_module("sb3_quad.envs.vehicles").__path__}
    for name in ("sb3_quad", "sb3_quad.envs"):
        for root in importlib.import_module(name).__path__:
            files = Path(root).rglob("*.py")
            folders.update(path.parent for path in files if _IMPORT in path.read_bytes())
    # By name: a checkout's envs/ lies beside sb3_quad/, and an installed one in it.
    return sorted(folders, key=lambda folder: folder.name)


fast = compiled(fastmath=True)
"""Compile a function whose sums may be reordered, which vectorises its loops over lanes."""
inlined = compiled(inline="always")
"""Compile a function that numba inlines, with the options of its caller."""


class _Notice(event.Listener):
    kept = "; it is kept for later runs"

    def on_start(self, event: event.Event) -> None:
        print_once(f"compiling the simulation once, in 15 s or more{self.kept}")

    def on_end(self, event: event.Event) -> None:
        pass


def compile_notice() -> Any:
    """Return a context for a call that may compile, which then prints a line on stderr."""
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
