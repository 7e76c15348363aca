"""An estimate of memory before it is taken."""

import io
import os
import zipfile
from pathlib import Path

from sb3_quad.base.errors import ConfigError

MAX_UNPACKED = 2**31  # bytes of an agent's zip, once unpacked


def check_memory(what: str, needed: float) -> None:
    """See that this machine has ``needed`` bytes of memory at all.

    :param what: needs them, for the message.
    :raises ConfigError: it has less.
    """
    there = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if needed > there:
        raise ConfigError(f"{what}: needs about {needed / 1e9:,.0f} GB of memory, this machine has {there / 1e9:,.0f} GB")


def check_unpacked(path: str | Path | io.BytesIO) -> None:
    """See that a zip is no bomb.

    :raises ConfigError: it unpacks to more than an agent ever has.
    :raises zipfile.BadZipFile: it is no zip; OSError: it cannot be read.
    """
    with zipfile.ZipFile(path) as archive:
        size = sum(entry.file_size for entry in archive.infolist())
    if size > MAX_UNPACKED:
        raise ConfigError(f"{path}: unpacks to {size / 1e9:.1f} GB, at most {MAX_UNPACKED / 1e9:.1f} GB are read")
