"""One flight as it is shown: every control step, flown in the reference environment by any controller."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from sb3_quad.base.arrays import FloatArray
from sb3_quad.drawing.models import rotor_turning
from sb3_quad.drawing.scene import Pose
from sb3_quad.evaluation.flights import Hook, fly_settings
from sb3_quad.experts.controller import observation_function
from sb3_quad.scenarios.sample import Plan
from sb3_quad.settings.flight import FlightSettings
from sb3_quad.simulation.state import POSITION, TARGET, QuadcopterState
from sb3_quad.vehicles.vehicle import Vehicle


@dataclass(frozen=True, eq=False)
class Recording:
    """A flight of T control steps."""

    name: str
    vehicle: Vehicle
    times: FloatArray  # (T + 1,), s since the start
    state: FloatArray  # (STATE_SIZE, T + 1), the true state, laid out as in sb3_quad.simulation.state
    wrench: FloatArray  # (12, T + 1), of the step before: force in the world and in the body frame, N; torques likewise, N m
    reward: float  # sum of the rewards
    lost: str  # how it was lost: "collision", "out of range", or empty

    @property
    def error(self) -> FloatArray:
        """|r - r_T|, (T + 1,), m."""
        return np.asarray(np.linalg.norm(self.state[POSITION] - self.state[TARGET], axis=0))

    @property
    def path(self) -> FloatArray:
        """r, (T + 1, 3), world frame, m."""
        return self.state[POSITION].T

    @cached_property
    def rotor_angles(self) -> FloatArray:
        """How far the drawn rotors have turned, (4, T + 1), rad."""
        return np.cumsum(rotor_turning(self.vehicle, self.state), axis=1) * self.vehicle.control_step

    @property
    def landmarks(self) -> FloatArray:
        """The points by which a camera's direction is chosen, (n, 3), m."""
        return np.concatenate([self.path[::5], self.targets])

    @property
    def targets(self) -> FloatArray:
        """The targets flown to, one after the other, (k, 3), world frame, m."""
        targets = self.state[TARGET].T
        changed = np.flatnonzero((np.diff(targets, axis=0) != 0).any(axis=1)) + 1
        return np.asarray(targets[[0, *changed]])

    @property
    def pushes(self) -> list[int]:
        """The steps after which a wrench has begun to act."""
        acts = np.asarray(np.any(self.wrench != 0.0, axis=0))
        return (np.flatnonzero(acts[1:] & ~acts[:-1]) + 1).tolist()

    def wrench_around(self, step: int, seconds: float = 0.4) -> FloatArray:
        """The largest force and torque, (12,), of the last while before ``step``: a short blow stays to be seen."""
        first = max(0, step - round(seconds / self.vehicle.control_step))
        recent = self.wrench[:, first : step + 1]
        return np.asarray(recent[:, int(np.argmax(np.linalg.norm(recent, axis=0)))])

    def vehicle_and_target(self, step: int) -> FloatArray:
        """Where both are, (2, 3), world frame, m."""
        return np.stack([self.state[POSITION, step], self.state[TARGET, step]])

    def pose(self, step: int, seconds: float = 0.4) -> Pose:
        """The vehicle as it is to be drawn, with the wrench of the last ``seconds``."""
        return Pose(self.state[:, step], self.wrench_around(step, seconds), self.rotor_angles[:, step])

    def at(self, seconds: float) -> int:
        """The index of the last state not later than ``seconds``."""
        return max(0, int(np.searchsorted(self.times, seconds + 1e-9, side="right")) - 1)


def record(
    name: str,
    controller: Any,
    settings: FlightSettings,
    seed: int,
    plan: Plan | None = None,
    deterministic: bool = True,
) -> Recording:
    """Fly one episode on PyBullet and write it all down.

    :param controller: as of :func:`~sb3_quad.evaluation.flights.fly`.
    :param plan: what happens whoever flies; of one episode.
    :param deterministic: whether a policy gives the mean of its actions, or a sample of them.
    :raises ConfigError: a controller that cannot be asked, settings that the environment refuses.
    :raises ControllerError: a controller that fails in flight.
    """
    flown = controller if deterministic or not hasattr(controller, "predict") else observation_function(controller, False)
    recorder = _EveryStep()
    flights = fly_settings(flown, settings, [seed], "pybullet", (), [recorder], plan)
    lost = "" if flights.success[0] else "collision" if flights.collision[0] else "out of range"
    states, wrenches = np.stack(recorder.states, axis=1), np.stack(recorder.wrenches, axis=1)
    times = np.arange(states.shape[1], dtype=np.float64) * recorder.vehicle.control_step
    return Recording(name, recorder.vehicle, times, states, wrenches, float(flights.reward[0]), lost)


class _EveryStep(Hook):
    """Keeps all there is of one flight, its last state included."""

    def __init__(self) -> None:
        self.states: list[FloatArray] = []
        self.wrenches: list[FloatArray] = [np.zeros(12)]

    def on_start(self, state: QuadcopterState, vehicle: Vehicle) -> None:
        self.vehicle = vehicle
        self.states.append(state.array[:, 0].copy())

    def before_step(self, state: QuadcopterState, observation: Any, wrench: FloatArray, flying: Any) -> None:
        self.wrenches.append(wrench[0].copy())

    def after_step(self, step: int, state: QuadcopterState, actions: Any, flying: Any) -> None:
        self.states.append(state.array[:, 0].copy())
