"""What is flown to be shown, by whom, and how it is recorded: the same episodes for all
controllers, on PyBullet.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from sb3_quad.base.arrays import BoolArray, Float32Array, FloatArray
from sb3_quad.base.colours import COLOURS
from sb3_quad.base.errors import ConfigError, ControllerError
from sb3_quad.envs.rendering.models import rotor_turning
from sb3_quad.envs.rendering.scene import Pose
from sb3_quad.evaluation.flights import Hook, fly_settings
from sb3_quad.evaluation.scenarios.load import load_suite
from sb3_quad.evaluation.scenarios.sample import Plan, sample_plan
from sb3_quad.simulation.checks import per_row
from sb3_quad.simulation.settings import FlightSettings
from sb3_quad.simulation.state import WRENCH_SIZE, QuadcopterState
from sb3_quad.vehicles.vehicle import Vehicle, first_vehicle


@dataclass(frozen=True, eq=False)
class Recording:
    """A flight of T control steps."""

    name: str
    colour: str  # of its trail and its heading, #rrggbb
    vehicle: Vehicle
    times: FloatArray  # (T + 1,), s since the start
    state: QuadcopterState  # the true state at each of them
    # (T + 1, 12), of the step before: force in the world and in the body frame, N; torques
    # likewise, N m
    wrench: FloatArray
    reward: float  # sum of the rewards
    lost: str  # how it was lost: "collision", "out of range", or empty

    @cached_property
    def rotor_angles(self) -> FloatArray:
        """How far the drawn rotors have turned, (T + 1, 4), rad."""
        return (
            np.cumsum(rotor_turning(self.vehicle, self.state.rotor_speeds), axis=0)
            * self.vehicle.control_step
        )

    @property
    def targets(self) -> FloatArray:
        """The targets flown to, one after the other, (k, 3), world frame, m."""
        changed = np.diff(self.state.target, axis=0, prepend=np.nan).any(axis=1)
        return self.state.target[changed]

    @property
    def landmarks(self) -> FloatArray:
        """The points by which a camera's direction is chosen, (n, 3), m."""
        return np.concatenate([self.state.position[::5], self.targets])

    @property
    def pushes(self) -> list[int]:
        """The steps after which a wrench has begun to act."""
        acts = np.asarray(self.wrench.any(axis=1))
        return (np.flatnonzero(acts[1:] & ~acts[:-1]) + 1).tolist()

    def at(self, seconds: float) -> int:
        """The index of the last state not later than ``seconds``."""
        return max(0, int(np.searchsorted(self.times, seconds + 1e-9, side="right")) - 1)

    def vehicle_and_target(self, step: int) -> FloatArray:
        """Where both are, (2, 3), world frame, m."""
        return np.stack([self.state.position[step], self.state.target[step]])

    def wrench_around(self, step: int, seconds: float = 0.4) -> FloatArray:
        """The largest force and torque, (12,), of the last while before ``step``: a short blow
        stays to be seen.
        """
        recent = self.wrench[max(0, step - round(seconds / self.vehicle.control_step)) : step + 1]
        return np.asarray(recent[np.linalg.norm(recent, axis=1).argmax()])

    def pose(self, step: int, seconds: float = 0.4) -> Pose:
        """The vehicle as it is to be drawn, with the wrench of the last ``seconds``."""
        return Pose(
            self.state.array[:, step], self.wrench_around(step, seconds), self.rotor_angles[step]
        )


class Setting(NamedTuple):
    """What all controllers fly."""

    vehicle: Any  # that experts are made for; in a scenario another one may fly
    settings: FlightSettings  # how all episodes are flown
    plan: Callable[[int], Plan]  # what happens in an episode, by its seed
    own: Mapping[
        str, Mapping[str, Any]
    ] = {}  # changes to the settings that go with a controller, by its label


def fixed_setting(settings: FlightSettings, target: Sequence[float] | None = None) -> Setting:
    """Episodes of some settings.

    :param target: of all of them, r_T, (3,), m; None: each episode's own.
    :raises ConfigError: an unknown vehicle, a target below ground.
    """
    start, least = {}, first_vehicle(settings.vehicle).collision_radius
    if target is not None:
        start["target"] = per_row("--target", target, 1, 3).T
        if target[2] <= least:
            raise ConfigError(
                f"--target {list(target)}: lies below ground; z must exceed {least:g} m"
            )
    return Setting(settings.vehicle, settings, lambda seed: Plan(start))


def scenario_setting(text: str, own: Any = None) -> Setting:
    """Episodes of a scenario, named by ``suite:name``.

    :param own: the vehicle of an agent, for a scenario that names none.
    :raises ConfigError: an unknown suite or name.
    """
    suite, colon, name = text.rpartition(":")
    if not colon:
        raise ConfigError(f"--scenario {text}: must be suite:name, such as thesis:side_hit")
    scenario = load_suite(suite).scenario(name).flown_by(own)
    return Setting(
        scenario.nominal_vehicle(), scenario.flown_as, lambda seed: sample_plan(scenario, [seed])
    )


def fly_all(
    controllers: Mapping[str, Any],
    setting: Setting,
    seed: int,
    n_timesteps: int | None,
    deterministic: bool = True,
    n_envs: int = 1,
) -> Iterator[list[Recording]]:
    """Episodes one after the other, each flown by all controllers.

    :param controllers: by label; each as of :func:`~sb3_quad.evaluation.flights.fly`.
    :param seed: of the first episode; the next has the next one.
    :param n_timesteps: control steps, until which new episodes begin, as long as the longest of
        each lasts; None: one episode.
    :param deterministic: whether a policy gives the mean of its actions, or a sample of them.
    :param n_envs: episodes, with one seed after the other, that each controller flies side by side.
    :raises ConfigError: settings that the environment refuses.
    :raises ControllerError: a controller that fails in flight; its name comes first.
    """
    longest = setting.settings.longest_episode
    left = longest if n_timesteps is None else n_timesteps
    while left > 0:
        settings = setting.settings.with_changes(max_episode_steps=min(left, longest))
        together: list[Recording] = []
        for name, controller in controllers.items():
            for each in range(seed, seed + n_envs):
                label, colour = (
                    name if n_envs == 1 else f"seed {each}, {name}",
                    COLOURS[len(together) % len(COLOURS)],
                )
                try:
                    its = settings.with_changes(**setting.own.get(name, {}))
                    flown = controller, its, setting.plan(each), each, deterministic
                    together.append(_record(label, colour, *flown))
                except ControllerError as error:
                    raise ControllerError(f"controller {label}: {error}") from error
        yield together
        if n_timesteps is None:
            return
        left -= max(len(recording.times) - 1 for recording in together)
        seed += n_envs


def _record(
    name: str,
    colour: str,
    controller: Any,
    settings: FlightSettings,
    plan: Plan,
    seed: int,
    deterministic: bool,
) -> Recording:
    every = _EveryStep()
    flights = fly_settings(
        controller, settings, [seed], "pybullet", (), [every], plan, deterministic
    )
    return Recording(
        name=name,
        colour=colour,
        vehicle=every.vehicle,
        times=np.arange(len(every.states), dtype=np.float64) * every.vehicle.control_step,
        state=QuadcopterState.concatenate(every.states),
        wrench=np.stack([np.zeros(WRENCH_SIZE), *every.wrenches]),
        reward=float(flights.reward[0]),
        lost="" if flights.survival[0] else "collision" if flights.collision[0] else "out of range",
    )


class _EveryStep(Hook):
    """Keeps the state after every control step of a flight, and before the first, and the wrench in
    each.
    """

    def on_start(self, state: QuadcopterState, vehicle: Vehicle) -> None:
        self.vehicle, self.states = vehicle, [state.copy()]
        self.wrenches: list[FloatArray] = []

    def before_step(
        self,
        state: QuadcopterState,
        observation: Float32Array,
        wrench: FloatArray,
        flying: BoolArray,
    ) -> None:
        self.wrenches.append(wrench[0].copy())

    def after_step(
        self, step: int, state: QuadcopterState, actions: Float32Array, flying: BoolArray
    ) -> None:
        self.states.append(state.copy())
