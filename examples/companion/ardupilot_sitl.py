"""Fly a quadcopter of this package by ArduPilot's own code: ArduCopter's SITL closes the rate loop
in its mode GUIDED, and an exported agent or the geometric expert commands body rates and thrust by
MAVLink, as ``via_px4.py`` does. The same flights with ``action="rates"`` stand next to them.

    pip install '.[export,companion]'
    python examples/companion/ardupilot_sitl.py ~/ardupilot/build/sitl/bin/arducopter --runs 50
    python examples/companion/ardupilot_sitl.py … --policy agent.onnx --set INS_GYRO_FILTER=75

The program is yours: ArduCopter, built for the board ``sitl``. It knows the true attitude, and its
rate loop has the gains and the filter of the vehicle's file, but no integrals. Its clock waits for
the simulation, so a busy computer changes nothing. The ports are fixed: one SITL per computer.
"""

import json
import math
import shutil
import socket
import struct
import subprocess
import tempfile
from pathlib import Path

import numpy as np
from core import GRAVITY, State
from pymavlink import mavutil
from sitl_flights import PERIOD, STEP, compare, parser_of
from via_px4 import MAV, QUATERNION_TURN, TURN, Px4

from sb3_quad.envs.vehicles.vehicle import load_vehicle

GUIDED = 4  # a mode
NO_BODY_RATES = 7  # of an attitude target, a mask
ANYWAY = 21196  # arm whatever the checks say
LINK = "127.0.0.1:14550"
PHYSICS = ("127.0.0.1", 9002)
SETTLING = 1.5  # s, for its target attitude before a flight
PARAMETERS = {
    "AHRS_EKF_TYPE": 10,  # the simulated attitude
    "ARMING_CHECK": 0,
    "FS_CRASH_CHECK": 0,
    "FS_THR_ENABLE": 0,
    "LOG_BACKEND_TYPE": 0,
    "SERIAL1_PROTOCOL": -1,
    "SERIAL2_PROTOCOL": -1,
    "BARO_GND_TEMP": 15,  # no correction for thin air
    "FRAME_CLASS": 1,
    "FRAME_TYPE": 12,  # an X whose motors are numbered as in Betaflight
    "GUID_OPTIONS": 8,  # thrust is a thrust
    "ATC_ANGLE_BOOST": 0,
    # Body rates at once, and with priority over thrust
    **{f"ATC_ACCEL_{axis}_MAX": 0 for axis in "RPY"},
    "ATC_THR_MIX_MIN": 0.9,
    "ATC_THR_MIX_MAX": 0.9,
    "MOT_SPIN_MAX": 1,
}


def parameters(vehicle):
    """Return parameters that suit the vehicle, by name."""
    low, high = vehicle.thrust_limits
    idle = math.sqrt(low / high)  # the motors' speed
    _, gains = vehicle.rate_limits_and_gains
    whole = vehicle.greatest_moments / vehicle.inertia
    values = {
        **PARAMETERS,
        # The thrust is that of the motors' speed squared.
        "MOT_SPIN_ARM": idle,
        "MOT_SPIN_MIN": idle,
        "MOT_THST_EXPO": (1.0 - idle) / (1.0 + idle),
        "MOT_THST_HOVER": (1.0 - low) / (high - low),
        # A filter of second order with the same delay
        "INS_GYRO_FILTER": min(math.sqrt(0.5) / (math.pi * vehicle.rates.lag), 256.0),
    }
    for axis, gain in zip(("RLL", "PIT", "YAW"), gains / whole, strict=True):
        values[f"ATC_RAT_{axis}_P"] = gain
        values |= {f"ATC_RAT_{axis}_{name}": 0.0 for name in ("I", "D", "FLTT", "FLTE")}
    return values


class ArduPilot:
    """ArduCopter's SITL as a process whose clock we advance, in flight once it is there.

    :ivar hover: its throttle in hover, in [0, 1].
    :raises RuntimeError: it does not arm.
    """

    def __init__(self, program: Path, values) -> None:
        self.folder = Path(tempfile.mkdtemp(prefix="sitl_"))
        lines = [f"{name} {value}\n" for name, value in values.items()]
        (self.folder / "defaults").write_text("".join(lines))
        self.hover = values["MOT_THST_HOVER"]
        self.time = 0.0
        self.frame = -1
        self.motors = np.zeros(4)
        self.velocity = np.zeros(3)
        self.physics = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.physics.bind(PHYSICS)
        self.physics.settimeout(10.0)
        self.link = Px4(mavutil.mavlink_connection(f"udpin:{LINK}"), lambda: self.time)
        # Its home is at the height of the sea.
        options = f"--model JSON --serial0 udpclient:{LINK} --home 47,8,0,0 --speedup 1000"
        self.process = subprocess.Popen(
            [program.resolve(), *options.split(), "--defaults", "defaults"],
            cwd=self.folder,
            stdout=(self.folder / "log").open("w"),
            stderr=subprocess.STDOUT,
        )
        self.receive()
        still = np.zeros(3)
        level = State(0.0, still, np.array([1.0, 0.0, 0.0, 0.0]), still, still)
        while self.motors.min() < 2.0 * values["MOT_SPIN_MIN"]:
            if self.time > 60.0:
                self.close()
                raise RuntimeError("the SITL does not arm")
            self.link.set_mode(GUIDED)
            self.link.order(MAV.MAV_CMD_COMPONENT_ARM_DISARM, 1, ANYWAY)
            self.begin(level)

    def receive(self) -> None:
        """Take the motors' speeds. It repeats them when it waits for long."""
        frame = self.frame
        while frame == self.frame:
            packet, self.address = self.physics.recvfrom(64)
            _, _, frame, *pulses = struct.unpack("<HHI16H", packet)
        self.frame = frame
        self.motors = np.clip(np.array(pulses[:4]) / 1000.0 - 1.0, 0.0, 1.0)

    def step(self, state: State) -> np.ndarray:
        """Show the state, advance by ``STEP``, and return the motors' speeds, 1 to 4, in [0, 1]."""
        self.time += STEP
        felt = (state.velocity - self.velocity) / STEP + [0.0, 0.0, GRAVITY]
        self.velocity = state.velocity
        vectors = {
            "gyro": state.body_rates,
            "accel_body": state.rotation.T @ felt,
            "position": state.position,
            "velocity": state.velocity,
        }
        # North, east, down and forward, right, down. It takes what it finds, nested or not.
        seen = {name: [*(TURN * vector)] for name, vector in vectors.items()}
        quaternion = [*(QUATERNION_TURN * state.quaternion)]
        shown = {"timestamp": self.time, "imu": 0, "quaternion": quaternion, **seen}
        line = json.dumps(shown, separators=(",", ":"))
        self.physics.sendto(f"\n{line}\n".encode(), self.address)
        self.receive()
        return self.motors

    def send(self, throttle: float, body_rates: np.ndarray) -> None:
        self.link.send(throttle, body_rates)

    def begin(self, state: State) -> None:
        """Command the attitude that a flight begins with, until its target has settled there."""
        self.link.receive()
        still = np.zeros(3)
        self.velocity = still
        held = State(0.0, state.position, state.quaternion, still, still)
        attitude = [*(QUATERNION_TURN * state.quaternion)]
        command = (NO_BODY_RATES, attitude, *still, self.hover)
        for _ in range(round(SETTLING / PERIOD)):
            self.link.connection.mav.set_attitude_target_send(0, 1, 1, *command)
            for _ in range(round(PERIOD / STEP)):
                self.step(held)

    def close(self) -> None:
        self.process.kill()
        self.process.wait(10.0)
        self.physics.close()
        self.link.connection.close()
        shutil.rmtree(self.folder)


def main() -> None:
    """Fly, and print the table."""
    parser = parser_of(__doc__)
    parser.add_argument("sitl", type=Path, help="the program arducopter")
    parser.add_argument(
        "--set", nargs="+", default=[], metavar="NAME=VALUE", help="parameters of yours"
    )
    options = parser.parse_args()
    changes = {"physics_step": STEP, "control_step": PERIOD}
    vehicle = load_vehicle(options.vehicle).model_copy(update=changes)
    values = parameters(vehicle)
    for pair in options.set:
        name, value = pair.split("=")
        values[name] = float(value)
    compare(options, vehicle, "ArduPilot", lambda: ArduPilot(options.sitl, values))


if __name__ == "__main__":
    main()
