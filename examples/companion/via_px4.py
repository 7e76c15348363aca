"""PX4 by MAVLink: SET_ATTITUDE_TARGET with body rates, in the flight mode Offboard.

PX4 must send its estimates at 100 Hz, which the link asks for. Its frames are north, east, down and
forward, right, down; half a turn about x makes them world axes x north, y west, z up, and ours of
the body. PX4 takes Offboard only while commands come, and leaves it ``COM_OF_LOSS_T`` after the
last one, by ``COM_OBL_RC_ACT``: set that to 0, position mode.
"""

import time
from typing import Any

import numpy as np
from core import State
from pymavlink import mavutil

MAV = mavutil.mavlink
POSITION, AUTO, OFFBOARD = 3, 4, 6  # PX4's main modes
LOITER = 3  # of AUTO
PERIOD = 10_000  # µs
TURN = np.array([1.0, -1.0, -1.0])  # half a turn about x, for vectors
QUATERNION_TURN = np.array([1.0, 1.0, -1.0, -1.0])  # the same, for quaternions


class Px4:
    """A link by MAVLink.

    :param connection: of pymavlink, ``mavutil.mavlink_connection("udpin:0.0.0.0:14540")``.
    """

    def __init__(self, connection, clock=time.monotonic) -> None:
        self.connection = connection
        self.clock = clock
        self.seen: dict[str, tuple[float, Any]] = {}
        for message in (
            MAV.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
            MAV.MAVLINK_MSG_ID_ATTITUDE_QUATERNION,
            MAV.MAVLINK_MSG_ID_EXTENDED_SYS_STATE,
        ):
            self.order(MAV.MAV_CMD_SET_MESSAGE_INTERVAL, message, PERIOD)

    def order(self, command: int, *values: float) -> None:
        c = self.connection
        rest = [0.0] * (7 - len(values))
        c.mav.command_long_send(c.target_system, c.target_component, command, 0, *values, *rest)

    def receive(self) -> None:
        """Keep the latest message of each kind of PX4's own, with its time."""
        while (message := self.connection.recv_match(blocking=False)) is not None:
            if message.get_srcComponent() == MAV.MAV_COMP_ID_AUTOPILOT1:
                self.seen[message.get_type()] = self.clock(), message

    def state(self) -> State | None:
        self.receive()
        if not {"LOCAL_POSITION_NED", "ATTITUDE_QUATERNION"} <= self.seen.keys():
            return None
        # The older of both says how old the state is.
        place_time, place = self.seen["LOCAL_POSITION_NED"]
        attitude_time, attitude = self.seen["ATTITUDE_QUATERNION"]
        return State(
            min(place_time, attitude_time),
            TURN * [place.x, place.y, place.z],
            QUATERNION_TURN * [attitude.q1, attitude.q2, attitude.q3, attitude.q4],
            TURN * [place.vx, place.vy, place.vz],
            TURN * [attitude.rollspeed, attitude.pitchspeed, attitude.yawspeed],
        )

    @property
    def mode(self) -> int:
        """PX4's main mode; 0 if it is unknown or not armed."""
        self.receive()
        if "HEARTBEAT" not in self.seen:
            return 0
        _, heartbeat = self.seen["HEARTBEAT"]
        is_armed = heartbeat.base_mode & MAV.MAV_MODE_FLAG_SAFETY_ARMED
        return heartbeat.custom_mode >> 16 & 0xFF if is_armed else 0

    def refusal(self) -> str:
        if self.mode not in (POSITION, AUTO):
            return "fly in position mode or hold first"
        _, landed = self.seen.get("EXTENDED_SYS_STATE", (0.0, None))
        if landed is None or landed.landed_state != MAV.MAV_LANDED_STATE_IN_AIR:
            return "PX4 does not say that it is in the air"
        return ""

    def set_mode(self, *mode: int) -> None:
        self.order(MAV.MAV_CMD_DO_SET_MODE, MAV.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, *mode)

    def take_over(self) -> None:
        self.set_mode(OFFBOARD)

    def is_ours(self) -> bool:
        return self.mode == OFFBOARD

    def send(self, throttle: float, body_rates: np.ndarray) -> None:
        c = self.connection
        c.mav.set_attitude_target_send(
            int(1000 * self.clock()) & 0xFFFFFFFF,
            c.target_system,
            c.target_component,
            MAV.ATTITUDE_TARGET_TYPEMASK_ATTITUDE_IGNORE,
            [1.0, 0.0, 0.0, 0.0],
            *TURN * body_rates,
            throttle,
        )

    def hand_over(self, fault: str) -> None:
        """Back to position mode; without sticks PX4 refuses that, and then it holds."""
        if not self.is_ours():
            return  # A pilot has taken over, or PX4's failsafe.
        self.set_mode(POSITION)
        end = self.clock() + 0.3
        while self.is_ours() and self.clock() < end:
            time.sleep(0.01)
        if self.is_ours():
            self.set_mode(AUTO, LOITER)
