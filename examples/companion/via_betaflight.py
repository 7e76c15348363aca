"""Betaflight, by MSP over a serial port: RC channels in place of the pilot's.

The pilot keeps the transmitter. One switch arms, another one (mode MSP OVERRIDE) gives roll, pitch,
throttle and yaw to the companion computer, so the pilot hands over and takes back. **If commands
stop, Betaflight keeps the last ones until the pilot flips the switch.** It knows no position: give
a function that returns the state, from motion capture or an odometry.

    set msp_override_channels_mask = 15    # roll, pitch, throttle, yaw
    set msp_override_failsafe = OFF        # so that losing the transmitter is a failsafe
    set rates_type = ACTUAL                # linear: full stick is 670 °/s
    set roll_rc_rate = 67, roll_srate = 67, roll_expo = 0, and so on for pitch and yaw
"""

import math
import struct
from functools import reduce
from operator import xor

import numpy as np

FULL_RATE = math.radians(670.0)  # at full stick
IDLE = 0.055  # motor_idle: speed of the motors at the lowest throttle
LEAST = 1050.0  # min_check, µs
SET_RAW_RC, STATUS, BOX_IDS = 200, 101, 119  # messages
ARM, OVERRIDE = 0, 50  # permanent numbers of modes


def channels(throttle: float, body_rates: np.ndarray) -> list[int]:
    """Return roll, pitch, throttle and yaw, µs, for the motors' speed in [0, 1] and body rates,
    rad/s. Stick right, forward and right are positive: right side, nose and turn to the right.
    """
    roll, pitch, yaw = 500.0 * np.clip(np.divide(body_rates, FULL_RATE), -1.0, 1.0)
    lift = float(np.clip((throttle - IDLE) / (1.0 - IDLE), 0.0, 1.0))
    values = (1500.0 + roll, 1500.0 + pitch, LEAST + (2000.0 - LEAST) * lift, 1500.0 - yaw)
    return [round(value) for value in values]


def frame(code: int, payload: bytes = b"") -> bytes:
    """Return a message to the flight controller: MSP, version 1."""
    body = bytes([len(payload), code]) + payload
    return b"$M<" + body + bytes([checksum(body)])


def checksum(body: bytes) -> int:
    """Return the last byte of a message, for the bytes after its direction."""
    return reduce(xor, body)


class Betaflight:
    """A link by MSP.

    :param port: a ``serial.Serial``, or anything with ``write`` and a ``read`` that returns fewer
        bytes after a timeout of some ms.
    :param pose: returns the latest :class:`~core.State`, or None; Betaflight has no position.
    """

    def __init__(self, port, pose) -> None:
        self.port = port
        self.state = pose
        self.calls = 0
        self.hover: float | None = None  # throttle of the first command
        # Modes that Betaflight reports, in the order of the bits of its status
        self.modes = list(self.ask(BOX_IDS))
        self.active: set[int] = set()

    def ask(self, code: int) -> bytes:
        """Return what Betaflight answers.

        :raises RuntimeError: it does not, or not correctly.
        """
        self.port.write(frame(code))
        head = self.port.read(5)
        if len(head) == 5 and head[:3] == b"$M>" and head[4] == code:
            rest = self.port.read(head[3] + 1)
            if len(rest) == head[3] + 1 and checksum(head[3:] + rest[:-1]) == rest[-1]:
                return rest[:-1]
        raise RuntimeError(f"Betaflight does not answer MSP message {code}")

    def look(self) -> None:
        """Learn which modes are active."""
        (bits,) = struct.unpack_from("<I", self.ask(STATUS), 6)
        self.active = {mode for bit, mode in enumerate(self.modes) if bits >> bit & 1}

    def refusal(self) -> str:
        self.look()
        if OVERRIDE not in self.modes:
            return "set msp_override_channels_mask = 15, and give MSP OVERRIDE a switch"
        if ARM not in self.active:
            return "it is not armed"
        if OVERRIDE in self.active:
            return "switch MSP OVERRIDE off; the pilot switches it on when commands come"
        return ""

    def take_over(self) -> None:
        print("Commands come. Switch MSP OVERRIDE on.")

    def is_ours(self) -> bool:
        """Ten times a second, since the port also carries the commands."""
        self.calls += 1
        if self.calls % 10 == 1:
            self.look()
        return {ARM, OVERRIDE} <= self.active

    def send(self, throttle: float, body_rates: np.ndarray) -> None:
        if self.hover is None:
            self.hover = throttle
        self.port.write(frame(SET_RAW_RC, struct.pack("<4H", *channels(throttle, body_rates))))
        answer = self.port.read(6)
        if answer[:3] != b"$M>":
            raise RuntimeError("Betaflight does not take RC channels by MSP")

    def hand_over(self, fault: str) -> None:
        """Leave commands to hover without turning, since Betaflight keeps the last ones."""
        if self.hover is not None:
            self.send(self.hover, np.zeros(3))
        print(f"Switch MSP OVERRIDE off now: {fault or 'time is over'}.")
