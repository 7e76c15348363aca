"""Every range of seeds, by what it is for: the episodes of one purpose are never those of another.

A run with ``seed`` trains on episodes of the seeds ``seed``, ``seed + 1``, …, one for each environment. What judges the run is
flown on other episodes, whose first seed is :func:`seed_for` its purpose. Seeds of the suites are part of the scenarios.
"""

from __future__ import annotations

from typing import Literal

from sb3_quad.base.errors import ConfigError

Purpose = Literal["evaluation", "trim", "table", "expert", "offset", "card"]

_FIRST: dict[Purpose, int] = {
    "evaluation": 2**18,  # along the way
    "trim": 3 * 2**17,  # an agent's offset before and after it is trimmed
    "table": 2**19,  # at the end of a run
    "expert": 1_000_000,  # what an expert reaches: tune-expert, check-vehicle
    "offset": 2**21,  # the offset that adaptive scaling cancels
    "card": 20_000_000,  # of published policies
}
SUITE = 2**19  # scenarios that name no seed
ROOM = 2**17  # seeds between one purpose and the next
LARGEST = 2**32 - 2**20
SCENARIO_STREAM = 0x5B3  # a scenario's own random numbers have nothing to do with those of the environment


def seed_for(purpose: Purpose, seed: int = 0) -> int:
    """The first seed of the episodes that judge a run with ``seed``.

    A seed that leaves the room between two purposes is moved beyond all ranges, together with its purpose's number.
    """
    if seed < ROOM:
        return _FIRST[purpose] + seed
    return (1 + list(_FIRST).index(purpose)) * 2**40 + seed


def check_seed(seed: int) -> int:
    """``seed``, if a run can have it.

    :raises ConfigError: it is negative or too large.
    """
    if not 0 <= seed < LARGEST:
        raise ConfigError(f"seed {seed}: must be at least 0 and below {LARGEST}")
    return seed
