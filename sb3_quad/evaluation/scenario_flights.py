"""Flying the episodes of a scenario."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sb3_quad.base.arrays import Arrays, FloatArray
from sb3_quad.evaluation.flightlog import Recorder
from sb3_quad.evaluation.flights import Flights, fly_settings
from sb3_quad.scenarios.sample import sample_plan
from sb3_quad.scenarios.scenario import Scenario
from sb3_quad.settings.flight import FlightSettings

PART_SIZES = {"batch": 4096, "pybullet": 240}  # episodes side by side
RECORDED_FIXED, RECORDED_RANDOM = 24, 8  # flights whose trajectories are kept, at most


def fly_scenario(
    controller: Any,
    scenario: Scenario,
    backend: str = "batch",
    seeds: Sequence[int] | None = None,
    factors: FloatArray | None = None,
    recorded: int | None = 0,
) -> tuple[Flights, Arrays]:
    """Fly a scenario's episodes; the same ones for every controller and either backend.

    :param controller: as of :func:`~sb3_quad.evaluation.flights.fly`.
    :param seeds: of the episodes; None: the scenario's own.
    :param factors: of each episode's wrenches, (n,); None: 1.
    :param recorded: flights to sample; None: all of a scenario that is the same each time, the first few of others.
    :return: the metrics, and the trajectories (``flightlog.py``) of the first ``recorded`` flights.
    :raises ConfigError: an unknown backend, or a controller that cannot be asked.
    :raises ControllerError: a controller that fails in flight.
    """
    chosen = range(scenario.seed, scenario.seed + scenario.episodes) if seeds is None else seeds
    if recorded is None:
        recorded = RECORDED_FIXED if scenario.is_fixed else RECORDED_RANDOM
    size, settings = PART_SIZES.get(backend, 1), flown_as(scenario)
    parts, trajectories = [], None
    for first in range(0, len(chosen), size):
        part = slice(first, first + size)
        plan = sample_plan(scenario, chosen[part], None if factors is None else factors[part])
        recorder = Recorder(min(recorded, len(chosen[part])), scenario.steps) if recorded and first == 0 else None
        hooks = () if recorder is None else (recorder,)
        parts.append(fly_settings(controller, settings, chosen[part], backend, scenario.tolerances, hooks, plan))
        trajectories = recorder.arrays() if recorder is not None else trajectories
    return Flights.concatenate(parts), trajectories or {}


def flown_as(scenario: Scenario) -> FlightSettings:
    """How the episodes of a scenario are flown."""
    vehicle = scenario.flown_vehicle()
    return FlightSettings(task=scenario.task, vehicle=vehicle, noise=scenario.noise, max_episode_steps=scenario.steps)
