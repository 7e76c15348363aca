"""PyBullet, imported without the line about its build that it prints: ``from sb3_quad.base.bullet import p``."""

import os
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def _standard_error_silenced() -> Iterator[None]:
    """PyBullet writes to file descriptor 2 itself, beside ``sys.stderr``."""
    kept = os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


with _standard_error_silenced():
    import pybullet as p

__all__ = ["p"]
