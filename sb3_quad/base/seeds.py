"""Every stream of random numbers, by what it is for: what judges a training is never what it was
trained on.

Streams are told apart by :class:`numpy.random.SeedSequence` of a run's seed, a purpose and a row.
No two share numbers: seeds 0 and 1 of a training have as little in common as a training and its
evaluation.
"""

import typing
from typing import Annotated, Literal, TypeAlias

import numpy as np
from pydantic import Field

Purpose = Literal[
    "training",
    "evaluation",  # along the way
    "correction",  # before and after an agent is trimmed
    "table",  # at the end of a run
    "search",  # for gains: examples/tune_expert.py
    "expert",  # at the end of that search, and of check-vehicle
    "offset",  # that adaptive scaling cancels
    "card",  # of published policies
    "suite",  # of scenarios
]
PURPOSES = typing.get_args(Purpose)
_PURPOSE, _ROW = range(2)  # what a key tells apart
SCENARIO_STREAM = (
    0x5B3  # a scenario's own random numbers have nothing to do with those of the environment
)
LARGEST = 2**32  # NumPy's global generator, which SB3 seeds, takes no more
Seed: TypeAlias = Annotated[int, Field(ge=0, lt=LARGEST)]


def seed_for(purpose: Purpose, seed: int = 0) -> int:
    """The seed of what a run with ``seed`` flies for some purpose; its rows fly by
    :func:`row_seeds` of it.
    """
    return _hash(seed, _PURPOSE, PURPOSES.index(purpose))


def row_seeds(seed: int, n: int) -> list[int]:
    """The seeds of n rows, each for ``reset(seed=…)`` of one environment; row i's does not depend
    on n.

    They are below 2**53, which any file and any language keeps exactly.
    """
    return [_hash(seed, _ROW, row) for row in range(n)]


def _hash(seed: int, *key: int) -> int:
    return int(
        np.random.SeedSequence(seed, spawn_key=key).generate_state(1, np.uint64)[0] >> np.uint64(11)
    )
