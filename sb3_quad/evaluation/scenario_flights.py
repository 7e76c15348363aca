"""Flying the episodes of a scenario."""

from collections.abc import Mapping, Sequence
from typing import Any

from sb3_quad.base.arrays import Arrays
from sb3_quad.evaluation.flightlog import Recorder
from sb3_quad.evaluation.flights import Flights, fly_settings
from sb3_quad.evaluation.scenarios.sample import sample_plan
from sb3_quad.evaluation.scenarios.scenario import Scenario
from sb3_quad.simulation.settings import FlightSettings

PART_SIZES = {"batch": 4096, "pybullet": 240}  # episodes side by side
RECORDED_FIXED, RECORDED_RANDOM = 24, 8  # flights whose trajectories are kept, at most


def fly_scenario(
    controller: Any,
    scenario: Scenario,
    backend: str = "batch",
    seeds: Sequence[int] | None = None,
    recorded: int | None = 0,
    own: Mapping[str, Any] | None = None,
) -> tuple[Flights, Arrays]:
    """Fly a scenario's episodes; the same ones for every controller and either backend.

    :param controller: as of :func:`~sb3_quad.evaluation.flights.fly`.
    :param seeds: of the episodes; None: the scenario's own.
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
        plan = sample_plan(scenario, chosen[part])
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
