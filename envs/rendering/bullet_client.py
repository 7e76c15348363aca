"""Import PyBullet without the line that it prints about its build.

Use ``from sb3_quad.envs.rendering.bullet_client import p``. The package installs
PyBullet where it has a wheel, up to Python 3.11. Elsewhere this import says how to get it.
"""

import os

from sb3_quad.base.imports import require

NEEDS = "QuadcopterEnv (gymnasium.make, --vec-env dummy or subproc)"


# PyBullet writes to file descriptor 2 without sys.stderr.
_kept = os.dup(2)
_nowhere = os.open(os.devnull, os.O_WRONLY)
try:
    os.dup2(_nowhere, 2)
    p = require("pybullet", "pybullet", NEEDS)
finally:
    os.dup2(_kept, 2)
    os.close(_kept)
    os.close(_nowhere)

__all__ = ["p"]
