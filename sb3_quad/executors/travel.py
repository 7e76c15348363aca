"""What travels with a task to a machine that does not see this one's folders, and back: single files, and whole folders."""

import io
import tarfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import write_bytes

SUFFIXES = (".zip", ".yaml", ".yml")
MOST = 2**28  # bytes of one file


def files_of(value: Any) -> dict[str, bytes]:
    """The files that plain values (mappings, lists, texts) name by their paths, with their content.

    :raises ConfigError: a file that is too large to travel, or cannot be read.
    """
    found: dict[str, bytes] = {}
    for text in _texts(value):
        path = Path(text)
        if text.endswith(SUFFIXES) and len(text) < 4096 and path.is_file():
            try:
                if path.stat().st_size > MOST:
                    raise ConfigError(f"{path}: is too large to travel to a worker ({MOST:,} bytes at most)")
                found[text] = path.read_bytes()
            except OSError as error:
                raise ConfigError(f"{path}: cannot be read ({error.strerror or error})") from None
    return found


def with_files(value: Any, files: Mapping[str, bytes], folder: Path) -> Any:
    """The same plain values with the files laid into ``folder`` and named by their new paths."""
    places = {path: folder / f"{number}_{Path(path).name}" for number, path in enumerate(files)}
    for path, place in places.items():
        write_bytes(place, files[path])
    return _replaced(value, {path: str(place) for path, place in places.items()})


def pack(folder: Path) -> bytes:
    """A folder as an uncompressed tar file, half-written files left out; what is in zips and .npz is compressed as it is."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as archive:
        for path in sorted(folder.rglob("*")):
            if path.is_file() and not path.name.endswith(".tmp"):
                archive.add(path, path.relative_to(folder).as_posix(), recursive=False)
    return buffer.getvalue()


def unpack(content: bytes, folder: Path) -> None:
    """Lay the files of :func:`pack` into a folder, each whole or not at all.

    :raises ConfigError: a folder that cannot be written, a full disk, a name that leads out of the folder.
    """
    with tarfile.open(fileobj=io.BytesIO(content)) as archive:
        for member in archive.getmembers():
            path = (folder / member.name).resolve()
            if not path.is_relative_to(folder.resolve()):
                raise ConfigError(f"{member.name}: leads out of {folder}")
            file = archive.extractfile(member)
            if file is not None:
                write_bytes(path, file.read())


def _texts(value: Any) -> list[str]:
    if isinstance(value, str):
        return [value]
    parts = value.values() if isinstance(value, Mapping) else value if isinstance(value, (list, tuple)) else ()
    return [text for part in parts for text in _texts(part)]


def _replaced(value: Any, names: Mapping[str, str]) -> Any:
    if isinstance(value, str):
        return names.get(value, value)
    if isinstance(value, Mapping):
        return {key: _replaced(part, names) for key, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [_replaced(part, names) for part in value]
    return value
