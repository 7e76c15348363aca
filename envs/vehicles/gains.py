"""The gains of the geometric expert, as in a vehicle's YAML."""

import numpy as np
from pydantic import PositiveFloat

from sb3_quad.base.types import FloatArray, StrDict
from sb3_quad.base.validate import Frozen


class GeometricGains(Frozen):
    """The named gains of :class:`~sb3_quad.experts.geometric.GeometricExpert`.

    They are ``geometric_gains`` in a vehicle's YAML.
    """

    position: PositiveFloat
    """desired speed per horizontal error near the target, 1/s"""
    velocity: PositiveFloat
    """acceleration per error of horizontal velocity, 1/s"""
    height_position: PositiveFloat
    """desired speed per height error near the target, 1/s"""
    height_velocity: PositiveFloat
    """acceleration per error of vertical velocity, 1/s"""
    deceleration: PositiveFloat
    """horizontal deceleration that the approach plans with, m/s²"""
    height_deceleration: PositiveFloat
    """vertical deceleration planned from below, m/s²"""
    descent: PositiveFloat
    """greatest desired acceleration downwards, below g, m/s²"""
    tilt: PositiveFloat
    """tangent of the tilt at which the greatest desired force keeps the height"""
    attitude: PositiveFloat
    """desired body rate per small angle of thrust direction error, 1/s"""
    angular_deceleration: PositiveFloat
    """angular deceleration that a turn plans with, rad/s²"""
    body_rates: PositiveFloat
    """angular acceleration per error of roll and pitch rate, 1/s"""
    yaw_rate: PositiveFloat
    """angular deceleration per yaw rate, 1/s"""
    # Less than from below, so that an agent that imitates it inexactly does not overshoot.
    descent_deceleration: PositiveFloat
    """vertical deceleration planned from above, m/s²"""
    measured: StrDict | None = None
    """what these gains reached on fresh episodes when they were found"""

    def values(self) -> FloatArray:
        """Return the gains alone, in the order of the fields."""
        return np.array([getattr(self, name) for name in GAIN_NAMES])


GAIN_NAMES = tuple(name for name in GeometricGains.model_fields if name != "measured")
