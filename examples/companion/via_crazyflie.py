"""A Crazyflie by radio: ``send_setpoint_manual`` with rates, from cflib.

The firmware's PID controller closes the rate loop (parameter stabilizer.controller 1). Its
supervisor levels the vehicle 0.5 s after the last command, and stops the motors after 2 s. World
and body axes are ours. The thrust is the firmware's 16-bit number; take the first estimate of
``HoverThrust`` from the log variable stabilizer.thrust in hover, divided by 65,535.
"""

import math
import time
from typing import Any

import numpy as np
from cflib.crazyflie.log import LogConfig
from core import State

PERIOD = 10  # ms
PLACE = [f"stateEstimate.{name}" for name in ("x", "y", "z", "vx", "vy", "vz")]
ATTITUDE = [f"stateEstimate.q{name}" for name in "wxyz"]
GYRO = [f"gyro.{name}" for name in "xyz"]  # degrees/s
SUPERVISOR = "supervisor.info"
FLYING, TUMBLED, LOCKED, CRASHED = 1 << 4, 1 << 5, 1 << 6, 1 << 7
LEAST, MOST, FULL = 10001, 60000, 65535  # thrusts of cflib's 0 and 100 %, and of throttle 1


class Crazyflie:
    """A link by cflib.

    :param cf: a connected ``cflib.crazyflie.Crazyflie``.
    """

    def __init__(self, cf, clock=time.monotonic) -> None:
        self.cf = cf
        self.clock = clock
        self.seen: dict[str, Any] = {}
        self.times: dict[str, float] = {}
        # A log packet has room for 26 bytes.
        blocks = {
            "place": dict.fromkeys(PLACE, "float"),
            "attitude": {
                **dict.fromkeys(ATTITUDE, "float"),
                **dict.fromkeys(GYRO, "FP16"),
                SUPERVISOR: "uint16_t",
            },
        }
        for name, variables in blocks.items():
            block = LogConfig(name, PERIOD)
            for variable, kind in variables.items():
                block.add_variable(variable, kind)
            cf.log.add_config(block)
            block.data_received_cb.add_callback(self.receive)
            block.start()

    def receive(self, timestamp: int, values: dict, block) -> None:
        self.seen = {**self.seen, **values}
        self.times[block.name] = self.clock()

    def state(self) -> State | None:
        seen = self.seen
        if len(self.times) < 2:
            return None
        place, attitude, gyro = (
            np.array([seen[name] for name in names]) for names in (PLACE, ATTITUDE, GYRO)
        )
        time = min(self.times.values())
        return State(time, place[:3], attitude, place[3:], np.radians(gyro))

    def is_flying(self) -> bool:
        info = self.seen.get(SUPERVISOR, 0)
        return bool(info & FLYING) and not info & (TUMBLED | LOCKED | CRASHED)

    def refusal(self) -> str:
        return "" if self.is_flying() else "take off with the high-level commander first"

    def take_over(self) -> None:
        """Nothing to ask for: low-level commands come before those of the high level."""

    def is_ours(self) -> bool:
        return self.is_flying()

    def send(self, throttle: float, body_rates: np.ndarray) -> None:
        percent = 100.0 * (FULL * throttle - LEAST) / (MOST - LEAST)
        rates = [math.degrees(rate) for rate in body_rates]
        self.cf.commander.send_setpoint_manual(*rates, min(max(percent, 0.0), 100.0), True)

    def hand_over(self, fault: str) -> None:
        """Let the high-level commander hold the present place."""
        self.cf.commander.send_notify_setpoint_stop()
        if len(self.times) == 2:
            x, y, z = (self.seen[name] for name in PLACE[:3])
            self.cf.high_level_commander.go_to(x, y, z, 0.0, 2.0)
