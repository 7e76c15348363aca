"""The events of a scenario: how its episodes start, beyond what their task samples, and the forces
and torques that act on them. Units are SI, angles in degrees where noted.
"""

from typing import Literal

from pydantic import Field, NonNegativeFloat, PositiveFloat, model_validator

from sb3_quad.base.validate import Frozen
from sb3_quad.envs.batch_env import Quaternion, Vector

Frame = Literal["world", "body"]


class RandomDirection(Frozen):
    """A vector of a given length whose direction is uniformly random in each episode."""

    magnitude: NonNegativeFloat
    """length, in the unit of the quantity"""


class Start(Frozen):
    """How an episode starts; what you do not give comes from the task. Rotors turn at hover
    speed.
    """

    quaternion: Quaternion | None = None
    """attitude: w, x, y, z, body to world; is normalised"""
    tilt: float | None = Field(default=None, ge=0, le=180)
    """instead, the angle between body z and world z, deg; about a random horizontal axis"""
    velocity: Vector | RandomDirection | None = None
    """m/s: [x, y, z] or {magnitude: …}"""
    velocity_frame: Frame = "world"
    """world or body: the axes of velocity"""
    body_rates: Vector | RandomDirection | None = None
    """body frame, rad/s: [x, y, z] or {magnitude: …}"""

    @model_validator(mode="after")
    def _turnable(self) -> "Start":
        if self.quaternion is not None and self.tilt is not None:
            raise ValueError("tilt: give it or quaternion, not both")
        is_given = self.velocity is not None and self.sets_attitude
        if self.velocity_frame == "body" and not is_given:
            raise ValueError("velocity_frame: body needs velocity, and quaternion or tilt")
        return self

    @property
    def sets_attitude(self) -> bool:
        """Whether the attitude is not the task's."""
        return self.quaternion is not None or self.tilt is not None


class Wrench(Frozen):
    """An external force and torque at the centre of mass for some time; several add up."""

    start: NonNegativeFloat = 0.0
    """when it begins, s"""
    duration: PositiveFloat | None = None
    """how long it acts, s; default: to the end"""
    force: Vector | RandomDirection = (0.0, 0.0, 0.0)
    """N: [x, y, z] or {magnitude: …}"""
    torque: Vector | RandomDirection = (0.0, 0.0, 0.0)
    """N m: [x, y, z] or {magnitude: …}"""
    factor: float = 1.0
    """multiplies force and torque, to vary the size of a hit"""
    force_frame: Frame = "world"
    """world or body: the axes of force"""
    torque_frame: Frame = "body"
    """world or body: the axes of torque"""

    def steps(self, control_step: float, n: int) -> range:
        """Return the control steps, of n, during which it acts.

        :param control_step: s.
        """
        first = round(self.start / control_step)
        if self.duration is None:
            return range(first, n)
        return range(first, first + round(self.duration / control_step))
