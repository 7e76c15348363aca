"""The gains of the geometric expert as a vehicle's YAML holds them, and the figures they reached."""

from __future__ import annotations

from typing import Annotated

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field

from sb3_quad.base.quantities import Finite, Positive, Share

Count = Annotated[int, Field(gt=0)]


class GeometricFigures(BaseModel):
    """What :class:`GeometricGains` reached on episodes that no search over them had seen; true state, no other noise."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    recovery_success: Share = Field(description="share of recovery episodes with neither collision nor out of range")
    recovery_episodes: Count = Field(description="recovery episodes flown")
    tracking_success: Share = Field(description="share of tracking episodes with neither collision nor out of range")
    tracking_episodes: Count = Field(description="tracking episodes flown, targets 10 m away")
    time_to_0_1_m: Positive = Field(description="mean time until 0.1 m from the target, of the tracking episodes, s")
    tracking_reward: Finite = Field(description="mean reward of the tracking episodes (Eqs. 4.5-4.9)")
    observation_noise: Annotated[Finite, Field(ge=0)] = Field(description="relative, on what the expert sees")
    seeds: tuple[int, ...] = Field(min_length=1, description="first seed of each set of episodes")


class GeometricGains(BaseModel):
    """The named gains of :class:`~sb3_quad.experts.geometric.GeometricExpert`; ``geometric_gains`` in a vehicle's YAML."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    position: Positive = Field(description="desired speed per horizontal error near the target, 1/s")
    velocity: Positive = Field(description="acceleration per error of horizontal velocity, 1/s")
    height_position: Positive = Field(description="desired speed per height error near the target, 1/s")
    height_velocity: Positive = Field(description="acceleration per error of vertical velocity, 1/s")
    deceleration: Positive = Field(description="horizontal deceleration that the approach plans with, m/s²")
    height_deceleration: Positive = Field(description="vertical deceleration that the approach from below plans with, m/s²")
    descent: Positive = Field(description="greatest desired acceleration downwards, below g, m/s²")
    tilt: Positive = Field(description="tangent of the greatest desired tilt")
    attitude: Positive = Field(description="desired body rate per small angle of thrust direction error, 1/s")
    angular_deceleration: Positive = Field(description="angular deceleration that a turn plans with, rad/s²")
    body_rates: Positive = Field(description="angular acceleration per error of roll and pitch rate, 1/s")
    yaw_rate: Positive = Field(description="angular deceleration per yaw rate, 1/s")
    descent_deceleration: Positive = Field(
        description="the same from above: less, so that an agent that imitates it imprecisely does not overshoot, m/s²"
    )
    measured: GeometricFigures | None = Field(default=None, description="the figures these gains reached")

    def values(self) -> npt.NDArray[np.float64]:
        """The gains alone, in the order of the fields."""
        return np.array([getattr(self, name) for name in GAIN_NAMES])


GAIN_NAMES = tuple(name for name in GeometricGains.model_fields if name != "measured")
