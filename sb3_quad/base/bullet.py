"""Import PyBullet without the line about its build that it prints.

Use ``from sb3_quad.base.bullet import p``. The package installs PyBullet where it has a wheel, up
to Python 3.11. Elsewhere this import says how to get it.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager

from sb3_quad.base.imports import require

NEEDS = "QuadcopterEnv (gymnasium.make, --vec-env dummy or subproc, --backend pybullet, enjoy)"


@contextmanager
def _standard_error_silenced() -> Iterator[None]:
    """Redirect file descriptor 2, which PyBullet writes to without ``sys.stderr``."""
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
    p = require("pybullet", "pybullet", NEEDS)

__all__ = ["p"]
