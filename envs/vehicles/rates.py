"""The rate loop of a flight controller, as in a vehicle's YAML, and its default values."""

import math
from typing import Annotated, Any

from pydantic import Field, model_validator

from sb3_quad.base.validate import Frozen

# The parameters of a rate loop that the compiled kernel needs, the last rows of a vehicle's:
# greatest body rates, rad/s; torque per error of a body rate, N m s; time constant of the gyro's
# filter, s; and the thrust of each rotor per moment, 1/m
RATE_PARAMETERS = (
    *(f"rate_limit_{axis}" for axis in "xyz"),
    *(f"rate_gain_{axis}" for axis in "xyz"),
    "rate_lag",
    *(f"{axis}_mix_{rotor}" for axis in ("roll", "pitch", "yaw") for rotor in range(4)),
)
LARGEST_LAG = 0.1  # s
LAG = 0.002  # s
# Gain times the lag of motors and filter: the loop has a damping ratio of 0.71.
GAIN_TIMES_LAG = 0.5
# rad/s, by axis. Less would be a command range seven times as narrow as that of other vehicles,
# where motors are quick and weak.
LEAST_DERIVED_LIMITS = (10.0, 10.0, 0.0)
LARGEST_DERIVED_LIMIT = 20.0
# Rotors idle at this part of their greatest thrust or more, as in airmode, so that none stops.
IDLE = 0.001
PRESETS = {
    # Actual rates with their default of 670°/s; low-pass filters of the gyro at 250 and 500 Hz
    "betaflight": {"limits": (math.radians(670.0),) * 3, "lag": 0.00096},
    # MC_ROLLRATE_MAX, MC_PITCHRATE_MAX, MC_YAWRATE_MAX; the delay of the second-order filter of
    # IMU_GYRO_CUTOFF, 40 Hz
    "px4": {"limits": (*[math.radians(220.0)] * 2, math.radians(200.0)), "lag": 0.0056},
}
# Beyond, a loop at 400 Hz is unstable.
Gain = Annotated[float, Field(gt=0.0, le=200.0)]
Limit = Annotated[float, Field(gt=0.0, le=100.0)]


class RateLoop(Frozen):
    """The loop that flies with ``action="rates"``, at the physics step.

    Its torque is J k (ω_c - ω_f) + ω_f × J ω_f, with the commanded body rates ω_c, and the body
    rates ω_f behind a first-order filter. You may write ``betaflight`` or ``px4``, for the limits
    and filters that these have by default.
    """

    limits: tuple[Limit, Limit, Limit] | None = None
    """greatest commanded roll, pitch and yaw rate, rad/s; default: the rates at which the loop asks
    for the whole moment of the rotors from rest, 10 (roll, pitch) to 20 rad/s
    """
    gains: tuple[Gain, Gain, Gain] | None = None
    """k, angular acceleration per error of each body rate, 1/s; default: 0.5 divided by the time
    constants of motors and filter together
    """
    lag: Annotated[float, Field(ge=0.0, le=LARGEST_LAG)] = LAG
    """time constant of the gyro's filter, s"""

    @model_validator(mode="before")
    @classmethod
    def _by_name(cls, data: Any) -> Any:
        if not isinstance(data, str):
            return data
        if data not in PRESETS:
            raise ValueError(f"{data!r}: must be {' or '.join(PRESETS)}, or limits, gains and lag")
        return PRESETS[data]


def derived_gain(lag: float, up: float, down: float) -> float:
    """Return the default gain, 1/s, for the lag of a filter, s, and the motors' gains, 1/s."""
    return GAIN_TIMES_LAG / (lag + 0.5 / up + 0.5 / down)


def derived_limit(acceleration: float, gain: float, least: float) -> float:
    """Return the default limit, rad/s, for the greatest angular acceleration, rad/s².

    :param least: the axis' entry of ``LEAST_DERIVED_LIMITS``.
    """
    return min(max(acceleration / gain, least), LARGEST_DERIVED_LIMIT)
