"""One flight as it is shown: every control step of it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sb3_quad.base.arrays import FloatArray
from sb3_quad.drawing.models import rotor_turning
from sb3_quad.drawing.scene import Pose
from sb3_quad.simulation.state import QuadcopterState
from sb3_quad.vehicles.vehicle import Vehicle


@dataclass(frozen=True, eq=False)
class Recording:
    """A flight of T control steps."""

    name: str
    colour: str  # of its trail and its heading, #rrggbb
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
