"""An estimate of memory before it is taken."""

import os

from sb3_quad.base.errors import ConfigError


def check_memory(what: str, needed: float) -> None:
    """See that this machine has ``needed`` bytes of memory at all.

    :param what: needs them, for the message.
    :raises ConfigError: it has less.
    """
    there = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if needed > there:
        raise ConfigError(f"{what}: needs about {needed / 1e9:,.0f} GB of memory, this machine has {there / 1e9:,.0f} GB")
