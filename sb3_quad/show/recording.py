"""One flight as it is shown: every control step, flown in the reference environment by any controller."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from sb3_quad.base.arrays import BoolArray, Float32Array, FloatArray
from sb3_quad.drawing.models import rotor_turning
from sb3_quad.drawing.scene import Pose
from sb3_quad.evaluation.flights import Hook, Plan, fly_settings
from sb3_quad.experts.controller import observation_function
from sb3_quad.settings.flight import FlightSettings
from sb3_quad.simulation.state import WRENCH_SIZE, QuadcopterState
from sb3_quad.vehicles.vehicle import Vehicle


@dataclass(frozen=True, eq=False)
class Recording:
    """A flight of T control steps."""

    name: str
    vehicle: Vehicle
    times: FloatArray  # (T + 1,), s since the start
    state: QuadcopterState  # the true state at each of them
    wrench: FloatArray  # (T + 1, 12), of the step before: force in the world and in the body frame, N; torques likewise, N m
    reward: float  # sum of the rewards
    lost: str  # how it was lost: "collision", "out of range", or empty

    @cached_property
    def rotor_angles(self) -> FloatArray:
        """How far the drawn rotors have turned, (T + 1, 4), rad."""
        return np.cumsum(rotor_turning(self.vehicle, self.state.rotor_speeds), axis=0) * self.vehicle.control_step

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
        """The largest force and torque, (12,), of the last while before ``step``: a short blow stays to be seen."""
        recent = self.wrench[max(0, step - round(seconds / self.vehicle.control_step)) : step + 1]
        return np.asarray(recent[np.linalg.norm(recent, axis=1).argmax()])

    def pose(self, step: int, seconds: float = 0.4) -> Pose:
        """The vehicle as it is to be drawn, with the wrench of the last ``seconds``."""
        return Pose(self.state.array[:, step], self.wrench_around(step, seconds), self.rotor_angles[step])


def record(
    name: str, controller: Any, settings: FlightSettings, seed: int, plan: Plan | None = None, deterministic: bool = True
) -> Recording:
    """Fly one episode on PyBullet and write it all down.

    :param controller: as of :func:`~sb3_quad.evaluation.flights.fly`.
    :param plan: what happens whoever flies; of one episode.
    :param deterministic: whether a policy gives the mean of its actions, or a sample of them.
    :raises ConfigError: a controller that cannot be asked, settings that the environment refuses.
    :raises ControllerError: a controller that fails in flight.
    """
    plan = plan or Plan()
    flown = controller if deterministic or not hasattr(controller, "predict") else observation_function(controller, False)
    every = _EveryStep()
    flights = fly_settings(flown, settings, [seed], "pybullet", (), [every], plan)
    wrench = np.zeros((len(every.states), WRENCH_SIZE))
    for first, values in sorted(plan.wrenches.items()):
        wrench[first + 1 :] = values
    return Recording(
        name=name,
        vehicle=every.vehicle,
        times=np.arange(len(every.states), dtype=np.float64) * every.vehicle.control_step,
        state=QuadcopterState.concatenate(every.states),
        wrench=wrench,
        reward=float(flights.reward[0]),
        lost="" if flights.success[0] else "collision" if flights.collision[0] else "out of range",
    )


class _EveryStep(Hook):
    """Keeps the state after every control step of a flight, and before the first."""

    def on_start(self, state: QuadcopterState, vehicle: Vehicle) -> None:
        self.vehicle, self.states = vehicle, [state.copy()]

    def after_step(self, step: int, state: QuadcopterState, actions: Float32Array, flying: BoolArray) -> None:
        self.states.append(state.copy())
