"""Recorded flights to be shown: the same episodes for all controllers."""

from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from sb3_quad.base.errors import ConfigError, ControllerError
from sb3_quad.base.types import BoolArray, Float32Array, FloatArray, StrMapping
from sb3_quad.envs.rendering.camera import DOWN, ON_PATH, broadside
from sb3_quad.envs.rendering.picture import MARKER, Trail
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.envs.simulation.state import QuadcopterState
from sb3_quad.envs.vehicles.vehicle import Vehicle
from sb3_quad.evaluation.flights import Flights, fly_settings
from sb3_quad.evaluation.hooks import Hook
from sb3_quad.evaluation.scenarios.load import load_suite
from sb3_quad.evaluation.scenarios.sample import Plan, sample_plan
from sb3_quad.evaluation.tables import colours_of

# The path of a target has the colour of its ball.
TARGET = "#" + bytes(MARKER).hex()


class Recording(Hook):
    """A flight of T control steps, recorded as it is flown.

    :ivar flights: the metrics of this one flight; to be set once it has been flown.

    :param colour: colour of its trail and its name, #rrggbb.
    """

    flights: Flights

    def __init__(self, name: str, colour: str) -> None:
        self.name = name
        self.colour = colour

    def on_start(self, state: QuadcopterState, vehicle: Vehicle) -> None:
        self.vehicle = vehicle
        self._states = [state.copy()]

    def after_step(
        self, step: int, state: QuadcopterState, actions: Float32Array, flying: BoolArray
    ) -> None:
        self._states.append(state.copy())

    @cached_property
    def state(self) -> QuadcopterState:
        """The true state before the first step and after each one, T + 1."""
        return QuadcopterState.concatenate(self._states)

    @property
    def lost(self) -> str:
        """How it was lost; empty if it was not."""
        if self.flights.collision[0]:
            return "crashed"
        return "" if self.flights.survival[0] else "out of range"

    @cached_property
    def times(self) -> FloatArray:
        """Seconds since the start, (T + 1,)."""
        return np.arange(self.state.n, dtype=np.float64) * self.vehicle.control_step

    @property
    def follows(self) -> bool:
        """Whether the target moves along a path."""
        return bool(self.state.target_velocity.any())

    def trails(self, step: int) -> list[Trail]:
        """The path flown until ``step``, and the whole path of a moving target."""
        # Every second step is smooth enough.
        trails = [Trail(self.state.position[: step + 1 : 2], self.colour)]
        if self.follows:
            trails.insert(0, Trail(self.state.target[::2], TARGET))
        return trails

    @property
    def end(self) -> str:
        """How it ended, in words."""
        end = self.lost or f"{self.state.distance[-1]:.3f} m from its target"
        return f"{end} after {self.times[-1]:.2f} s"

    def at(self, seconds: float | FloatArray) -> Any:
        """The index of the last state not later than ``seconds``, a number or an array."""
        return np.searchsorted(self.times, seconds + 1e-9, side="right") - 1


# The flights of all controllers with one seed
Episode: TypeAlias = Sequence[Recording]


def outlook(recordings: Episode) -> FloatArray:
    """Return the direction in which cameras look at flights, (3,), from higher up if targets move
    along paths.
    """
    points = []
    for recording in recordings:
        points += [recording.state.position, recording.state.target]
    return broadside(np.concatenate(points), ON_PATH if recordings[0].follows else DOWN)


class Setting(NamedTuple):
    """The episodes that all controllers fly."""

    settings: FlightSettings  # of all episodes
    # The events of an episode, by its seed
    plan: Callable[[int], Plan] = lambda seed: Plan()
    # Changes to the settings for a controller, by its label
    own: StrMapping = {}


def scenario_setting(
    text: str, own: FlightSettings | None = None, vehicle: str | None = None
) -> Setting:
    """Episodes of a scenario, named by ``suite:name``.

    :param own: the settings of an agent, whose vehicle flies if the scenario names none.
    :param vehicle: a vehicle that flies instead of both.
    :raises ConfigError: an unknown suite or name.
    """
    suite, colon, name = text.rpartition(":")
    if not colon:
        raise ConfigError(f"--scenario {text}: must be suite:name, such as thesis:side_hit")
    scenario = load_suite(suite).with_changes(vehicle=vehicle).scenario(name).flown_by(own)
    return Setting(scenario.settings, lambda seed: sample_plan(scenario, [seed]))


def fly_all(
    controllers: StrMapping,
    setting: Setting,
    seed: int,
    n_timesteps: int | None,
    deterministic: bool = True,
) -> Iterator[Episode]:
    """Fly episodes one after the other, each with all controllers.

    :param controllers: controllers by label, each as for :func:`~sb3_quad.evaluation.flights.fly`.
    :param seed: seed of the first episode; the next episode has the next seed.
    :param n_timesteps: control steps after which no new episode begins; each episode counts with
        its longest flight. None: one episode.
    :param deterministic: whether a policy gives the mean of its actions, or a sample of them.
    :raises ConfigError: settings that the environment refuses.
    :raises ControllerError: a controller that fails in flight; its name comes first.
    """
    # Without n_timesteps, fly one whole episode.
    longest = setting.settings.longest_episode
    left = n_timesteps or longest
    colours = colours_of([*controllers])
    while left > 0:
        settings = setting.settings.with_changes(max_episode_steps=min(left, longest))
        episode = []
        # All controllers fly the same seed, each with the observations that it was trained on.
        for name, controller in controllers.items():
            own = settings.with_changes(**setting.own.get(name, {}))
            recording = Recording(name, colours[name])
            try:
                recording.flights = fly_settings(
                    controller,
                    own,
                    [seed],
                    hooks=[recording],
                    plan=setting.plan(seed),
                    deterministic=deterministic,
                )
            except ControllerError as error:
                raise ControllerError(f"controller {name}: {error}") from error
            episode.append(recording)
        yield episode
        if n_timesteps is None:
            return
        # The longest flight counts, since the others wait for it.
        left -= max(len(recording.times) - 1 for recording in episode)
        seed += 1
