"""The gains of the geometric expert as a vehicle's YAML holds them, and how well the expert flies with them."""

from typing import Annotated, Any

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt, model_validator

from sb3_quad.base.arrays import FloatArray
from sb3_quad.base.validate import Frozen

Share = Annotated[float, Field(ge=0, le=1)]


class GeometricMetrics(Frozen):
    """What :class:`GeometricGains` reached on episodes that no search over them had seen; true state, no other noise."""

    recovery_survival: Share = Field(description="share of recovery episodes with neither collision nor out of range")
    recovery_episodes: PositiveInt = Field(description="recovery episodes flown")
    tracking_survival: Share = Field(description="share of tracking episodes with neither collision nor out of range")
    tracking_episodes: PositiveInt = Field(description="tracking episodes flown, targets 10 m away")
    time_to_0_1_m: PositiveFloat = Field(description="mean time until 0.1 m from the target, of the tracking episodes, s")
    tracking_reward: float = Field(description="mean reward of the tracking episodes (Eqs. 4.5-4.9)")
    observation_noise: NonNegativeFloat = Field(description="relative, on what the expert sees")
    seeds: tuple[int, ...] = Field(min_length=1, description="seed of each set of episodes")

    @model_validator(mode="before")
    @classmethod
    def _former_names(cls, data: Any) -> Any:  # of the zips of policies that come with the package
        return {str(key).replace("_success", "_survival"): value for key, value in dict(data).items()}


class GeometricGains(Frozen):
    """The named gains of :class:`~sb3_quad.experts.geometric.GeometricExpert`; ``geometric_gains`` in a vehicle's YAML."""

    position: PositiveFloat = Field(description="desired speed per horizontal error near the target, 1/s")
    velocity: PositiveFloat = Field(description="acceleration per error of horizontal velocity, 1/s")
    height_position: PositiveFloat = Field(description="desired speed per height error near the target, 1/s")
    height_velocity: PositiveFloat = Field(description="acceleration per error of vertical velocity, 1/s")
    deceleration: PositiveFloat = Field(description="horizontal deceleration that the approach plans with, m/s²")
    height_deceleration: PositiveFloat = Field(description="vertical deceleration planned from below, m/s²")
    descent: PositiveFloat = Field(description="greatest desired acceleration downwards, below g, m/s²")
    tilt: PositiveFloat = Field(description="tangent of the greatest desired tilt")
    attitude: PositiveFloat = Field(description="desired body rate per small angle of thrust direction error, 1/s")
    angular_deceleration: PositiveFloat = Field(description="angular deceleration that a turn plans with, rad/s²")
    body_rates: PositiveFloat = Field(description="angular acceleration per error of roll and pitch rate, 1/s")
    yaw_rate: PositiveFloat = Field(description="angular deceleration per yaw rate, 1/s")
    descent_deceleration: PositiveFloat = Field(
        description="the same from above: less, so that an agent that imitates it imprecisely does not overshoot, m/s²"
    )
    measured: GeometricMetrics | None = Field(default=None, description="what these gains reached")

    def values(self) -> FloatArray:
        """The gains alone, in the order of the fields."""
        return np.array([getattr(self, name) for name in GAIN_NAMES])


GAIN_NAMES = tuple(name for name in GeometricGains.model_fields if name != "measured")
