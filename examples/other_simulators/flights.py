"""Starts, observations, policies, metrics and the table, the same for all other simulators.

Nothing here needs ``sb3_quad``: the script flies a policy as a user of the exported file would. The
conventions are those of docs/export.md: world frame with z up; body frame with x forward, y left, z
up; SI units; a control step of 10 ms.
"""

import argparse
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]
CONTROL_STEP = 0.01  # s
STEPS = 1500  # control steps of a flight
# A flight succeeds below this final error (m) and tilt (rad).
TASKS = {"targets": (0.1, np.pi), "recoveries": (0.25, np.radians(10.0))}
MAX_DISTANCE = 30.0  # m; farther from its target a flight is out of range
ARRIVED = 0.1  # m


@dataclass
class State:
    """The state of n vehicles.

    Position and velocity (n, 3) are in the world frame, m and m/s; the quaternion (n, 4), w first,
    turns body to world; body rates (n, 3) are in rad/s.
    """

    position: Array
    quaternion: Array
    velocity: Array
    body_rates: Array

    @property
    def rotation(self) -> Array:
        """Rotation matrices, body to world, (n, 3, 3)."""
        w, x, y, z = self.quaternion.T
        rows = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
        return np.moveaxis(np.array(rows), -1, 0)


class Simulator(Protocol):
    """n vehicles of one kind in another simulator."""

    n: int
    # (4, 3): x, y (m) and the sign of the yaw moment of each rotor, in the simulator's order
    rotors: Array
    hover: float  # thrust of a rotor in hover, N
    ground: float  # m: height of the centre of mass when it stands on the ground

    def reset(self, start: State) -> None:
        """Begin at ``start``, the rotors at hover speed."""

    def step(self, thrusts: Array) -> None:
        """One control step with the commanded thrusts (n, 4), N, which the simulator limits."""

    def state(self) -> State:
        """The true state."""

    def thrusts(self, speeds: Array) -> Array:
        """Thrusts (N) at rotor speeds; 0 is the least speed and 1 the greatest."""


class Policy(Protocol):
    """A function from observations (n, 18) to thrusts (n, 4), N.

    Experts use the true state and the targets (n, 3) instead.
    """

    def reset(self, n: int) -> None:
        """Begin n flights."""

    def __call__(self, observation: Array, state: State, target: Array) -> Array:
        """The thrusts to command."""


class ExportedAgent:
    """A file of ``sb3-quad export --format onnx``, for a vehicle with the simulator's rotors.

    :raises SystemExit: if it was exported for other rotors.
    """

    def __init__(self, file: str, simulator: Simulator) -> None:
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        self._session = onnxruntime.InferenceSession(
            file, options, providers=["CPUExecutionProvider"]
        )
        rotors = self._session.get_modelmeta().custom_metadata_map["rotors"]
        signs = []
        for x, y, yaw in re.findall(r"x (\S+) m, y (\S+) m, yaw moment ([+-])", rotors):
            signs.append([np.sign(float(x)), np.sign(float(y)), float(yaw + "1")])
        if not np.array_equal(signs, np.sign(simulator.rotors)):
            raise SystemExit(
                f"{file}: its rotors, {rotors}, are not where the simulator has them; "
                "export for that --vehicle"
            )

    def reset(self, n: int) -> None:
        inputs = self._session.get_inputs()
        self._state = None
        if len(inputs) > 1:
            self._state = np.zeros((n, inputs[1].shape[1]), np.float32)

    def __call__(self, observation: Array, state: State, target: Array) -> Array:
        if self._state is None:
            (thrusts,) = self._session.run(None, {"observation": observation})
        else:
            feed = {"observation": observation, "state": self._state}
            thrusts, self._state = self._session.run(None, feed)
        return np.asarray(thrusts, np.float64)


class Raptor:
    """RAPTOR's policy (package ``foundation-policy``), used as in examples/raptor.py."""

    # Signs of x, y and yaw moment of each motor.
    MOTORS = ((1, -1, -1), (-1, -1, 1), (-1, 1, -1), (1, 1, 1))

    def __init__(self, simulator: Simulator) -> None:
        import foundation_policy

        self._policy = foundation_policy.Raptor()
        self._thrusts = simulator.thrusts
        signs = np.sign(simulator.rotors).astype(int).tolist()
        self._order = [self.MOTORS.index(tuple(rotor)) for rotor in signs]

    def reset(self, n: int) -> None:
        self._policy.reset()
        self._last = np.zeros((n, 4), np.float32)

    def __call__(self, observation: Array, state: State, target: Array) -> Array:
        position, to_body, velocity, rates = np.split(observation, [3, 12, 15], axis=1)
        rotation = to_body.reshape(-1, 3, 3).transpose(0, 2, 1)
        velocity = np.einsum("nij,nj->ni", rotation, velocity).clip(-1.0, 1.0)
        position = position.clip(-0.5, 0.5)
        inputs = np.hstack([position, rotation.reshape(-1, 9), velocity, rates, self._last])
        self._last = self._policy.evaluate_step(inputs).astype(np.float32).clip(-1.0, 1.0)
        commands = self._last[:, self._order].astype(np.float64)
        return self._thrusts((commands + 1.0) / 2.0)


def sample_starts(task: str, n: int, seed: int) -> tuple[State, Array]:
    """Sample starts 15 m above the ground, and targets (n, 3).

    The distributions are those of the tasks target_tracking and state_recovery.
    """
    rng = np.random.default_rng(seed)
    position = np.tile([0.0, 0.0, 15.0], (n, 1))
    if task == "targets":
        zeros = np.zeros((n, 3))
        level = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
        target = position + 10.0 * _unit(rng.standard_normal((n, 3)))
        return State(position, level, zeros, zeros), target
    quaternion = _unit(rng.standard_normal((n, 4)))
    velocity, body_rates = rng.standard_normal((2, n, 3))
    return State(position, quaternion, 2.0 * velocity, 4.0 * body_rates), position.copy()


def _unit(vectors: Array) -> Array:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def observe(state: State, target: Array) -> Array:
    """The 18 numbers of docs/export.md, (n, 18)."""
    to_body = state.rotation.transpose(0, 2, 1)
    velocity = np.einsum("nij,nj->ni", to_body, state.velocity)
    return np.hstack([state.position - target, to_body.reshape(-1, 9), velocity, state.body_rates])


def check_rotors(make: Callable[[int], Simulator]) -> None:
    """Speed up one rotor at a time in hover, and check that the body turns as its place says.

    :raises SystemExit: if it turns in another way.
    """
    simulator = make(4)
    # The difference to a plain hover takes out what the wind does.
    hovering = _after_hover(simulator, 0.0)
    turned = _after_hover(make(4), 0.2)
    rates = turned.body_rates - hovering.body_rates
    climb = turned.velocity[:, 2] - hovering.velocity[:, 2]
    x, y, yaw = simulator.rotors.T
    if not np.array_equal(np.sign(rates), np.sign(np.stack([y, -x, yaw], axis=1))):
        raise SystemExit(
            f"{simulator}: rotors at {simulator.rotors.tolist()} turn the body "
            f"by {rates.tolist()} rad/s"
        )
    if not (climb > 0.0).all():
        raise SystemExit(
            f"{simulator}: 5 % more thrust than in hover, and it climbs by {climb.tolist()} m/s"
        )


def _after_hover(simulator: Simulator, share: float) -> State:
    """The state after 0.03 s, vehicle i with rotor i at ``share`` more than hover."""
    simulator.reset(sample_starts("targets", 4, 0)[0])
    for _ in range(3):
        simulator.step(simulator.hover * (1.0 + share * np.eye(4)))
    return simulator.state()


@dataclass
class Flights:
    """Results of n flights, (n,) each.

    Final errors are in m, times in s: first arrival, and settling time. They are infinite for a
    flight that crashed, got out of range or never arrived.
    """

    survived: Array
    succeeded: Array
    error: Array
    arrived: Array
    stayed: Array


def fly(
    simulator: Simulator, policy: Policy, task: str, seed: int, noise: float, delay: int
) -> Flights:
    """Fly a task.

    :param noise: relative standard deviation of each observed number.
    :param delay: control steps from a command to its effect.
    """
    start, target = sample_starts(task, simulator.n, seed)
    rng = np.random.default_rng([seed, 1])
    simulator.reset(start)
    policy.reset(simulator.n)
    commands = [np.full((simulator.n, 4), simulator.hover)] * delay
    state = start
    lost = np.zeros(simulator.n, np.bool_)
    errors = np.zeros((STEPS, simulator.n))
    for step in range(STEPS):
        factors = 1.0 + noise * rng.standard_normal((simulator.n, 18))
        observation = observe(state, target) * factors
        # The simulator may give anything for a vehicle that has crashed, also NaN.
        observation[lost] = 0.0
        commands.append(policy(observation.astype(np.float32), state, target))
        simulator.step(np.where(lost[:, None], simulator.hover, commands.pop(0)))
        state = simulator.state()
        errors[step] = np.linalg.norm(state.position - target, axis=1)
        lost |= ~(errors[step] <= MAX_DISTANCE) | (state.position[:, 2] <= simulator.ground)
        errors[step, lost] = np.inf
    distance, tilt = TASKS[task]
    near = errors <= ARRIVED
    first = np.where(near.any(axis=0), near.argmax(axis=0) + 1, np.inf)
    # Steps at the end of the flight that are near without a break.
    near_at_the_end = np.logical_and.accumulate(near[::-1]).sum(axis=0)
    last = np.where(near[-1], STEPS + 1 - near_at_the_end, np.inf)
    succeeded = ~lost & (errors[-1] <= distance) & (state.rotation[:, 2, 2] >= np.cos(tilt))
    return Flights(~lost, succeeded, errors[-1], first * CONTROL_STEP, last * CONTROL_STEP)


HEADER = (
    "| vehicle | conditions | controller | survive: targets / recoveries | succeed | to 0.1 m "
    "| settling time: targets / recoveries | final error, targets: median / 95 % |\n"
    "|---|---|---|---|---|---|---|---|"
)


def table_row(labels: Iterable[str], targets: Flights, recoveries: Flights) -> str:
    """Format a line of the table.

    Times are medians over all flights; one that crashes never arrives. Errors are of the survivors.
    """
    survive = f"{_percent(targets.survived)} / {_percent(recoveries.survived)} %"
    succeed = f"{_percent(targets.succeeded)} / {_percent(recoveries.succeeded)} %"
    settle = f"{_seconds(targets.stayed)} / {_seconds(recoveries.stayed)}"
    error = targets.error[targets.survived]
    median = high = np.nan
    if error.size:
        median, high = np.quantile(error, [0.5, 0.95])
    errors = f"{median:.3f} / {high:.3f} m"
    cells = [*labels, survive, succeed, _seconds(targets.arrived), settle, errors]
    return f"| {' | '.join(cells)} |"


def _percent(flights: Array) -> str:
    return f"{100 * flights.mean():.1f}"


def _seconds(times: Array) -> str:
    median = np.median(times)
    if not np.isfinite(median):
        return "-"
    return f"{median:.2f} s"


@dataclass
class Cell:
    """A vehicle under some conditions."""

    vehicle: str
    conditions: str
    make: Callable[[int], Simulator]  # from the number of vehicles


def parse_options(
    description: str, cells: Iterable[str], others: Iterable[str]
) -> argparse.Namespace:
    """Read the command line of a script with these cells and other controllers."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add(
        "files",
        nargs="*",
        help="exported agents; NAME@VEHICLE.onnx flies the cells of that vehicle, NAME.onnx all",
    )
    add(
        "--cells",
        nargs="+",
        choices=cells,
        default=[*cells],
        metavar="CELL",
        help=f"some of {', '.join(cells)} (all)",
    )
    add(
        "--others",
        nargs="*",
        choices=others,
        default=[*others],
        metavar="NAME",
        help=f"some of {', '.join(others)} (all)",
    )
    add(
        "--delay",
        nargs="+",
        type=int,
        default=[0],
        help="control steps from a command to its effect; each of several is flown (0)",
    )
    add("-n", type=int, default=256, help="flights of each task in a cell (256)")
    add("--seed", type=int, default=1, help="seed of starts and noise (1)")
    add(
        "--noise",
        type=float,
        default=0.05,
        help="relative standard deviation of each observed number (0.05)",
    )
    return parser.parse_args()


def main(
    description: str, cells: Mapping[str, Cell], others: Mapping[str, Callable[[Any], Policy]]
) -> None:
    """Run a script's command: check the rotors, fly, print the table.

    :param others: controllers to compare with, by name; each is made for a simulator.
    """
    options = parse_options(description, [*cells], [*others])
    print(HEADER)
    for cell in (cells[name] for name in options.cells):
        check_rotors(cell.make)
        simulator = cell.make(options.n)
        policies: dict[str, Policy] = {}
        for file in options.files:
            name, _, vehicle = Path(file).stem.partition("@")
            if vehicle in ("", cell.vehicle):
                policies[name] = ExportedAgent(file, simulator)
        for name in options.others:
            policies[name] = others[name](simulator)
        for delay in options.delay:
            conditions = cell.conditions
            if delay > 0:
                conditions += f", {10 * delay} ms delay"
            for name, policy in policies.items():
                flights = []
                for task in TASKS:
                    how = (options.seed, options.noise, delay)
                    flights.append(fly(simulator, policy, task, *how))
                print(table_row([cell.vehicle, conditions, name], *flights), flush=True)
