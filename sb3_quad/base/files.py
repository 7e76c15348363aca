"""Files that appear whole or not at all, with a clear error if a folder cannot be written to."""

import os
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, BinaryIO

import numpy as np

from sb3_quad.base.errors import ConfigError, raised_as
from sb3_quad.base.types import StrDict, StrPath

LOCK = ".lock"
# The largest text that is read, and what the arrays of a file may take, in bytes. A file that is
# larger than the latter may take a few times its size, since it may be compressed.
LARGEST_TEXT = 5_000_000
LARGEST_ARRAYS = 2**27


@contextmanager
def replacing(path: StrPath) -> Iterator[BinaryIO]:
    """A stream to a temporary file that replaces ``path`` once it is finished.

    A reader never sees half a file. If anything fails, ``path`` keeps its content.

    :raises ConfigError: Not the name of a file, a folder that cannot be written, or a full disk.
    """
    file = Path(path)
    # A device such as /dev/null would be replaced, too.
    if not file.name or (file.exists() and not file.is_file()):
        raise ConfigError(f"{str(path)!r}: names no file that can be written")
    temporary = file.with_name(f".{file.name}.{os.getpid()}.tmp")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        try:
            # Through a link of this name, the target would be written to.
            temporary.unlink(missing_ok=True)
            with temporary.open("xb") as stream:
                yield stream
                stream.flush()
                os.fsync(stream.fileno())
            os.replace(temporary, file)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written ({error.strerror or error})") from error


def write_bytes(path: StrPath, content: bytes) -> None:
    """Write a file by :func:`replacing`."""
    with replacing(path) as stream:
        stream.write(content)


@contextmanager
def locked(folder: Path, what: str) -> Iterator[None]:
    """Reserve a folder for this process, and remove half-written files of a killed one.

    The lock ends with the process, however it ends. On a file system without locks, every process
    gets one.

    :param what: Name of the folder in the error message, such as "run folder".
    :raises ConfigError: Another process holds the lock.
    """
    # Imported here because it takes as long as the rest of --help.
    from filelock import FileLock, Timeout

    lock = FileLock(folder / LOCK)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise ConfigError(
            f"{what} {folder}: another process is writing to it; wait until that ends"
        ) from None
    except (OSError, NotImplementedError):
        # This file system has no locks.
        pass
    try:
        remove_half_written(folder)
        yield
    finally:
        # Removed while it is locked, so that no other process can lock a file without a name.
        # Windows removes it on release, and the folder may be gone.
        with suppress(OSError):
            (folder / LOCK).unlink()
        lock.release()


def remove_half_written(folder: Path) -> None:
    """Remove files that a killed process was writing."""
    for temporary in folder.rglob(".*.tmp"):
        with suppress(OSError):
            temporary.unlink()


def write_text(path: StrPath, text: str) -> None:
    """Write text in UTF-8 by :func:`replacing`."""
    write_bytes(path, text.encode("utf-8"))


def write_arrays(path: StrPath, compressed: bool = False, **arrays: Any) -> None:
    """Write NumPy arrays as ``.npz`` by :func:`replacing`."""
    save = np.savez_compressed if compressed else np.savez
    with replacing(path) as stream:
        save(stream, **arrays)


def read_arrays(path: StrPath, prefix: str | tuple[str, ...] = "") -> StrDict:
    """Return the arrays of an ``.npz`` file whose names begin with ``prefix``, or with one of them.

    Arrays with other names are not even read.

    :raises ConfigError: A missing or damaged file, or one that takes far more memory than it says.
    """
    file = regular_file(path)
    # A damaged archive may raise anything, depending on where the damage is.
    with (
        raised_as(ConfigError, f"{path}: cannot be read"),
        zipfile.ZipFile(file) as archive,
        np.load(file, allow_pickle=False) as arrays,
    ):
        size = sum(part.file_size for part in archive.infolist())
        if size > max(LARGEST_ARRAYS, 4 * file.stat().st_size):
            raise ValueError(f"its arrays take {size:,} bytes")
        return {name: arrays[name] for name in arrays.files if name.startswith(prefix)}


def regular_file(path: StrPath) -> Path:
    """Return the path of a file that exists.

    :raises ConfigError: There is none, or it is a folder, or a device or pipe, which may never end.
    """
    file = Path(path)
    if not file.is_file():
        problem = "no such file"
        if file.exists():
            problem = "cannot be read, since it is a folder, a device or a pipe"
        raise ConfigError(f"{path}: {problem}")
    return file


def read_bytes(path: StrPath, most: int = LARGEST_TEXT) -> bytes:
    """Return the content of a file.

    :param most: The largest size, in bytes.
    :raises ConfigError: See :func:`regular_file`; it is larger, or cannot be read.
    """
    file = regular_file(path)
    size = file.stat().st_size
    if size > most:
        raise ConfigError(f"{path}: is larger than {most:,} bytes")
    with raised_as(ConfigError, f"{path}: cannot be read"), file.open("rb") as stream:
        # Some files of Linux never end, although their size is 0.
        return stream.read(size)


def read_text(path: StrPath) -> str:
    """Return the text of a file.

    :raises ConfigError: See :func:`read_bytes`; or it is not UTF-8.
    """
    content = read_bytes(path)
    with raised_as(ConfigError, f"{path}: cannot be read"):
        return content.decode("utf-8")


def refuse_existing(path: StrPath, overwrite: bool) -> None:
    """Check that writing a file replaces none, unless ``overwrite``.

    :raises ConfigError: The file exists, or it is a folder.
    """
    if Path(path).is_dir():
        raise ConfigError(f"{path}: is a folder; name a file")
    if Path(path).exists() and not overwrite:
        raise ConfigError(f"{path}: exists already; name another file, or add --overwrite")


def refuse_outside(path: StrPath, where: str, *folders: Path) -> None:
    """Refuse a path, which may be a stranger's, that is in none of the folders.

    :param where: What the message calls the path.
    :raises ConfigError: It is elsewhere: an absolute path, by ``..``, or through a link.
    """
    # It may hold a null character, or be a link to itself.
    with raised_as(ConfigError, f"{where}: {str(path)!r} cannot be used"):
        place = Path(path).resolve()
        outside = not any(place.is_relative_to(folder.resolve()) for folder in folders)
    if outside:
        raise ConfigError(
            f"{where}: {path} is outside of {' and '.join(map(str, folders))}, where alone files "
            "of strangers may write"
        )


def refuse_links(folder: Path) -> None:
    """Refuse a folder with links that lead out of it, through which a command would write.

    :raises ConfigError: There is one.
    """
    for path in folder.rglob("*"):
        refuse_outside(path, str(folder), folder)


def make_folder(path: StrPath, what: str, flag: str) -> None:
    """Make a folder for files to come, if it does not exist, and check that it can be written.

    :param what: Name of the folder in the error message.
    :param flag: The flag that gives another folder, for the error message.
    :raises ConfigError: The folder cannot be written.
    """
    try:
        Path(path).mkdir(parents=True, exist_ok=True)
        TemporaryFile(dir=path).close()
    except (OSError, ValueError) as error:
        # ValueError: the path holds a null character.
        reason = getattr(error, "strerror", None) or error
        raise ConfigError(
            f"{what} {path}: cannot be written ({reason}); give another with {flag}"
        ) from None


def save_model(model: Any, path: StrPath) -> None:
    """Save a model by :func:`replacing`.

    :raises ConfigError: A folder that cannot be written, or a full disk.
    """
    with replacing(path) as stream:
        model.save(stream)


def one_line(error: BaseException) -> str:
    """Return the message of an exception as one line of at most 200 characters."""
    return (" ".join(str(error).split()) or type(error).__name__)[:200]
