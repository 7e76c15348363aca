"""The gains of the geometric expert in a vehicle's YAML, and the results of flights with them."""

from typing import Any

import numpy as np
from pydantic import Field, PositiveFloat

from sb3_quad.base.arrays import FloatArray
from sb3_quad.base.validate import Frozen


class GeometricGains(Frozen):
    """The named gains of :class:`~sb3_quad.experts.geometric.GeometricExpert`; ``geometric_gains``
    in a vehicle's YAML.
    """

    position: PositiveFloat = Field(
        description="desired speed per horizontal error near the target, 1/s"
    )
    velocity: PositiveFloat = Field(
        description="acceleration per error of horizontal velocity, 1/s"
    )
    height_position: PositiveFloat = Field(
        description="desired speed per height error near the target, 1/s"
    )
    height_velocity: PositiveFloat = Field(
        description="acceleration per error of vertical velocity, 1/s"
    )
    deceleration: PositiveFloat = Field(
        description="horizontal deceleration that the approach plans with, m/s²"
    )
    height_deceleration: PositiveFloat = Field(
        description="vertical deceleration planned from below, m/s²"
    )
    descent: PositiveFloat = Field(
        description="greatest desired acceleration downwards, below g, m/s²"
    )
    tilt: PositiveFloat = Field(
        description="tangent of the tilt at which the greatest desired force holds the height"
    )
    attitude: PositiveFloat = Field(
        description="desired body rate per small angle of thrust direction error, 1/s"
    )
    angular_deceleration: PositiveFloat = Field(
        description="angular deceleration that a turn plans with, rad/s²"
    )
    body_rates: PositiveFloat = Field(
        description="angular acceleration per error of roll and pitch rate, 1/s"
    )
    yaw_rate: PositiveFloat = Field(description="angular deceleration per yaw rate, 1/s")
    descent_deceleration: PositiveFloat = Field(
        description="vertical deceleration planned from above, m/s²; less, so that an agent that"
        " imitates the expert imprecisely does not overshoot"
    )
    measured: dict[str, Any] | None = Field(
        default=None,
        description="results of flights with these gains, from ``measure_expert`` in"
        " examples/tune_expert.py",
    )

    def values(self) -> FloatArray:
        """Return the gains alone, in the order of the fields."""
        return np.array([getattr(self, name) for name in GAIN_NAMES])


GAIN_NAMES = tuple(name for name in GeometricGains.model_fields if name != "measured")
