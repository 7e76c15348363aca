"""What is flown to be shown: episodes that are the same for all controllers."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from sb3_quad.base.errors import ConfigError, ControllerError
from sb3_quad.base.validate import validate
from sb3_quad.evaluation.scenario_flights import flown_as
from sb3_quad.scenarios.load import load_suite
from sb3_quad.scenarios.parts import Wrench
from sb3_quad.scenarios.sample import Plan, sample_plan, sample_wrenches
from sb3_quad.scenarios.scenario import Scenario
from sb3_quad.settings.flight import FlightSettings
from sb3_quad.show.recording import Recording, record
from sb3_quad.simulation.checks import vector
from sb3_quad.vehicles.vehicle import Vehicle, load_vehicle


@dataclass(frozen=True, eq=False)
class Setting:
    """What all controllers fly: some settings with a fixed target and wrench, or a scenario."""

    settings: FlightSettings
    plan: Plan = field(default_factory=Plan)
    scenario: Scenario | None = None

    @staticmethod
    def fixed(settings: FlightSettings, target: Sequence[float] | None = None, wrench: Wrench | None = None) -> Setting:
        """Episodes of some settings.

        :param target: r_T, (3,), m; None: the episode's own.
        :raises ConfigError: an unknown vehicle, a target that is none.
        """
        vehicle = load_vehicle(settings.vehicle)
        start = {} if target is None else {"target": _target(target, vehicle)[None]}
        wrenches = [] if wrench is None else [wrench]
        acting = sample_wrenches(wrenches, vehicle.control_step, settings.max_episode_steps, [np.random.default_rng(0)])
        return Setting(settings, Plan(start, acting))

    @staticmethod
    def of_scenario(text: str) -> Setting:
        """A scenario by ``suite:name``.

        :raises ConfigError: an unknown suite or name.
        """
        suite, colon, name = text.rpartition(":")
        if not colon:
            raise ConfigError(f"--scenario {text}: must be suite:name, such as thesis:side_hit")
        scenario = load_suite(suite).scenario(name)
        settings = FlightSettings(vehicle=scenario.vehicle, max_episode_steps=scenario.steps)
        return Setting(settings, scenario=scenario)

    def fly(self, name: str, controller: Any, seed: int, n_steps: int, deterministic: bool) -> Recording:
        """One episode.

        :param n_steps: control steps, at most.
        :raises ConfigError: settings that the environment refuses.
        :raises ControllerError: a controller that fails in flight.
        """
        settings, plan = self.settings, self.plan
        if self.scenario is not None:
            settings, plan = flown_as(self.scenario), sample_plan(self.scenario, [seed])
        return record(name, controller, settings.with_changes(max_episode_steps=n_steps), seed, plan, deterministic)


def make_wrench(
    force: Sequence[float] | None, torque: Sequence[float] | None, start: float, duration: float | None
) -> Wrench | None:
    """A push; None if neither force nor torque is given.

    :param force: world frame, N; ``torque``: body frame, N m.
    :param start: s; ``duration``: s, None: to the end.
    :raises ConfigError: a value that is none.
    """
    if force is None and torque is None:
        return None
    given = {"start": start, "duration": duration, "force": force or (0.0, 0.0, 0.0), "torque": torque or (0.0, 0.0, 0.0)}
    return validate(Wrench, given, "the push")


def fly_all(
    controllers: Mapping[str, Any],
    setting: Setting,
    seed: int,
    n_timesteps: int | None,
    deterministic: bool,
    n_envs: int = 1,
) -> Iterator[list[Recording]]:
    """Episodes one after the other, each flown by all controllers.

    :param seed: of the first episode; the next has the next one.
    :param n_timesteps: control steps, until which new episodes begin, as long as the longest of each lasts; None: one episode.
    :param n_envs: episodes, with one seed after the other, that each controller flies side by side.
    :raises ConfigError: a number of steps or of episodes below one, keywords that the environment refuses.
    :raises ControllerError: a controller that fails in flight; its name comes first.
    """
    left = setting.settings.max_episode_steps if n_timesteps is None else n_timesteps
    if left < 1:
        raise ConfigError(f"--n-timesteps {left}: must be at least 1")
    if n_envs < 1:
        raise ConfigError(f"--n-envs {n_envs}: must be at least 1")
    number = 0
    while left > 0 and (number == 0 or n_timesteps is not None):
        steps = min(left, setting.settings.max_episode_steps)
        episode = []
        for name, controller in controllers.items():
            for each in range(seed + number, seed + number + n_envs):
                label = name if n_envs == 1 else f"seed {each}, {name}"
                try:
                    episode.append(setting.fly(label, controller, each, steps, deterministic))
                except ControllerError as error:
                    raise ControllerError(f"controller {label}: {error}") from error
        yield episode
        left -= max(len(recording.times) - 1 for recording in episode)
        number += n_envs


def _target(target: Sequence[float], vehicle: Vehicle) -> npt.NDArray[np.float64]:
    position = vector("--target", target, 3)
    if position[2] <= vehicle.collision_radius:
        raise ConfigError(f"--target {list(target)}: lies below ground; z must exceed {vehicle.collision_radius:g} m")
    return np.asarray(position)
