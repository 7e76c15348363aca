"""Every stream of random numbers, by its purpose: no agent is judged on the episodes it trained on.

A :class:`numpy.random.SeedSequence` of a run's seed, a purpose and a row separates the streams. No
two share numbers: seeds 0 and 1 of a training are as independent as a training and its evaluation.
"""

import typing
from contextlib import AbstractContextManager
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from sb3_quad.base.errors import ConfigError, raised_as

Purpose = Literal[
    "training",
    # Evaluations during a training.
    "evaluation",
    # The measurements before and after an offset correction.
    "correction",
    # The closing table of a run.
    "table",
    # A search for the gains of an expert.
    "search",
    # The measurement after that search, and check-vehicle.
    "expert",
    # The offset that adaptive scaling cancels.
    "offset",
    # The cards of published policies.
    "card",
    # Suites of scenarios.
    "suite",
]
PURPOSES = typing.get_args(Purpose)
# The first number of a key separates purposes from rows.
_PURPOSE = 0
_ROW = 1
# The random numbers of a scenario are independent of those of the environment.
SCENARIO_STREAM = 0x5B3
# NumPy's global generator, which SB3 seeds, takes no larger seed.
LARGEST = 2**32
Seed = Annotated[int, Field(ge=0, lt=LARGEST)]


def seed_for(purpose: Purpose, seed: int = 0) -> int:
    """Return the seed for one purpose of a run with ``seed``.

    Its rows use :func:`row_seeds` of it.
    """
    return _hash(seed, _PURPOSE, PURPOSES.index(purpose))


def row_seeds(seed: int, n: int) -> list[int]:
    """Return the seeds of n rows, each for ``reset(seed=…)`` of one environment.

    The seed of row i does not depend on n. All are below 2**53, which every file format and every
    language represents exactly.
    """
    with seed_errors(seed):
        return [_hash(seed, _ROW, row) for row in range(n)]


def seed_errors(seed: Any) -> AbstractContextManager[None]:
    """Return a context that names a seed which NumPy refuses."""
    return raised_as(ConfigError, f"seed {seed!r} is not a whole number of 0 or more")


def _hash(seed: int, *key: int) -> int:
    sequence = np.random.SeedSequence(seed, spawn_key=key)
    # The upper 53 of 64 bits.
    return int(sequence.generate_state(1, np.uint64)[0] >> np.uint64(11))
