"""Where compiled code is kept: numba's cache, which here outlives damaged files, and folders that cannot be written."""

import fcntl
import functools
import hashlib
import os
import stat
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from numba.core.caching import CompileResultCacheImpl, FunctionCache, IndexDataCacheFile, UserProvidedCacheLocator

_DIGEST = hashlib.sha256().digest_size
_WAY_OUT = "NUMBA_CACHE_DIR names a better folder"


@functools.cache
def _tell(line: str) -> None:
    """Say a line on stderr, once."""
    sys.stderr.write(f"sb3_quad: {line}\n")


@functools.cache
def _temporary_folder() -> Path | None:
    """A folder for temporary files that nobody else can write, since what lies in it is executed; None: there is none."""
    try:
        owner = os.getuid() if hasattr(os, "getuid") else 0
        folder = Path(tempfile.gettempdir()) / f"sb3_quad-{owner}"
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
    except OSError:
        return None
    private = stat.S_ISDIR(found.st_mode) and (os.name == "nt" or (found.st_uid == owner and not found.st_mode & 0o077))
    return folder if private else None


class _TemporaryLocator(UserProvidedCacheLocator):
    """Comes after numba's own: in the package, then in the user's folder for caches."""

    def __init__(self, py_func: Any, py_file: str) -> None:
        super().__init__(py_func, py_file)
        self._cache_path = os.path.join(_temporary_folder() or "", self.get_suitable_cache_subpath(py_file))

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> Any:
        # Past the parent, which wants NUMBA_CACHE_DIR.
        found = None if _temporary_folder() is None else super(UserProvidedCacheLocator, cls).from_function(py_func, py_file)
        if found is not None:
            _tell(f"the package's folder cannot be written; compiled code is kept in {_temporary_folder()}; {_WAY_OUT}")
        return found


class _Implementation(CompileResultCacheImpl):
    _locator_classes = (*CompileResultCacheImpl._locator_classes, _TemporaryLocator)


class _CheckedFile(IndexDataCacheFile):
    """Index and code, each with a digest at its end; what is damaged counts as missing, and is made and written anew."""

    def _dump(self, obj: Any) -> bytes:
        data: bytes = super()._dump(obj)
        return data + hashlib.sha256(data).digest()

    def _load_index(self) -> Any:
        try:
            return super()._load_index()
        except Exception:  # what a damaged pickle raises depends on where the damage is
            _tell(f"{self._index_path} is damaged; its code is compiled again")
            return {}

    def _load_data(self, name: str) -> Any:
        path = self._data_path(name)
        data = Path(path).read_bytes()  # OSError: numba takes it for missing
        if hashlib.sha256(data[:-_DIGEST]).digest() == data[-_DIGEST:]:
            return super()._load_data(name)
        _tell(f"{path} is damaged; its code is compiled again")
        return None


class Cache(FunctionCache):
    """Numba's cache of a function, which is new whenever ``stamp`` is.

    :raises RuntimeError: no folder can be written.
    """

    _impl_class = _Implementation

    def __init__(self, function: Callable[..., Any], stamp: Any) -> None:
        super().__init__(function)
        self._cache_file = _CheckedFile(self._cache_path, self._impl.filename_base, stamp)

    def save_overload(self, signature: Any, result: Any) -> None:
        """Keep what has been compiled, if it can be written."""
        try:
            super().save_overload(signature, result)
        except OSError as error:
            tell_unkept(str(error))


def tell_unkept(why: str) -> None:
    """Say that compiled code is not kept."""
    _tell(f"compiled code cannot be kept ({why}) and is made at every start, in about 15 s; {_WAY_OUT}")


@contextmanager
def compiled_by_one(function: Any) -> Iterator[None]:
    """Keep other processes from calling ``function`` for the first time meanwhile: they wait, and load what this one has kept.

    :param function: a compiled one. Nothing is done where it is ready in this process, is not kept, or folders have no locks.
    """
    with ExitStack() as lock:
        with suppress(OSError):
            if not function.signatures:
                folder = os.open(function._cache.cache_path or "", os.O_RDONLY)  # OSError: not kept
                lock.callback(os.close, folder)  # which ends the lock, as the end of the process does
                fcntl.flock(folder, fcntl.LOCK_EX)
        yield
