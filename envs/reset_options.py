"""``options`` of ``QuadcopterEnv.reset``: a fixed target, and parts of a fixed start."""

from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, Field, field_validator

from sb3_quad.base.arrays import FloatArray
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.validate import Frozen, validate
from sb3_quad.simulation.settings import AsList
from sb3_quad.simulation.state import BODY_RATES, POSITION, QUATERNION, TARGET, VELOCITY
from sb3_quad.vehicles.vehicle import Vehicle

Vector = Annotated[tuple[float, float, float], AsList]


class Start(Frozen):
    """The parts of the state that are fixed; what is left out is sampled."""

    position: Vector | None = Field(default=None, description="world frame, m; above the ground")
    quaternion: Annotated[tuple[float, float, float, float], AsList] | None = Field(
        default=None, description="(w, x, y, z), body to world; is normalised"
    )
    velocity: Vector | None = Field(default=None, description="world frame, m/s")
    body_rates: Vector | None = Field(default=None, description="body frame, rad/s")

    @field_validator("quaternion")
    @classmethod
    def _is_a_turn(cls, value: tuple[float, ...] | None) -> tuple[float, ...] | None:
        if value is not None and np.linalg.norm(value) < 1e-6:
            raise ValueError("must not be zero")
        return value


class ResetOptions(Frozen):
    """What ``options`` may hold."""

    target: Vector | None = Field(default=None, description="r_T, world frame, m")
    state: Annotated[Start, BeforeValidator(lambda state: state or {})] = Field(
        default=Start(), description="any of position, quaternion, velocity, body_rates"
    )


def fixed_rows(options: Any, vehicle: Vehicle) -> list[tuple[slice, FloatArray]]:
    """The rows of the state that ``options`` fix, and their values.

    :raises ConfigError: an unknown key, a value that does not fit, or a position that touches the ground.
    """
    given = validate(ResetOptions, options or {}, "options")
    start = given.state
    if start.position is not None and start.position[2] <= vehicle.collision_radius:
        raise ConfigError(f"position {[*start.position]}: touches the ground; z must exceed {vehicle.collision_radius} m")
    quaternion = None if start.quaternion is None else np.array(start.quaternion) / np.linalg.norm(start.quaternion)
    fixed: list[tuple[slice, Any]] = [
        (TARGET, given.target),
        (POSITION, start.position),
        (QUATERNION, quaternion),
        (VELOCITY, start.velocity),
        (BODY_RATES, start.body_rates),
    ]
    return [(rows, np.array(values)) for rows, values in fixed if values is not None]
