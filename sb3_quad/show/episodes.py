"""What is flown to be shown: episodes that are the same for all controllers."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from sb3_quad.base.errors import ConfigError, ControllerError, unknown
from sb3_quad.envs.registration import MAX_EPISODE_STEPS
from sb3_quad.evaluation.flights import Plan
from sb3_quad.scenarios.draw import DrawnWrench, draw_episodes, wrench_changes
from sb3_quad.scenarios.load import explain, load_suite
from sb3_quad.scenarios.parts import Wrench
from sb3_quad.scenarios.scenario import Scenario
from sb3_quad.show.recording import Recording, record
from sb3_quad.simulation.checks import vector
from sb3_quad.simulation.tasks import resolve_tasks
from sb3_quad.vehicles.vehicle import Vehicle, load_vehicle

# Of the keywords of an environment, those that a flight to be shown can have.
KEYWORDS = ("task", "task_kwargs", "vehicle", "noise", "observation_std", "max_episode_steps")


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
        for key in given:
            if key not in KEYWORDS:
                raise ConfigError(f"env_kwargs {key}: enjoy can set {', '.join(KEYWORDS)}")
        n_steps = given.pop("max_episode_steps", MAX_EPISODE_STEPS)
        if isinstance(n_steps, bool) or not isinstance(n_steps, int) or n_steps < 1:
            raise ConfigError(f"max_episode_steps {n_steps!r}: must be a whole number of at least 1")
        resolve_tasks(given["task"], given.get("task_kwargs"))
        vehicle = load_vehicle(given.get("vehicle", "itm"))
        start = {} if target is None else {"target": _target(target, vehicle)[None]}
        wrenches = {} if wrench is None else wrench_changes([_drawn(wrench, vehicle, n_steps)], n_steps)
        return Setting(vehicle, n_steps, given, Plan(start, wrenches))

    def fly(self, name: str, controller: Any, seed: int, n_steps: int, deterministic: bool) -> Recording:
        """One episode.

        :param n_steps: control steps, at most.
        :raises ConfigError: keywords that the environment refuses.
        :raises ControllerError: a controller that fails in flight.
        """
        if self.scenario is None:
            return record(name, controller, seed, n_steps, plan=self.plan, deterministic=deterministic, **self.keywords)
        drawn = draw_episodes(self.scenario, [seed])
        wrenches = wrench_changes(drawn.wrenches, drawn.steps) if drawn.wrenches else {}
        plan = Plan(drawn.start, wrenches, drawn.waypoints, drawn.radius)
        keywords: dict[str, Any] = {"task": drawn.task, "vehicle": drawn.vehicle, "noise": drawn.noise}
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
    zero = (0.0, 0.0, 0.0)
    try:
        return Wrench.model_validate({"start": start, "duration": duration, "force": force or zero, "torque": torque or zero})
    except ValidationError as error:
        raise ConfigError(explain(error, Wrench)) from None


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


def _drawn(wrench: Wrench, vehicle: Vehicle, n_steps: int) -> DrawnWrench:
    values = np.zeros((1, 12))
    values[0, 0:3], values[0, 9:12] = wrench.force.value, wrench.torque.value
    first = round(wrench.start / vehicle.control_step)
    steps = n_steps if wrench.duration is None else max(1, round(wrench.duration / vehicle.control_step))
    return DrawnWrench(first, first + steps, values)
