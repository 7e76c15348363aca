"""PyBullet, imported without the line about its build that it prints: ``from sb3_quad.base.bullet import p``."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress


@contextmanager
def _standard_error_silenced() -> Iterator[None]:
    """PyBullet writes to file descriptor 2 itself, beside ``sys.stderr``."""
    with suppress(Exception):
        sys.stderr.flush()
    try:
        kept = os.dup(2)
    except OSError:  # a program without a standard error, such as a window's
        yield
        return
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
