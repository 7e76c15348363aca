"""The decorator of all compiled functions, where compiled code is kept, and atomic operations, which numba lacks."""

import fcntl
import functools
import hashlib
import os
import pickle
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import numba
from numba import types
from numba.core import event
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.extending import intrinsic

LANES = 64  # rows of a block; a multiple of every vector width, small enough for a block to stay in the first cache
_COMPILED_IN = ("simulation", "vehicles", "experts", "algorithms/networks")
_DIGEST = hashlib.sha256().digest_size


def compiled(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """``numba.njit`` that releases the GIL, with a cache that notices a change in any module of ``_COMPILED_IN``.

    Numba itself looks only at the file of the function, but code called from other files is compiled in, too. Every call is
    inlined. Otherwise a cached and a freshly compiled copy may round differently under ``fastmath``.
    """
    if function is None:
        return lambda inner: compiled(inner, **options)
    dispatcher = numba.njit(error_model="numpy", nogil=True, forceinline=True, **options)(function)
    try:
        dispatcher._cache = _Cache(function)
    except RuntimeError:
        _tell_unkept("no folder for it can be written")
    return dispatcher


@functools.cache
def _source_stamp() -> str:
    """A digest of the sources; the same in a copy of the package elsewhere."""
    package, digest = Path(__file__).resolve().parents[1], hashlib.sha256()
    for folder in _COMPILED_IN:
        for path in sorted((package / folder).glob("*.py")):
            digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


@functools.cache
def _tell(line: str) -> None:
    """Say a line on stderr, once."""
    sys.stderr.write(f"sb3_quad: {line}\n")


def _tell_unkept(why: str) -> None:
    _tell(f"compiled code cannot be kept ({why}) and is made at every start, in about 15 s; set NUMBA_CACHE_DIR to a folder")


class _Cache(FunctionCache):
    """Numba's cache of a function, compiled again where a source has changed or a file is damaged.

    :raises RuntimeError: neither the package's folder nor the user's folder for caches can be written.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        self._cache_file = _File(self._cache_path, self._impl.filename_base, _source_stamp())

    def load_overload(self, signature: Any, target_context: Any) -> Any:
        """The code of a signature, if it is kept."""
        try:
            return super().load_overload(signature, target_context)
        except Exception:  # what a damaged pickle raises depends on where the damage is
            _tell(f"{self._cache_path}: compiled code is damaged and made again")
            with suppress(OSError):
                self.flush()
            return None

    def save_overload(self, signature: Any, result: Any) -> None:
        """Keep the code of a signature, if it can be written."""
        try:
            super().save_overload(signature, result)
        except OSError as error:
            _tell_unkept(str(error))


class _File(IndexDataCacheFile):
    """Files that end in a digest, since damaged machine code would be executed."""

    def _dump(self, obj: Any) -> bytes:
        data: bytes = super()._dump(obj)
        return data + hashlib.sha256(data).digest()

    def _load_data(self, name: str) -> Any:
        data = Path(self._data_path(name)).read_bytes()
        if hashlib.sha256(data[:-_DIGEST]).digest() != data[-_DIGEST:]:
            raise ValueError(f"{name} is damaged")
        return pickle.loads(data)


@contextmanager
def first_call(function: Any) -> Iterator[None]:
    """Around a call that may compile ``function``: one line on stderr says so; of processes that start together one compiles.

    The others wait, and load what that one has kept. Nobody waits where code is not kept, or where folders have no locks.
    """
    with ExitStack() as stack:
        stack.enter_context(event.install_listener("numba:compile", _Notice()))
        with suppress(OSError):
            if not function.signatures:
                folder = os.open(function._cache.cache_path or "", os.O_RDONLY)  # OSError: not kept
                stack.callback(os.close, folder)  # which ends the lock, as the end of the process does
                fcntl.flock(folder, fcntl.LOCK_EX)
        yield


class _Notice(event.Listener):
    def on_start(self, event: event.Event) -> None:
        _tell("compiling the simulation, once; it is kept for later runs (about 15 s)")

    def on_end(self, event: event.Event) -> None:
        pass


@intrinsic
def atomic_add(typing_context: Any, array: Any, index: Any, value: Any) -> Any:
    """Add to one number of an int64 array that other threads change, too; the number before."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        return builder.atomic_rmw("add", builder.gep(data, [args[1]]), args[2], "seq_cst")

    return types.int64(array, types.int64, types.int64), codegen


give_way = types.ExternalFunction("sched_yield", types.int32())
"""Let another thread have this core; found by its name wherever the code was compiled."""
