"""The gains of the geometric expert, as in a vehicle's YAML."""

import numpy as np

from sb3_quad.base.types import FloatArray, StrDict
from sb3_quad.base.validate import Frozen, Quantity


class GeometricGains(Frozen):
    """The named gains of :class:`~sb3_quad.experts.geometric.GeometricExpert`.

    They are ``geometric_gains`` in a vehicle's YAML.
    """

    position: Quantity
    """desired speed per horizontal error near the target, 1/s"""
    velocity: Quantity
    """acceleration per error of horizontal velocity, 1/s"""
    height_position: Quantity
    """desired speed per height error near the target, 1/s"""
    height_velocity: Quantity
    """acceleration per error of vertical velocity, 1/s"""
    deceleration: Quantity
    """horizontal deceleration that the approach plans with, m/s²"""
    height_deceleration: Quantity
    """vertical deceleration planned from below, m/s²"""
    descent: Quantity
    """greatest desired acceleration downwards, below g, m/s²"""
    tilt: Quantity
    """tangent of the tilt at which the greatest desired force keeps the height"""
    attitude: Quantity
    """desired body rate per small angle of thrust direction error, 1/s"""
    angular_deceleration: Quantity
    """angular deceleration that a turn plans with, rad/s²"""
    body_rates: Quantity
    """angular acceleration per error of roll and pitch rate, 1/s"""
    yaw_rate: Quantity
    """angular deceleration per yaw rate, 1/s"""
    # Less than from below, so that an agent that imitates it inexactly does not overshoot.
    descent_deceleration: Quantity
    """vertical deceleration planned from above, m/s²"""
    measured: StrDict | None = None
    """what these gains reached on fresh episodes when they were found"""

    def values(self) -> FloatArray:
        """Return the gains alone, in the order of the fields."""
        return np.array([getattr(self, name) for name in GAIN_NAMES])


GAIN_NAMES = tuple(name for name in GeometricGains.model_fields if name != "measured")
