"""Flying the episodes of a scenario."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from sb3_quad.base.errors import ConfigError, unknown
from sb3_quad.evaluation.fleets import FLEETS
from sb3_quad.evaluation.flightlog import Arrays, Recorder
from sb3_quad.evaluation.flights import Flights, Plan, fly_fleet
from sb3_quad.scenarios.sample import sample_episodes
from sb3_quad.scenarios.scenario import Scenario

PART_SIZES = {"batch": 4096, "pybullet": 240}  # episodes side by side
RECORDED_FIXED, RECORDED_RANDOM = 24, 8  # flights whose trajectories are kept, at most


def fly_scenario(
    controller: Any,
    scenario: Scenario,
    backend: str = "batch",
    seeds: Sequence[int] | None = None,
    factors: npt.NDArray[np.float64] | None = None,
    recorded: int | None = 0,
) -> tuple[Flights, Arrays]:
    """Fly a scenario's episodes; the same ones for every controller and either backend.

    :param controller: as of :func:`~sb3_quad.evaluation.flights.fly`.
    :param seeds: of the episodes; None: the scenario's own.
    :param factors: of each episode's wrenches, (n,); None: 1.
    :param recorded: flights to sample; None: all of a scenario that is the same each time, the first few of others.
    :return: the figures, and the trajectories (``flightlog.py``) of the first ``recorded`` flights.
    :raises ConfigError: an unknown backend, or a controller that cannot be asked.
    :raises ControllerError: a controller that fails in flight.
    """
    if backend not in FLEETS:
        raise ConfigError(unknown("backend", backend, FLEETS))
    chosen = range(scenario.seed, scenario.seed + scenario.episodes) if seeds is None else seeds
    if recorded is None:
        recorded = RECORDED_FIXED if scenario.is_fixed else RECORDED_RANDOM
    size = PART_SIZES[backend]
    parts, trajectories = [], None
    for first in range(0, len(chosen), size):
        part = slice(first, first + size)
        episodes = sample_episodes(scenario, chosen[part], None if factors is None else factors[part])
        recorder = Recorder(min(recorded, len(episodes.seeds)), episodes.steps) if recorded and first == 0 else None
        plan = Plan(episodes.start, episodes.wrenches, episodes.waypoints, episodes.radius)
        fleet = FLEETS[backend](episodes.seeds, episodes.task, None, episodes.vehicle, episodes.noise, episodes.steps)
        try:
            parts.append(fly_fleet(fleet, controller, plan, episodes.steps, scenario.tolerances, recorder))
        finally:
            fleet.close()
        trajectories = recorder.arrays() if recorder is not None else trajectories
    return Flights.concatenate(parts), trajectories or {}
