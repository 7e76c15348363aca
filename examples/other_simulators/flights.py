"""Starts, observations, policies, metrics and the table, the same for all other simulators.

Nothing here needs ``sb3_quad``: the script flies a policy as a user of the exported file would. The
conventions are those of docs/export.md: world frame with z up; body frame with x forward, y left, z
up; SI units; a control step of 10 ms.
"""

import argparse
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
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
SETTLED = 200  # control steps after which the errors of a curve count
# The motion of a target at rest: position, velocity and acceleration in each control step of a
# flight and for a second after it, as far as an agent sees ahead.
REST = np.zeros((STEPS + 101, 3, 3))
QUARTER = np.pi / 2.0
# Sines along x, y and z: sizes (m), multiples of a rate, phases; and greatest speed over that rate.
SINES = {
    "figure_eight": ((2.0, 1.0, 0.0), (1, 2, 0), (0.0, 0.0, 0.0), np.sqrt(8.0)),
    "circle": ((2.0, 2.0, 0.0), (1, 1, 0), (QUARTER, 0.0, 0.0), 2.0),
}
CURVES = ("figure_eight_1", "figure_eight_2", "figure_eight_4", "circle_2")


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
        vector = self.quaternion[:, 1:]
        # Cross products with the vector
        skew = np.cross(np.eye(3), vector[:, None])
        return np.eye(3) + 2.0 * (self.quaternion[:, :1, None] * skew + skew @ skew)


@dataclass
class Setpoint:
    """Where n vehicles should be, and how these points move, in the world frame.

    Positions (n, 3), m, velocity (3,), m/s, and the accelerations (steps, 3), m/s², from this
    control step on. No heading is commanded.
    """

    position: Array
    velocity: Array
    accelerations: Array


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

    Experts use the true state instead.
    """

    def reset(self, n: int) -> None:
        """Begin n flights."""

    def __call__(self, observation: Array, state: State, setpoint: Setpoint) -> Array:
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
        facts = self._session.get_modelmeta().custom_metadata_map
        rotors = facts["rotors"]
        # How many control steps ahead it sees the acceleration of its reference.
        ahead = re.findall(r"of the reference in (\d+) control steps", facts["observation"])
        self._ahead = [int(steps) for steps in ahead]
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

    def __call__(self, observation: Array, state: State, setpoint: Setpoint) -> Array:
        seen = setpoint.accelerations[self._ahead].ravel().astype(np.float32)
        observation = np.hstack([observation, np.tile(seen, (len(observation), 1))])
        if self._state is None:
            (thrusts,) = self._session.run(None, {"observation": observation})
        else:
            feed = {"observation": observation, "state": self._state}
            thrusts, self._state = self._session.run(None, feed)
        return np.asarray(thrusts, np.float64)


class Raptor:
    """RAPTOR's policy (package ``foundation-policy``), which finds out in flight what it flies.

    As with its authors, it sees position and velocity relative to the setpoint. If rotors form a
    plus, it sees the vehicle and the world turned by 45°.
    """

    # Signs of x, y and yaw moment of each motor.
    MOTORS = ((1, -1, -1), (-1, -1, 1), (-1, 1, -1), (1, 1, 1))

    def __init__(self, simulator: Simulator) -> None:
        import foundation_policy

        self._policy = foundation_policy.Raptor()
        self._thrusts = simulator.thrusts
        self._turn = np.eye(3)
        if not simulator.rotors[:, :2].all():
            c = np.sqrt(0.5)
            self._turn = np.array([[c, -c, 0.0], [c, c, 0.0], [0.0, 0.0, 1.0]])
        signs = np.sign(simulator.rotors @ self._turn.T).astype(int).tolist()
        self._order = [self.MOTORS.index(tuple(rotor)) for rotor in signs]

    def reset(self, n: int) -> None:
        self._policy.reset()
        self._last = np.zeros((n, 4), np.float32)

    def __call__(self, observation: Array, state: State, setpoint: Setpoint) -> Array:
        position, to_body, velocity, rates = np.split(observation, [3, 12, 15], axis=1)
        rotation = to_body.reshape(-1, 3, 3).transpose(0, 2, 1)
        turn = self._turn
        velocity = (np.einsum("nij,nj->ni", rotation, velocity) @ turn.T).clip(-1.0, 1.0)
        position = (position @ turn.T).clip(-0.5, 0.5)
        rotation = turn @ rotation @ turn.T
        rates = rates @ turn.T
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


def make_curve(name: str) -> Array:
    """Position, velocity and acceleration at each control step, (steps, 3, 3), m, m/s, m/s².

    Positions are relative to the start. A round is a whole number of control steps, as in
    docs/following.md.

    :param name: one of ``SINES`` and the greatest speed, m/s, as in ``figure_eight_2``.
    :raises SystemExit: for another name.
    """
    shape, _, speed = name.rpartition("_")
    if shape not in SINES or not re.fullmatch(r"\d+(\.\d+)?", speed) or float(speed) == 0.0:
        raise SystemExit(f"{name}: no curve; must be {' or '.join(SINES)}, with _SPEED (m/s)")
    sizes, harmonics, phases, per_rate = SINES[shape]
    steps = round(2.0 * np.pi * per_rate / float(speed) / CONTROL_STEP)
    rates = 2.0 * np.pi / (steps * CONTROL_STEP) * np.array(harmonics)
    times = CONTROL_STEP * np.arange(len(REST))[:, None]
    motion = np.zeros_like(REST)
    for k in range(3):
        # Each derivative of a sine is a quarter of its round ahead.
        angles = rates * times + np.array(phases) + k * np.pi / 2.0
        motion[:, k] = np.array(sizes) * rates**k * np.sin(angles)
    motion[:, 0] -= motion[0, 0]
    return motion


def observe(state: State, setpoint: Setpoint) -> Array:
    """The 18 numbers of docs/export.md, relative to the setpoint, (n, 18)."""
    to_body = state.rotation.transpose(0, 2, 1)
    velocity = np.einsum("nij,nj->ni", to_body, state.velocity - setpoint.velocity)
    position = state.position - setpoint.position
    return np.hstack([position, to_body.reshape(-1, 9), velocity, state.body_rates])


def check_rotors(make: Callable[[int], Simulator]) -> None:
    """Speed up one rotor at a time in hover, and check that the body turns as expected from its
    place.

    :raises SystemExit: if it turns in another way.
    """
    simulator = make(4)
    # The difference from a plain hover removes the effect of the wind.
    hovering = _after_hover(simulator, 0.0)
    turned = _after_hover(make(4), 0.2)
    rates = turned.body_rates - hovering.body_rates
    climb = turned.velocity[:, 2] - hovering.velocity[:, 2]
    # Rotors of a plus turn it about only one of the two axes.
    rates[np.abs(rates) < 1e-3 * np.abs(rates).max()] = 0.0
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
    errors, state = _errors(simulator, policy, start, target, REST, seed, noise, delay)
    lost = np.isinf(errors[-1])
    distance, tilt = TASKS[task]
    near = errors <= ARRIVED
    first = np.where(near.any(axis=0), near.argmax(axis=0) + 1, np.inf)
    # Number of steps at the end of the flight that are near without a break
    near_at_the_end = np.logical_and.accumulate(near[::-1]).sum(axis=0)
    last = np.where(near[-1], STEPS + 1 - near_at_the_end, np.inf)
    succeeded = ~lost & (errors[-1] <= distance) & (state.rotation[:, 2, 2] >= np.cos(tilt))
    return Flights(~lost, succeeded, errors[-1], first * CONTROL_STEP, last * CONTROL_STEP)


def follow(
    simulator: Simulator,
    policy: Policy,
    curve: str,
    seed: int,
    noise: float,
    delay: int,
    moving: bool = False,
) -> Array:
    """Follow a curve from a hover at its start; parameters are as for ``fly``.

    Returns root mean square and greatest distance, m, of each flight, (2, n). They count from 2 s
    on, and are infinite for a flight that crashed or got out of range.

    :param moving: begin with the curve's velocity instead, level.
    """
    start = sample_starts("targets", simulator.n, seed)[0]
    motion = make_curve(curve)
    if moving:
        start.velocity = np.tile(motion[0, 1], (simulator.n, 1))
    errors, _ = _errors(simulator, policy, start, start.position, motion, seed, noise, delay)
    settled = errors[SETTLED:]
    return np.array([np.sqrt(np.mean(settled**2, axis=0)), settled.max(axis=0)])


def _errors(
    simulator: Simulator,
    policy: Policy,
    start: State,
    target: Array,
    motion: Array,
    seed: int,
    noise: float,
    delay: int,
) -> tuple[Array, State]:
    """Fly, and return the distances after each control step, (STEPS, n), m, and the last state.

    :param motion: motion of the target, as from ``make_curve``.
    """
    rng = np.random.default_rng([seed, 1])
    simulator.reset(start)
    policy.reset(simulator.n)
    commands: list[Array] = []
    state = start
    lost = np.zeros(simulator.n, np.bool_)
    errors = np.zeros((STEPS, simulator.n))
    for step in range(STEPS):
        position, velocity, _ = motion[step]
        setpoint = Setpoint(target + position, velocity, motion[step:, 2])
        factors = 1.0 + noise * rng.standard_normal((simulator.n, 18))
        observation = observe(state, setpoint) * factors
        # The simulator may return anything for a vehicle that has crashed, even NaN.
        observation[lost] = 0.0
        commands.append(policy(observation.astype(np.float32), state, setpoint))
        command = np.full((simulator.n, 4), simulator.hover)
        if step >= delay:
            command = commands.pop(0)
        simulator.step(np.where(lost[:, None], simulator.hover, command))
        state = simulator.state()
        errors[step] = np.linalg.norm(state.position - target - motion[step + 1, 0], axis=1)
        lost |= ~(errors[step] <= MAX_DISTANCE) | (state.position[:, 2] <= simulator.ground)
        errors[step, lost] = np.inf
    return errors, state


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


def curve_cell(flights: Array) -> str:
    """Format a cell: means over the flights that survived, and how many did if not all."""
    survived = np.isfinite(flights[0])
    if not survived.any():
        return "0 % survive"
    rms, greatest = flights[:, survived].mean(axis=1)
    cell = f"{rms:.3f} / {greatest:.3f} m"
    if not survived.all():
        cell += f" ({_percent(survived)} % survive)"
    return cell


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
    description: str, cells: Iterable[str], others: Iterable[str], curves: Sequence[str]
) -> argparse.Namespace:
    """Read the command line of a script with these cells, other controllers and curves."""
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
        metavar="CELL",
        help=f"some of {', '.join(cells)} (all; of curves those without wind)",
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
    add(
        "--curves",
        nargs="*",
        metavar="CURVE",
        help="follow curves instead, named as figure_eight_2 is, 2 m/s at most, or circle_2; "
        f"--curves alone: {', '.join(curves)}",
    )
    add("--moving", action="store_true", help="begin with the curve's velocity, not in a hover")
    add("-n", type=int, default=256, help="flights of each task in a cell (256)")
    add("--seed", type=int, default=1, help="seed of starts and noise (1)")
    add(
        "--noise",
        type=float,
        default=0.05,
        help="relative standard deviation of each observed number (0.05)",
    )
    options = parser.parse_args()
    if options.curves == []:
        options.curves = curves
    return options


def main(
    description: str,
    cells: Mapping[str, Cell],
    others: Mapping[str, Callable[[Any], Policy | None]],
    curves: Sequence[str] = CURVES,
) -> None:
    """Run a script's command: check the rotors, fly, print the table.

    :param others: factories of controllers to compare with, by name; each gets a simulator, and
        returns None if its controller cannot fly there.
    :param curves: the curves to follow if none are named.
    """
    options = parse_options(description, [*cells], [*others], curves)
    header = HEADER
    names = [*cells]
    if options.curves:
        columns = ["vehicle", "conditions", "controller", *options.curves]
        header = f"| {' | '.join(columns)} |\n{'|---' * len(columns)}|"
        names = [name for name in cells if "," not in cells[name].conditions]
    print(header)
    for cell in (cells[name] for name in options.cells or names):
        check_rotors(cell.make)
        simulator = cell.make(options.n)
        policies: dict[str, Policy] = {}
        for file in options.files:
            name, _, vehicle = Path(file).stem.partition("@")
            if vehicle in ("", cell.vehicle):
                policies[name] = ExportedAgent(file, simulator)
        for name in options.others:
            made = others[name](simulator)
            if made is not None:
                policies[name] = made
        for delay in options.delay:
            conditions = cell.conditions
            if delay > 0:
                conditions += f", {10 * delay} ms delay"
            how = (options.seed, options.noise, delay)
            for name, policy in policies.items():
                # A controller may bring its own simulator, which takes its commands without a
                # delay.
                flown = getattr(policy, "simulator", simulator)
                if delay > 0 and flown is not simulator:
                    continue
                labels = [cell.vehicle, conditions, name]
                if options.curves:
                    for curve in options.curves:
                        followed = follow(flown, policy, curve, *how, moving=options.moving)
                        labels.append(curve_cell(followed))
                    print(f"| {' | '.join(labels)} |", flush=True)
                else:
                    flights = [fly(flown, policy, task, *how) for task in TASKS]
                    print(table_row(labels, *flights), flush=True)
