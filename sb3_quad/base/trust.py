"""Whether the user trusts the files that are read: by ``--trust``, or by an environment variable,
which workers inherit.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager

VARIABLE = "SB3_QUAD_TRUST"


def trusted() -> bool:
    """Whether files may run code of their own."""
    return os.environ.get(VARIABLE, "0") not in ("", "0")


@contextmanager
def trusting(asked: bool) -> Iterator[None]:
    """Within the block all files are trusted, if that is ``asked`` for or was so before."""
    before = os.environ.get(VARIABLE, "")
    if asked:
        os.environ[VARIABLE] = "1"
    try:
        yield
    finally:
        if asked:
            os.environ[VARIABLE] = before
