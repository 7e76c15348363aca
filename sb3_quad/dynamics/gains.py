"""The gains of the geometric expert as a vehicle's YAML holds them, and the figures they reached."""

from __future__ import annotations

from typing import Annotated

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field

from sb3_quad.dynamics.quantities import Finite, Positive, Share

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

    position: Positive = Field(description="kp, 1/s²")
    velocity: Positive = Field(description="kv, 1/s")
    horizontal_acceleration: Positive = Field(description="limit of the desired horizontal acceleration, m/s²")
    fall_speed: Positive = Field(description="falling faster than this, stopping the fall comes first, m/s")
    fall_tilt: Positive = Field(description="tangent of the desired tilt while stopping a fall")
    tilt: Positive = Field(default=0.8, description="tangent of the largest desired tilt otherwise")
    attitude: Positive = Field(description="k_a, desired body rate per angle of thrust direction error, 1/s")
    braking: Positive = Field(description="a_ω, angular deceleration that the rate profile plans with, rad/s²")
    body_rates: Positive = Field(description="k_w, angular acceleration per body rate error, 1/s")
    thrust_cone: Finite = Field(default=0.3, description="c_c: below this cosine of the direction error, least thrust")
    long_way: Finite = Field(ge=0, description="f_b: how far from upside-down a spin is used at 8 rad/s, rad")
    yaw_rate: Positive = Field(default=2.0, description="yaw damping, 1/s")
    yaw_moment: Positive = Field(default=0.37, le=1, description="largest yaw moment, in the greatest that the rotors give")
    measured: GeometricFigures | None = Field(default=None, description="the figures these gains reached")

    def values(self) -> npt.NDArray[np.float64]:
        """The gains alone, in the order of the fields."""
        return np.array([getattr(self, name) for name in GAIN_NAMES])


GAIN_NAMES = tuple(name for name in GeometricGains.model_fields if name != "measured")
