"""How large a hit a controller survives: force and torque scaled together until half of the flights are lost."""

from __future__ import annotations

from typing import Any

import numpy as np

from sb3_quad.base.errors import ConfigError
from sb3_quad.evaluation.records import Estimate, HitLimit, HitTrial
from sb3_quad.evaluation.scenario_flights import fly_scenario
from sb3_quad.evaluation.summary import share
from sb3_quad.scenarios.scenario import Scenario

FIRST_GRID, GRID = 16, 8  # factors that are flown side by side, in the first round and in those after it
MAX_ROUNDS = 8


def find_limit(controller: Any, scenario: Scenario, backend: str = "batch") -> HitLimit:
    """The least factor of a scenario's wrenches at which half of the flights are lost.

    A grid of factors from 0 to ``hit_search.largest`` is flown first, so that survival need not fall evenly; then the interval
    in which it first drops to a half is divided again and again, until it is narrower than ``hit_search.resolution`` of its
    upper end. All factors see the same episodes.

    :raises ConfigError: a scenario without a search.
    :raises ControllerError: a controller that fails in flight.
    """
    search = scenario.hit_search
    if search is None:
        raise ConfigError(f"scenario {scenario.name}: has no hit_search")
    tried: dict[float, Estimate] = {}
    low, high = 0.0, search.largest
    grid = np.linspace(low, high, FIRST_GRID + 1)
    for _ in range(MAX_ROUNDS):
        tried |= _survival(controller, scenario, grid, search.episodes, backend)
        lost = next((factor for factor in sorted(tried) if tried[factor].value <= 0.5), None)
        if lost is None:
            break
        low, high = max((factor for factor in tried if factor < lost), default=0.0), lost
        if high - low <= search.resolution * high:
            break
        grid = np.linspace(low, high, GRID + 1)[1:-1]
    trials = [HitTrial(factor=factor, survived=tried[factor]) for factor in sorted(tried)]
    sure = [trial.factor for trial in trials if trial.survived.low > 0.5 and (lost is None or trial.factor < lost)]
    gone = [trial.factor for trial in trials if trial.survived.high < 0.5 and lost is not None and trial.factor >= lost]
    factor = None if lost is None else high
    if lost is not None and low < high:  # where the line between the two shares passes a half
        above, below = tried[low].value, tried[high].value
        factor = low + (high - low) * (above - 0.5) / (above - below)
    return HitLimit(
        factor=factor,
        low=max(sure, default=0.0),
        high=min(gone, default=None),
        force=max(wrench.force.largest for wrench in scenario.wrenches),
        torque=max(wrench.torque.largest for wrench in scenario.wrenches),
        trials=trials,
    )


def _survival(controller: Any, scenario: Scenario, grid: Any, episodes: int, backend: str) -> dict[float, Estimate]:
    factors = np.repeat(grid, episodes)
    seeds = list(range(scenario.seed, scenario.seed + episodes)) * len(grid)
    flights, _ = fly_scenario(controller, scenario, backend, seeds, factors)
    rows = flights.success.reshape(len(grid), episodes)
    return {float(factor): share(row) for factor, row in zip(grid, rows, strict=True)}
