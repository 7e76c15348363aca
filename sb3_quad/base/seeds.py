"""Every range of seeds, by what it is for: what judges a training is never what it was trained on.

A seed names an environment's stream of random numbers. Each purpose has ``ROOM`` of them, one for each run; environment i of a
run takes the i-th after it.
"""

from typing import Literal

from sb3_quad.base.errors import ConfigError

Purpose = Literal["training", "evaluation", "trim", "table", "expert", "offset", "card"]

ROOM = 2**17
SUITE = 2**19  # of scenarios that name no seed: the episodes of closing tables, which judge as well
SCENARIO_STREAM = 0x5B3  # a scenario's own random numbers have nothing to do with those of the environment
LARGEST = 2**32 - 2**20
_FIRST: dict[Purpose, int] = {
    "training": 0,
    "evaluation": 2**18,  # along the way
    "trim": 3 * 2**17,  # before and after an agent is trimmed
    "table": 2**19,  # at the end of a run
    "expert": 1_000_000,  # tune-expert, check-vehicle
    "offset": 2**21,  # that adaptive scaling cancels
    "card": 20_000_000,  # of published policies
}


def seed_for(purpose: Purpose, seed: int = 0) -> int:
    """The first seed of the episodes that a run with ``seed`` flies for some purpose.

    Seeds of ``ROOM`` and above would reach into the next purpose's; they get ranges beyond all others.
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
