"""Flying the episodes of a scenario, and finding how large a hit a controller survives there."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from pydantic import Field

from sb3_quad.base.arrays import Arrays, FloatArray
from sb3_quad.base.validate import Frozen
from sb3_quad.evaluation.flightlog import Recorder
from sb3_quad.evaluation.flights import Flights, fly_settings
from sb3_quad.evaluation.scenarios.sample import sample_plan
from sb3_quad.evaluation.scenarios.scenario import Scenario
from sb3_quad.evaluation.statistics import Estimate, share
from sb3_quad.simulation.settings import FlightSettings

PART_SIZES = {"batch": 4096, "pybullet": 240}  # episodes side by side
RECORDED_FIXED, RECORDED_RANDOM = 24, 8  # flights whose trajectories are kept, at most
FIRST_GRID, GRID = 16, 8  # factors of a hit that are flown side by side, in the first round and in those after it
MAX_ROUNDS = 8


class HitTrial(Frozen):
    """The flights with one factor of the wrenches."""

    factor: float
    survived: Estimate


class HitLimit(Frozen):
    """How large the wrenches of a scenario may get: the factor at which half of the flights are lost."""

    factor: float | None = Field(description="None: more than half survive even the greatest factor tried")
    low: float = Field(description="greatest factor that more than half survive for certain (95 %)")
    high: float | None = Field(description="least factor that fewer than half survive for certain; None: not found")
    force: float = Field(description="largest force of the scenario, N; times the factor is what is survived")
    torque: float = Field(description="largest torque of the scenario, N m")
    trials: list[HitTrial] = Field(description="all factors tried, rising")


def fly_scenario(
    controller: Any,
    scenario: Scenario,
    backend: str = "batch",
    seeds: Sequence[int] | None = None,
    factors: FloatArray | None = None,
    recorded: int | None = 0,
    own: Mapping[str, Any] | None = None,
) -> tuple[Flights, Arrays]:
    """Fly a scenario's episodes; the same ones for every controller and either backend.

    :param controller: as of :func:`~sb3_quad.evaluation.flights.fly`.
    :param seeds: of the episodes; None: the scenario's own.
    :param factors: of each episode's wrenches, (n,); None: 1.
    :param recorded: flights to sample; None: all of a scenario that is the same each time, the first few of others.
    :param own: changes to how it is flown that go with the controller: ``observation_mean``, ``observation_std``.
    :return: the metrics, and the trajectories (``flightlog.py``) of the first ``recorded`` flights.
    :raises ConfigError: an unknown backend, or a controller that cannot be asked.
    :raises ControllerError: a controller that fails in flight.
    """
    chosen = scenario.episode_seeds() if seeds is None else seeds
    if recorded is None:
        recorded = RECORDED_FIXED if scenario.is_fixed else RECORDED_RANDOM
    size, settings = PART_SIZES.get(backend, 1), flown_as(scenario).with_changes(**(own or {}))
    parts, recorder = [], Recorder(recorded)
    for first in range(0, len(chosen), size):
        part = slice(first, first + size)
        plan = sample_plan(scenario, chosen[part], None if factors is None else factors[part])
        hooks = [recorder] if recorded and first == 0 else []
        parts.append(fly_settings(controller, settings, chosen[part], backend, scenario.tolerances, hooks, plan))
    return Flights.concatenate(parts), recorder.arrays() if recorded else {}


def flown_as(scenario: Scenario) -> FlightSettings:
    """How the episodes of a scenario are flown."""
    return FlightSettings(
        task=scenario.task,
        vehicle=scenario.flown_vehicle(),
        noise=scenario.noise,
        vehicles=scenario.vehicles,
        randomize=scenario.randomize,
        max_episode_steps=scenario.steps,
    )


def find_limit(
    controller: Any, scenario: Scenario, backend: str = "batch", own: Mapping[str, Any] | None = None
) -> HitLimit | None:
    """The least factor of a scenario's wrenches, force and torque alike, at which half of the flights are lost.

    A grid of factors from 0 to ``hit_search.largest`` is flown first, so that survival need not fall evenly; then the interval
    in which it first drops to a half is divided again and again, until it is narrower than ``hit_search.resolution`` of its
    upper end. All factors see the same episodes.

    :param own: as for :func:`fly_scenario`.
    :return: None for a scenario without ``hit_search``.
    :raises ControllerError: a controller that fails in flight.
    """
    search = scenario.hit_search
    if search is None:
        return None
    seeds = scenario.episode_seeds(search.episodes)
    tried: dict[float, Estimate] = {}
    low, high = 0.0, search.largest
    grid = np.linspace(low, high, FIRST_GRID + 1)
    for _ in range(MAX_ROUNDS):
        factors = np.repeat(grid, search.episodes)
        flights, _ = fly_scenario(controller, scenario, backend, seeds * grid.size, factors, own=own)
        survived = flights.survival.reshape(grid.size, search.episodes)
        tried |= {factor: share(row) for factor, row in zip(grid.tolist(), survived, strict=True)}
        lost = next((factor for factor in sorted(tried) if tried[factor].value <= 0.5), None)
        if lost is None:
            break
        low, high = max((factor for factor in tried if factor < lost), default=0.0), lost
        if high - low <= search.resolution * high:
            break
        grid = np.linspace(low, high, GRID + 1)[1:-1]
    factor = lost
    if lost is not None and low < high:  # where the line between the two shares passes a half
        above, below = tried[low].value, tried[high].value
        factor = low + (high - low) * (above - 0.5) / (above - below)
    end, nominal = np.inf if lost is None else lost, scenario.nominal_vehicle()
    return HitLimit(
        factor=factor,
        low=max((each for each in tried if tried[each].low > 0.5 and each < end), default=0.0),
        high=min((each for each in tried if tried[each].high < 0.5 and each >= end), default=None),
        force=max(wrench.force.largest * wrench.units(nominal)[0] for wrench in scenario.wrenches),
        torque=max(wrench.torque.largest * wrench.units(nominal)[1] for wrench in scenario.wrenches),
        trials=[HitTrial(factor=each, survived=tried[each]) for each in sorted(tried)],
    )
