"""Measure a vehicle file with real flights, and find parameters that fit them.

    python examples/real_flights.py FOLDER [--vehicle FILE] [--leave-out NAME …] [--control]

FOLDER holds CSV files in the format of NanoBench: docs/vehicles.md lists their columns.
docs/research/reality.md explains the output, and has the results for eleven flights of a Crazyflie.
``--control`` flies a vehicle with a known lag under a controller like the firmware's instead, and
shows the same estimates for it.
"""

import argparse
from dataclasses import dataclass

import numpy as np
import pandas as pd
from rich.console import Console

from sb3_quad import PIDExpert, load_vehicle
from sb3_quad.envs.simulation.batch import QuadcopterBatch
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.envs.simulation.state import TORQUE_BODY, QuadcopterState
from sb3_quad.evaluation.real_flights import (
    QUANTITIES,
    error_table,
    errors,
    open_loop,
    read_logs,
)
from sb3_quad.evaluation.tables import text_table

STEP = 0.01  # s, of the estimates
GRAVITY = np.array([0.0, 0.0, 9.81])
AXES = ("roll", "pitch", "yaw", "thrust")
# From thrusts of M1 to M4 (front right, back right, back left, front left) to what turns or lifts:
# the difference between two sides, N, or the sum
SIDES = np.array([[-1, -1, 1, 1], [-1, 1, 1, -1], [-1, 1, -1, 1], [1, 1, 1, 1]])
ARM = 0.0325  # m, of a rotor about an axis
# Number of past rates and of past commands in the model that predicts the next rate
PAST = 12
COMMANDS = 25


@dataclass
class Run:
    """The data of one flight for the estimates, in rows 0.01 s apart."""

    commands: np.ndarray  # (n, 4), by axis, N
    response: np.ndarray  # (n, 4), body rates (rad/s) and specific force along z (m/s²)


def main():
    """Read, measure, fit, fly."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", nargs="?")
    parser.add_argument("--vehicle", default="crazyflie_nanobench", help="name or YAML file")
    parser.add_argument("--leave-out", nargs="*", default=None, help="flights that judge the fit")
    parser.add_argument("--control", action="store_true", help="estimates of simulated flights")
    arguments = parser.parse_args()
    vehicle = load_vehicle(arguments.vehicle)
    if arguments.control:
        print_control(vehicle)
        return
    if arguments.folder is None:
        parser.error("give a folder, or --control")
    logs = [log for log in read_logs(arguments.folder, STEP) if log.flying.any()]
    fitted, judged = split(logs, arguments.leave_out)
    print("fitted:", ", ".join(log.path.stem for log in fitted))
    print("judged:", ", ".join(log.path.stem for log in judged))
    print("clocks differ by, ms:", ", ".join(f"{1000 * log.offset:.0f}" for log in logs))
    show(one_step_table(judged, vehicle))
    show(error_table(judged, vehicle))
    show(lag_table([run_of(log) for log in logs], "lags and slopes, all flights"))
    show(estimate_table(fitted))
    names = ("mass", "drag", "drag_z")
    better, spread = fit(fitted, vehicle, names)
    print(fit_text(better, spread, names))
    show(error_table(judged, better.model_copy(update={"name": "fitted"})))
    _, drag, moment = fit_forces(fitted)
    drag *= better.mass
    better = better.model_copy(update={"drag": (drag, drag, better.drag[2])})
    show(moment_table(judged, better, moment / 1000.0))
    show(closed_loop_table(judged, load_vehicle(arguments.vehicle)))


def show(table):
    """Print a table as wide as it is."""
    Console(width=160).print(table)


def split(logs, left_out):
    """Return the logs to fit and those to judge: the named ones, or every second."""
    if left_out is None:
        return logs[::2], logs[1::2]
    judged = [log for log in logs if log.path.stem in left_out]
    unknown = set(left_out) - {log.path.stem for log in judged}
    if unknown or not judged:
        raise SystemExit(f"--leave-out {', '.join(unknown)}: no such flights in the air")
    return [log for log in logs if log.path.stem not in left_out], judged


def longest_flight(log):
    """Return the rows of the longest piece of a log that is in the air."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], log.flying, [0]])))
    begins, ends = edges[::2], edges[1::2]
    best = np.argmax(ends - begins)
    return slice(begins[best], ends[best])


def state_of(motion):
    """Return the state of rows (n, 13)."""
    return QuadcopterState(motion.T)


def columns_of(log, names):
    """Return further columns of a log's file, (n, names), which follow the clock of the vehicle."""
    table = pd.read_csv(log.path)
    grid = table["t"].iloc[0] + STEP * np.arange(len(log.motion)) + log.offset
    return np.stack([np.interp(grid, table["t"], table[name]) for name in names], axis=1)


def run_of(log):
    """Return commands and response of a log's flight."""
    rows = longest_flight(log)
    force = 9.81 * columns_of(log, ["imu_acc_z"])[rows, 0]
    response = np.column_stack([state_of(log.motion[rows]).body_rates, force])
    return Run(log.thrusts[rows] @ SIDES.T, response)


# --- (a) one step ---------------------------------------------------------------------------------


def one_step_table(logs, vehicle):
    """Compare the accelerations that a vehicle file predicts from recorded commands with the
    measured ones.
    """
    flown = []
    given = []
    for log in logs:
        rows = longest_flight(log)
        state = state_of(log.motion[rows])
        force = np.gradient(state.velocity, STEP, axis=0) + GRAVITY
        turning = np.gradient(state.body_rates, STEP, axis=0)
        flown.append(np.column_stack([in_body(state.rotation, force), turning]))
        speeds = np.sqrt(np.maximum(log.thrusts[rows], 0.0))
        turned = lagged(speeds, 1.0 / vehicle.motor_gain_up, vehicle.delay * STEP) ** 2
        wrench = turned @ vehicle.mixer.T
        drag = in_body(state.rotation, state.velocity) * vehicle.drag / vehicle.mass
        lift = np.column_stack([-drag[:, :2], wrench[:, 0] / vehicle.mass - drag[:, 2]])
        given.append(np.column_stack([lift, wrench[:, 1:] / vehicle.inertia]))
    measured = np.concatenate([part[50:] for part in flown])
    expected = np.concatenate([part[50:] for part in given])
    names = ["specific force " + axis + ", m/s²" for axis in "xyz"]
    names += ["angular acceleration " + axis + ", rad/s²" for axis in "xyz"]
    rows = []
    for name, one, other in zip(names, expected.T, measured.T, strict=True):
        gap = one - other
        rows.append([name, *(f"{value:.3g}" for value in (other.std(), gap.mean(), gap.std()))])
    heads = ("one step", "flown, std", "residual, mean", "residual, std")
    return text_table(f"{vehicle.name}: from commands, {len(measured)} steps", heads, rows)


def in_body(rotation, vectors):
    """Turn vectors, (n, 3), from world to body axes."""
    return np.einsum("nji,nj->ni", rotation, vectors)


def lagged(signal, time_constant, delay, step=STEP):
    """Return a signal, (n, k), after a delay and a first-order lag, both in s."""
    rows = np.arange(len(signal))
    columns = [np.interp(rows - delay / step, rows, column) for column in signal.T]
    late = np.stack(columns, axis=1)
    share = 1.0 - np.exp(-step / time_constant) if time_constant > 0.0 else 1.0
    result = late.copy()
    for row in range(1, len(late)):
        result[row] = result[row - 1] + share * (late[row] - result[row - 1])
    return result


# --- (c) lags and slopes --------------------------------------------------------------------------


def lag_table(runs, title):
    """Return, by axis, three estimates of the lag and the slope, with 95 % jackknife intervals.

    Cross-correlation and plain regression are what one would try first. In a closed loop both are
    wrong: the command reacts to the very motion that it is compared with.
    """
    rows = []
    for axis, name in enumerate(AXES):
        whole = np.array(estimates(runs, axis))
        parts = np.array([estimates(runs[:i] + runs[i + 1 :], axis) for i in range(len(runs))])
        spread = 1.96 * np.sqrt((len(runs) - 1) * parts.var(axis=0))
        texts = []
        for value, width in zip(whole, spread, strict=True):
            texts.append(f"{value:.3g} ± {width:.2g}")
        rows.append([name, *texts, f"{resonance(runs, axis):.1f}"])
    heads = (
        "axis",
        "cross-correlation, ms",
        "regression: slope",
        "ARX: lag, ms",
        "of it delay, ms",
        "ARX: slope",
        "resonance, Hz",
    )
    return text_table(title, heads, rows)


def estimates(runs, axis):
    """Return lag by cross-correlation, slope by regression, and ARX's lag, delay and slope."""
    lag, slope = correlated(runs, axis)
    time_constant, delay, found = fit_step(step_response(runs, axis))
    return lag, slope, time_constant + delay, delay, found


def accelerations(run, axis):
    """Return the effect of a command: an angular acceleration, or the specific force."""
    response = run.response[:, axis]
    return response if axis == 3 else np.gradient(response, STEP)


def correlated(runs, axis, width=5, most=15):
    """Return the shift, ms, at which commands and accelerations agree best, and the slope there."""
    kernel = np.ones(width) / width
    total = np.zeros(most + 1)
    energy = 0.0
    for run in runs:
        command = np.convolve(run.commands[:, axis], kernel, "valid")
        effect = np.convolve(accelerations(run, axis), kernel, "valid")
        command = command - command.mean()
        effect = effect - effect.mean()
        n = len(command) - most
        total += [command[:n] @ effect[shift : shift + n] for shift in range(most + 1)]
        energy += command[:n] @ command[:n]
    best = int(np.clip(np.argmax(total), 1, most - 1))
    before, here, after = total[best - 1 : best + 2]
    top = 0.5 * (after - before) / (2.0 * here - before - after)
    return 1000.0 * STEP * (best + np.clip(top, -1, 1)), here / energy


def step_response(runs, axis):
    """Return the acceleration, (30,), after a step of the command, from an ARX model.

    The next response is predicted from PAST earlier ones and COMMANDS earlier commands. This
    separates the controller's reaction from the effect of the motors, as long as that takes at
    least one sample (Ljung, System Identification, 2nd ed., 13.4).
    """
    regressors = []
    targets = []
    for run in runs:
        command = run.commands[:, axis] - run.commands[:, axis].mean()
        response = run.response[:, axis] - run.response[:, axis].mean()
        n = len(response)
        columns = [response[COMMANDS - lag : n - lag] for lag in range(1, PAST + 1)]
        columns += [command[COMMANDS - lag : n - lag] for lag in range(1, COMMANDS)]
        regressors.append(np.stack(columns, axis=1))
        targets.append(response[COMMANDS:])
    weights = np.linalg.lstsq(np.concatenate(regressors), np.concatenate(targets), rcond=None)[0]
    past = weights[:PAST]
    direct = np.concatenate([[0.0], weights[PAST:], np.zeros(10)])
    impulse = np.zeros(30)
    for k in range(30):
        for lag in range(1, min(k, PAST) + 1):
            impulse[k] += past[lag - 1] * impulse[k - lag]
        impulse[k] += direct[k]
    return np.cumsum(impulse) if axis == 3 else impulse / STEP


def fit_step(response, used=20):
    """Return time constant and delay, ms, and the slope of b (1 - exp(-(t - delay) / τ))."""
    times = 10.0 * np.arange(used)
    least = np.inf
    best = (0, 0, 0.0)
    for time_constant in range(10, 140, 2):
        for delay in range(-10, 40, 2):
            after = np.maximum(times - delay, 0.0)
            shape = 1.0 - np.exp(-after / time_constant)
            slope = shape @ response[:used] / (shape @ shape)
            error = np.sum((response[:used] - slope * shape) ** 2)
            if error < least:
                least = error
                best = (time_constant, delay, slope)
    return best


def resonance(runs, axis, n=256):
    """Return the strongest frequency, Hz, from 2.5 to 12 Hz, of the commands."""
    frequencies = np.fft.rfftfreq(n, STEP)
    power = np.zeros(len(frequencies))
    window = np.hanning(n)
    for run in runs:
        command = run.commands[:, axis]
        for begin in range(0, len(command) - n, n // 2):
            piece = command[begin : begin + n]
            power += np.abs(np.fft.rfft(window * (piece - piece.mean()))) ** 2
    # A running mean is enough; a least-squares fit of a smooth curve would also do.
    power = np.convolve(power, np.ones(3) / 3.0, "same")
    inside = (frequencies > 2.5) & (frequencies < 12.0)
    return float(frequencies[inside][np.argmax(power[inside])])


def estimate_table(logs):
    """Return what can be estimated from the motion directly, with 95 % jackknife intervals."""
    names = (
        "mass by thrust, g",
        "drag in x, y by mass, 1/s",
        "moment by airspeed, mN m by m/s",
        "inertia about x, 1e-5 kg m², from ARX's slope",
        "inertia about y, 1e-5 kg m², from ARX's slope",
    )

    def given(some):
        runs = [run_of(log) for log in some]
        slopes = [fit_step(step_response(runs, axis))[2] for axis in (0, 1)]
        return np.array([*fit_forces(some), *(1e5 * ARM / np.array(slopes))])

    values = given(logs)
    parts = np.array([given(logs[:i] + logs[i + 1 :]) for i in range(len(logs))])
    spread = 1.96 * np.sqrt((len(logs) - 1) * parts.var(axis=0))
    rows = []
    for name, value, width in zip(names, values, spread, strict=True):
        rows.append([name, f"{value:.3g} ± {width:.2g}"])
    return text_table(f"estimated from {len(logs)} flights", ("parameter", "value"), rows)


def fit(logs, vehicle, names=("mass", "drag", "drag_z"), iterations=4):
    """Fit parameters to the open loop by least squares (Gauss and Newton), flight by flight.

    :return: the fitted vehicle, and half the width of the 95 % interval of each parameter relative
        to its value, by leaving out one flight at a time (jackknife).
    """
    for _ in range(iterations):
        squares = []
        products = []
        for log in logs:
            here = gaps(log, vehicle, names)
            columns = []
            for name in names:
                there = gaps(log, scaled(vehicle, {name: 1.01}), names)
                columns.append((there - here) / np.log(1.01))
            slopes = np.stack(columns, axis=1)
            squares.append(slopes.T @ slopes)
            products.append(-slopes.T @ here)
        step = np.linalg.solve(sum(squares), sum(products))
        parts = []
        for one, other in zip(squares, products, strict=True):
            if len(logs) > 1:
                parts.append(np.linalg.solve(sum(squares) - one, sum(products) - other))
        step = np.clip(step, -0.5, 0.5)
        vehicle = scaled(vehicle, dict(zip(names, np.exp(step), strict=True)))
    spread = 1.96 * np.sqrt((len(logs) - 1) * np.var(parts, axis=0)) if parts else None
    return vehicle, spread


def scaled(vehicle, factors):
    """Return a vehicle some of whose parameters are multiplied; thrusts keep their limits in N."""
    drag = np.array(vehicle.drag)
    drag[:2] *= factors.get("drag", 1.0)
    drag[2] *= factors.get("drag_z", 1.0)
    inertia = np.array(vehicle.inertia) * factors.get("inertia", 1.0)
    changes = {
        "mass": vehicle.mass * factors.get("mass", 1.0),
        "drag": tuple(drag),
        "inertia": tuple(inertia),
        "motor_gain": vehicle.motor_gain_up * factors.get("motor_gain", 1.0),
        "rotor_thrust_limits": vehicle.thrust_range,
    }
    return vehicle.model_copy(update=changes)


def gaps(log, vehicle, names):
    """Return how far the open loop is off after 0.1 and 0.2 s: positions by 0.01 m, velocities by
    0.1 m/s, and if the inertia is fitted, attitudes by 0.05 rad and rates by 0.5 rad/s.
    """
    found = []
    for time, predictions, end in open_loop([log], vehicle, stride=5):
        if time > 0.25:
            break
        flown = state_of(end)
        simulated = state_of(predictions[0])
        found.append((simulated.position - flown.position) / 0.01)
        found.append((simulated.velocity - flown.velocity) / 0.1)
        if "inertia" in names:
            between = np.einsum("nji,njk->nik", flown.rotation, simulated.rotation)
            found.append(between[:, [2, 0, 1], [1, 2, 0]] / 0.05)
            found.append((simulated.body_rates - flown.body_rates) / 0.5)
    return np.concatenate(found).ravel()


def fit_text(vehicle, spread, names):
    """Return the lines of a vehicle file that were fitted."""
    values = {"mass": vehicle.mass, "drag": vehicle.drag[0], "drag_z": vehicle.drag[2]}
    lines = []
    for name, width in zip(names, spread, strict=True):
        lines.append(f"{name}: {values[name]:.4g} ± {values[name] * width:.2g}")
    return "\n".join(lines)


def fit_forces(logs):
    """Return mass from thrust, g; drag divided by mass, 1/s; and the moment per airspeed, mN m s/m.

    The commands go through the lag of the whole thrust (below). The moment is what the controller
    counteracts at low frequencies, where a vehicle hardly turns.
    """
    lift = []
    side = []
    held = []
    for log in logs:
        rows = longest_flight(log)
        state = state_of(log.motion[rows])
        force = in_body(state.rotation, np.gradient(state.velocity, STEP, axis=0) + GRAVITY)
        airspeed = in_body(state.rotation, state.velocity)
        commands = log.thrusts[rows] @ SIDES.T
        total = lagged(commands[:, 3:], 0.07, 0.0)[:, 0]
        lift.append([total @ force[:, 2], total @ total])
        for axis in (0, 1):
            speed = airspeed[:, axis] - airspeed[:, axis].mean()
            pull = force[:, axis] - force[:, axis].mean()
            side.append([-speed @ pull, speed @ speed])
        # Moving forward requires a pitching moment; moving left, a rolling moment.
        for axis, along, sign in ((1, 0, 1.0), (0, 1, -1.0)):
            speed = airspeed[:, along] - airspeed[:, along].mean()
            moment = ARM * (commands[:, axis] - commands[:, axis].mean())
            held.append([sign * speed @ moment, speed @ speed])
    ratios = [np.divide(*np.sum(sums, axis=0)) for sums in (lift, side, held)]
    return 1000.0 / ratios[0], ratios[1], 1000.0 * ratios[2]


def moment_table(logs, vehicle, moment):
    """Return the errors in open loop if airspeed turns the vehicle, which our dynamics leave out.

    :param moment: about y for a speed along x, N m by m/s; about x for one along y its negative.
    """
    rows = {}

    def push(batch):
        state = batch.true_state()
        speed = in_body(state.rotation, state.velocity)
        batch.wrench[TORQUE_BODY] = moment * np.stack(
            [speed[:, 1], -speed[:, 0], 0.0 * speed[:, 0]]
        )

    for time, predictions, end in open_loop(logs, vehicle, before_step=push):
        for quantity, error in zip(QUANTITIES, errors(predictions[0], end), strict=True):
            rows[f"{quantity}, after {time:g} s"] = f"{error:.3g}"
    title = f"drag {vehicle.drag[0]:.3f} N s/m, and {1000 * moment:.2g} mN m by m/s of airspeed"
    return text_table(title, ("open loop", "simulated"), [[k, rows[k]] for k in sorted(rows)])


# --- (d) closed loop ------------------------------------------------------------------------------


class Cascade:
    """A controller like the firmware's: position, velocity, attitude, rates.

    Gains, limits and units are those of crazyflie-firmware 2025.12 (platform_defaults_cf2.h,
    position_controller_pid.c, attitude_pid_controller.c): degrees, and motors of 0 to 65,535 for 0
    to 0.12 N. The position is controlled at 100 Hz, attitude and rates at every control step.
    """

    UNIT = 0.12 / 65535.0  # N
    MOST = 1.27 * 65535.0  # of a motor: full PWM at 3.4 V yields this share of 0.12 N

    def __init__(self, vehicle, n):
        self.vehicle = vehicle
        self.step = vehicle.control_step
        self.every = max(1, round(0.01 / self.step))
        self.steps = 0
        self.fallen = np.zeros((n, 3))  # integrals
        self.climb = np.zeros(n)
        self.tilt = np.zeros((n, 3))
        self.spin = np.zeros((n, 3))
        self.before = None
        x, y = np.array(vehicle.rotor_positions).T
        directions = np.array(vehicle.rotor_directions)
        self.mixer = np.stack([np.ones(4), np.sign(y) / 2.0, -np.sign(x) / 2.0, directions])
        # The firmware's height integral learns the vehicle's weight; here it starts with it.
        self.fallen[:, 2] = (vehicle.hover_thrust / self.UNIT - 36000.0) / 15000.0

    def thrusts(self, state, target, rates):
        """Return rotor thrusts, (n, 4), N, on the way to targets (n, 3); the heading stays 0."""
        rotation = state.rotation
        roll = np.degrees(np.arctan2(rotation[:, 2, 1], rotation[:, 2, 2]))
        pitch = np.degrees(-np.arcsin(np.clip(rotation[:, 2, 0], -1.0, 1.0)))
        yaw = np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])
        if self.steps % self.every == 0:
            self._position(state, target, yaw)
        self.steps += 1

        error = np.stack([self.roll - roll, self.pitch - pitch, -np.degrees(yaw)], axis=1)
        self.tilt = np.clip(self.tilt + error * self.step, -20.0, 20.0)
        wanted = 6.0 * error + self.tilt * [3.0, 3.0, 1.0]
        rates = np.degrees(rates)
        if self.before is None:
            self.before = rates
        error = wanted - rates
        self.spin = np.clip(self.spin + error * self.step, -33.3, 33.3)
        slowing = (self.before - rates) / self.step
        self.before = rates
        moments = error * [250.0, 250.0, 120.0] + self.spin * [500.0, 500.0, 16.7]
        moments = np.clip(moments + slowing * [2.5, 2.5, 0.0], -32767.0, 32767.0)
        motors = np.column_stack([self.thrust, moments]) @ self.mixer
        # The excess of one motor is subtracted from all.
        motors -= np.maximum(motors.max(axis=1, keepdims=True) - self.MOST, 0.0)
        return self.UNIT * np.maximum(motors, 0.0)

    def _position(self, state, target, yaw):
        step = self.step * self.every
        error = target - state.position
        self.climb += error[:, 2] * step
        velocity = 2.0 * error
        velocity[:, 2] += 0.5 * self.climb
        missing = np.clip(velocity, -1.1, 1.1) - state.velocity
        self.fallen += missing * step
        ahead = 25.0 * missing[:, :2] + self.fallen[:, :2]
        cosine, sine = np.cos(yaw), np.sin(yaw)
        self.pitch = np.clip(cosine * ahead[:, 0] + sine * ahead[:, 1], -20.0, 20.0)
        self.roll = np.clip(sine * ahead[:, 0] - cosine * ahead[:, 1], -20.0, 20.0)
        lift = 25.0 * missing[:, 2] + 15.0 * self.fallen[:, 2]
        self.thrust = np.clip(36000.0 + 1000.0 * np.clip(lift, -32.7, 32.7), 20000.0, 65535.0)


def closed_loop_table(logs, vehicle):
    """Fly recorded setpoints; return the distances from them, next to those of the real flight."""
    rows = []
    for log in logs:
        part = longest_flight(log)
        setpoint = columns_of(log, [f"sp_ctrltarget_{axis}" for axis in "xyz"])[part]
        position = state_of(log.motion[part]).position
        texts = [f"{off(position, setpoint):.3f}"]
        for kind in ("cascade", "PID"):
            texts.append(f"{off(follow(vehicle, setpoint, position[0], kind), setpoint):.3f}")
        rows.append([log.path.stem, *texts])
    heads = ("off the setpoint, rms, m", "flown", "cascade, simulated", "PIDExpert, simulated")
    return text_table(f"{vehicle.name}: closed loop on recorded setpoints", heads, rows)


def off(position, setpoint):
    """Return the root mean square distance from the setpoints after 2 s."""
    return float(np.sqrt(np.sum((position - setpoint)[200:] ** 2, axis=1).mean()))


def follow(vehicle, setpoint, begin, kind):
    """Fly setpoints, (n, 3), 0.01 s apart, and return the positions."""
    if kind == "cascade":
        # Attitude and rates are controlled at 500 Hz, as in the firmware.
        vehicle = fast(vehicle)
    batch = started(vehicle, 1, begin)
    cascade = Cascade(vehicle, 1)
    expert = PIDExpert(vehicle)
    positions = []
    for target in setpoint:
        batch.fix("target", target[:, None])
        positions.append(batch.true_state().position[0].copy())
        for _ in range(round(STEP / vehicle.control_step)):
            state = batch.true_state()
            if kind == "cascade":
                thrusts = cascade.thrusts(state, target[None], state.body_rates)
                actions = vehicle.thrust_to_action(thrusts)
            else:
                actions = expert.actions(state)
            batch.step(actions)
    return np.array(positions)


def fast(vehicle):
    """Return the vehicle with control steps of 0.002 s."""
    changes = {"control_step": 0.002, "physics_step": 0.002}
    changes["delay"] = round(vehicle.delay * vehicle.control_step / 0.002)
    return vehicle.model_copy(update=changes)


def started(vehicle, n, position):
    """Return a batch that hovers at a position."""
    settings = FlightSettings(vehicle=vehicle, noise=0.0, max_episode_steps=10**6)
    batch = QuadcopterBatch(n, settings, seed=0, autoreset=False, n_threads=1)
    batch.reset()
    batch.fix("position", np.repeat(np.reshape(position, (3, 1)), n, axis=1))
    batch.fix("quaternion", np.repeat([[1.0], [0.0], [0.0], [0.0]], n, axis=1))
    batch.fix("velocity", np.zeros((3, n)))
    batch.fix("body_rates", np.zeros((3, n)))
    return batch


# --- what the estimates make of a known lag -------------------------------------------------------


def print_control(vehicle):
    """Print the table of lags for simulated flights whose lag is known."""
    for time_constant, delay in ((0.0645, 1), (0.04, 0), (0.02, 1)):
        changes = {"motor_gain": 1.0 / time_constant, "delay": delay, "motor_integration": "exact"}
        known = vehicle.model_copy(update=changes)
        slopes = known.mixer[1:].max(axis=1) / known.inertia
        truth = ", ".join(f"{slope:.0f}" for slope in slopes)
        title = (
            f"simulated: motors {1000 * time_constant:g} ms, delay {10 * delay} ms; "
            f"slopes {truth}, {1.0 / known.mass:.1f}"
        )
        show(lag_table(simulated_runs(known), title))


def simulated_runs(vehicle, n=10, seconds=30.0, torque=1e-4, noise=0.004, seed=0):
    """Fly the cascade along curves in turbulence, and log it as the radio does: commands and
    response at different times, with every tenth sample lost.

    :param torque: standard deviation, N m, of a torque that changes with 8 Hz.
    :param noise: noise of the gyro, rad/s.
    """
    rng = np.random.default_rng(seed)
    vehicle = fast(vehicle)
    batch = started(vehicle, n, [0.0, 0.0, 1.0])
    controller = Cascade(vehicle, n)
    step = vehicle.control_step
    steps = round(seconds / step)
    phases = rng.uniform(0.0, 6.28, (n, 3))
    frequencies = rng.uniform(0.1, 0.3, (n, 3))
    keep = np.exp(-2.0 * np.pi * 8.0 * step)
    push = np.zeros((n, 3))
    commands = np.empty((steps, n, 4))
    response = np.empty((steps, n, 4))
    for now in range(steps):
        state = QuadcopterState(batch.state)
        curve = np.sin(2.0 * np.pi * frequencies * now * step + phases)
        target = curve * [0.8, 0.8, 0.3] + [0.0, 0.0, 1.0]
        gyro = state.body_rates + noise * rng.standard_normal((n, 3))
        commands[now] = controller.thrusts(state, target, gyro)
        lift = vehicle.lift * (state.rotor_speeds**2).sum(axis=1) / vehicle.mass
        response[now] = np.column_stack([gyro, lift])
        fresh = torque * rng.standard_normal((n, 3)) * [1.0, 1.0, 0.2]
        push = keep * push + np.sqrt(1.0 - keep**2) * fresh
        batch.wrench[TORQUE_BODY] = push.T
        batch.step(vehicle.thrust_to_action(commands[now]))
    return [
        Run(
            radioed(commands[:, row], step, rng) @ SIDES.T,
            radioed(response[:, row], step, rng),
        )
        for row in range(n)
    ]


def radioed(signal, step, rng):
    """Return a signal, (n, k), sampled at 100 Hz with losses and interpolated, from 4 s on."""
    times = np.arange(3.9 + rng.uniform(0.0, 0.01), len(signal) * step - 0.05, STEP)
    times = times[rng.uniform(size=times.size) > 0.1]
    rows = np.round(times / step).astype(int)
    grid = np.arange(4.0, times[-1], STEP)
    columns = [np.interp(grid, rows * step, column) for column in signal[rows].T]
    return np.stack(columns, axis=1)[: round((len(signal) * step - 4.2) / STEP)]


if __name__ == "__main__":
    main()
