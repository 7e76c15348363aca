"""Betaflight, by MSP over a serial port: RC channels of a companion computer in place of the pilot's.

The pilot keeps the transmitter. One switch arms, another one (mode MSP OVERRIDE) gives roll, pitch,
throttle and yaw to the companion computer, so the pilot hands over and takes back. Betaflight knows
no position: give a function that returns the state, from motion capture or an odometry.

    set msp_override_channels_mask = 15    # roll, pitch, throttle, yaw
    set rates_type = ACTUAL                # linear: full stick is 670 °/s
    set roll_rc_rate = 67, roll_srate = 67, roll_expo = 0, and so on for pitch and yaw
"""

import math
import struct

import numpy as np

FULL_RATE = math.radians(670.0)  # at full stick
IDLE = 0.055  # motor_idle: speed of the motors at the lowest throttle
LEAST = 1050.0  # min_check, µs
SET_RAW_RC, STATUS, RC = 200, 101, 105
OVERRIDE_MARK = 3  # µs


def channels(throttle: float, body_rates: np.ndarray) -> list[int]:
    """Return roll, pitch, throttle and yaw, µs, for the motors' speed in [0, 1] and body rates,
    rad/s. Stick right, forward and right are positive: right side, nose and turn to the right.
    """
    roll, pitch, yaw = 500.0 * np.clip(np.divide(body_rates, FULL_RATE), -1.0, 1.0)
    lift = float(np.clip((throttle - IDLE) / (1.0 - IDLE), 0.0, 1.0))
    values = (1500.0 + roll, 1500.0 + pitch, LEAST + (2000.0 - LEAST) * lift, 1500.0 - yaw)
    return [round(value) for value in values]
