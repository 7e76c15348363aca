"""What is flown to be shown: episodes that are the same for all controllers."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from sb3_quad.base.errors import ConfigError, ControllerError, unknown
from sb3_quad.base.validate import validate
from sb3_quad.envs.registration import MAX_EPISODE_STEPS
from sb3_quad.evaluation.flights import Plan
from sb3_quad.scenarios.load import load_suite
from sb3_quad.scenarios.parts import Wrench
from sb3_quad.scenarios.sample import Generators, sample_episodes, sample_wrenches
from sb3_quad.scenarios.scenario import Scenario
from sb3_quad.show.agents import check_keywords
from sb3_quad.show.recording import Recording, record
from sb3_quad.simulation.checks import vector
from sb3_quad.simulation.tasks import resolve_tasks
from sb3_quad.vehicles.vehicle import Vehicle, load_vehicle


@dataclass(frozen=True, eq=False)
class Setting:
    """What all controllers fly: keywords of the environment with a fixed target and wrench, or a scenario.

    :param known_vehicle: what experts and factories are told of.
    :param n_steps: control steps of an episode.
    """

    known_vehicle: Any
    n_steps: int
    keywords: Mapping[str, Any]
    plan: Plan
    scenario: Scenario | None = None

    @staticmethod
    def from_keywords(
        keywords: Mapping[str, Any], target: Sequence[float] | None = None, wrench: Wrench | None = None
    ) -> Setting:
        """A setting from the keywords of the environment.

        :param target: r_T, (3,), m; None: the episode's own.
        :raises ConfigError: an unknown keyword, task or vehicle, a target that is none.
        """
        given = dict(keywords)
        check_keywords(given)
        n_steps = given.pop("max_episode_steps", MAX_EPISODE_STEPS)
        if isinstance(n_steps, bool) or not isinstance(n_steps, int) or n_steps < 1:
            raise ConfigError(f"max_episode_steps {n_steps!r}: must be a whole number of at least 1")
        resolve_tasks(given["task"], given.get("task_kwargs"))
        vehicle = load_vehicle(given.get("vehicle", "itm"))
        start = {} if target is None else {"target": _target(target, vehicle)[None]}
        wrenches = [] if wrench is None else [wrench]
        plan = Plan(start, sample_wrenches(wrenches, vehicle, n_steps, Generators([0])))
        return Setting(vehicle, n_steps, given, plan)

    def fly(self, name: str, controller: Any, seed: int, n_steps: int, deterministic: bool) -> Recording:
        """One episode.

        :param n_steps: control steps, at most.
        :raises ConfigError: keywords that the environment refuses.
        :raises ControllerError: a controller that fails in flight.
        """
        if self.scenario is None:
            return record(name, controller, seed, n_steps, plan=self.plan, deterministic=deterministic, **self.keywords)
        episodes = sample_episodes(self.scenario, [seed])
        plan = Plan(episodes.start, episodes.wrenches, episodes.waypoints, episodes.radius)
        keywords: dict[str, Any] = {"task": episodes.task, "vehicle": episodes.vehicle, "noise": episodes.noise}
        return record(name, controller, seed, n_steps, plan=plan, deterministic=deterministic, **keywords)


def scenario_setting(text: str) -> Setting:
    """A scenario by ``suite:name``.

    :raises ConfigError: an unknown suite or name.
    """
    suite_name, colon, name = text.rpartition(":")
    if not colon:
        raise ConfigError(f"--scenario {text}: must be suite:name, such as thesis:side_hit")
    scenarios = {scenario.name: scenario for scenario in load_suite(suite_name).scenarios}
    if name not in scenarios:
        raise ConfigError(unknown(f"scenario of {suite_name}", name, scenarios))
    scenario = scenarios[name]
    n_steps = round(scenario.duration / scenario.flown_vehicle().control_step)
    return Setting(scenario.vehicle, n_steps, {}, Plan(), scenario)


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
    left = setting.n_steps if n_timesteps is None else n_timesteps
    if left < 1:
        raise ConfigError(f"--n-timesteps {left}: must be at least 1")
    if n_envs < 1:
        raise ConfigError(f"--n-envs {n_envs}: must be at least 1")
    number = 0
    while left > 0 and (number == 0 or n_timesteps is not None):
        steps = min(left, setting.n_steps)
        episode = [
            _fly(setting, name if n_envs == 1 else f"seed {each}, {name}", controller, each, steps, deterministic)
            for name, controller in controllers.items()
            for each in range(seed + number, seed + number + n_envs)
        ]
        yield episode
        left -= max(len(recording.times) - 1 for recording in episode)
        number += n_envs


def _fly(setting: Setting, name: str, controller: Any, seed: int, n_steps: int, deterministic: bool) -> Recording:
    try:
        return setting.fly(name, controller, seed, n_steps, deterministic)
    except ControllerError as error:
        raise ControllerError(f"controller {name}: {error}") from error


def _target(target: Sequence[float], vehicle: Vehicle) -> npt.NDArray[np.float64]:
    position = vector("--target", target, 3)
    if position[2] <= vehicle.collision_radius:
        raise ConfigError(f"--target {list(target)}: lies below ground; z must exceed {vehicle.collision_radius:g} m")
    return np.asarray(position)
