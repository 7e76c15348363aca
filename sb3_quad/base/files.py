"""Files that appear whole or not at all, with a clear error where a folder cannot be written."""

import csv
import fcntl
import io
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, BinaryIO

import numpy as np

from sb3_quad.base.errors import ConfigError


@contextmanager
def replacing(path: str | Path) -> Iterator[BinaryIO]:
    """A stream to a file beside ``path`` that is moved there when it is finished, so that a reader
    never meets half of it.

    :raises ConfigError: no name of a file, a folder that cannot be written, a full disk; what
        ``path`` held is still there.
    """
    file = Path(path)
    if not file.name or (
        file.exists() and not file.is_file()
    ):  # a device, as /dev/null, would be replaced, too
        raise ConfigError(f"{str(path)!r}: names no file that can be written")
    beside = file.with_name(f".{file.name}.{os.getpid()}.tmp")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        try:
            with beside.open("wb") as stream:
                yield stream
                stream.flush()
                os.fsync(stream.fileno())
            os.replace(beside, file)
        finally:
            beside.unlink(missing_ok=True)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written ({error.strerror or error})") from error


def write_bytes(path: str | Path, content: bytes) -> None:
    """Write a file by :func:`replacing`."""
    with replacing(path) as stream:
        stream.write(content)


@contextmanager
def locked(folder: Path, what: str) -> Iterator[None]:
    """Keep a folder to this process, and remove what a killed one has left half-written in it.

    The lock ends with the process, however that ends, and leaves no file. A file system without
    locks grants every one.

    :param what: the folder in an error message.
    :raises ConfigError: another process has it.
    """
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ConfigError(
                f"{what} {folder}: another process is writing to it; wait until that ends"
            ) from None
        except OSError:  # no locks here
            pass
        for half in folder.rglob(".*.tmp"):
            half.unlink(missing_ok=True)
        yield
    finally:
        os.close(descriptor)


def write_text(path: str | Path, text: str) -> None:
    """As :func:`write_bytes`, of text in UTF-8."""
    write_bytes(path, text.encode("utf-8"))


def write_csv(path: str | Path, columns: Iterable[str], rows: Iterable[Mapping[str, Any]]) -> None:
    """As :func:`write_bytes`, of a table: empty where a row has no such key, without what no column
    is called.
    """
    text = io.StringIO()
    writer = csv.DictWriter(text, list(columns), extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(path, text.getvalue())


def write_arrays(path: str | Path, compressed: bool = False, **arrays: Any) -> None:
    """As :func:`write_bytes`, of NumPy arrays as ``.npz``."""
    with replacing(path) as stream:
        (np.savez_compressed if compressed else np.savez)(stream, **arrays)


def read_arrays(path: str | Path, prefix: str = "") -> dict[str, Any]:
    """The arrays of an ``.npz`` file whose names begin with ``prefix``; the others are not even
    read.

    :raises ConfigError: a missing or damaged file.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in file.files if name.startswith(prefix)}
    except Exception as error:  # what a damaged archive raises depends on where the damage is
        raise ConfigError(f"{path}: cannot be read ({one_line(error)})") from None


def read_text(path: str | Path) -> str:
    """The text of a file.

    :raises ConfigError: it is missing or cannot be read.
    """
    try:
        return Path(path).read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file") from None
    except (OSError, ValueError) as error:  # ValueError: not UTF-8, or no path
        raise ConfigError(f"{path}: cannot be read ({error})") from None


def refuse_existing(path: str | Path, overwrite: bool) -> None:
    """See that a file that a command is to write does not cost one that is there.

    :raises ConfigError: it exists, and ``overwrite`` was not asked for; or it is a folder.
    """
    if Path(path).is_dir():
        raise ConfigError(f"{path}: is a folder; name a file")
    if Path(path).exists() and not overwrite:
        raise ConfigError(f"{path}: exists already; name another file, or add --overwrite")


def make_folder(path: str | Path, what: str, flag: str) -> None:
    """Make a folder that files are to be written to, unless it is there.

    :param what: the folder in the message, which also names the flag that gives another.
    :raises ConfigError: it cannot be written.
    """
    try:
        Path(path).mkdir(parents=True, exist_ok=True)
        TemporaryFile(dir=path).close()
    except (OSError, ValueError) as error:  # ValueError: no path
        reason = getattr(error, "strerror", None) or error
        raise ConfigError(
            f"{what} {path}: cannot be written ({reason}); give another with {flag}"
        ) from None


def model_bytes(model: Any) -> bytes:
    """The zip that ``model.save`` of Stable-Baselines3 would write."""
    buffer = io.BytesIO()
    model.save(buffer)
    return buffer.getvalue()


def save_model(model: Any, path: str | Path) -> None:
    """``model.save(path)``, whole or not at all.

    :raises ConfigError: a folder that cannot be written, a full disk.
    """
    write_bytes(path, model_bytes(model))


def one_line(error: BaseException) -> str:
    """What an exception says, in one line that is not too long."""
    return (" ".join(str(error).split()) or type(error).__name__)[:200]
