"""Fit a vehicle file to real flights, and judge it by flights that were left out.

    python examples/real_flights.py FOLDER [--vehicle FILE] [--leave-out NAME …]

FOLDER holds CSV files in the format of NanoBench: docs/vehicles.md lists their columns. You see how
far the simulated vehicle departs from the flights on their recorded commands, before and after the
fit; and for each axis, how late and how strongly the motion follows the commands.
docs/research/reality.md has the results for eleven flights of a Crazyflie.
"""

import argparse
from dataclasses import dataclass

import numpy as np
from rich.console import Console

from sb3_quad import load_vehicle
from sb3_quad.envs.simulation.state import QuadcopterState
from sb3_quad.evaluation.real_flights import error_table, open_loop, read_logs
from sb3_quad.evaluation.tables import Table

STEP = 0.01  # s, of the estimates
AXES = ("roll", "pitch", "yaw", "thrust")
# From thrusts of M1 to M4 (front right, back right, back left, front left) to what turns or lifts:
# the difference between two sides, N, or the sum
SIDES = np.array([[-1, -1, 1, 1], [-1, 1, 1, -1], [-1, 1, -1, 1], [1, 1, 1, 1]])
# Number of past rates and of past commands in the model that predicts the next rate
PAST = 12
COMMANDS = 25
FITTED = ("mass", "drag", "drag_z")


@dataclass
class Run:
    """The data of one flight for the estimates, in rows 0.01 s apart."""

    commands: np.ndarray  # (n, 4), by axis, N
    response: np.ndarray  # (n, 4), body rates (rad/s) and specific force along z (m/s²)


def main():
    """Read, measure, fit, judge."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder")
    parser.add_argument("--vehicle", default="crazyflie_nanobench", help="name or YAML file")
    parser.add_argument("--leave-out", nargs="*", default=None, help="flights that judge the fit")
    arguments = parser.parse_args()
    vehicle = load_vehicle(arguments.vehicle)
    logs = [log for log in read_logs(arguments.folder, STEP) if log.flying.any()]
    fitted, judged = split(logs, arguments.leave_out)
    if len(fitted) < 2:
        raise SystemExit(f"{arguments.folder}: two flights, or more, must be left to fit")
    print("fitted:", ", ".join(log.path.stem for log in fitted))
    print("judged:", ", ".join(log.path.stem for log in judged))
    console = Console(width=160)
    console.print(lag_table([run_of(log) for log in logs]))
    console.print(error_table(judged, vehicle))
    better, spread = fit(fitted, vehicle)
    print(fit_text(better, spread))
    console.print(error_table(judged, better.model_copy(update={"name": "fitted"})))


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


def run_of(log):
    """Return commands and response of a log's flight."""
    rows = longest_flight(log)
    state = state_of(log.motion[rows])
    acceleration = np.gradient(state.velocity, STEP, axis=0)
    acceleration[:, 2] += 9.81
    # The specific force along the body's z axis, which an accelerometer would show.
    force = np.einsum("nj,nj->n", state.rotation[:, :, 2], acceleration)
    response = np.column_stack([state.body_rates, force])
    return Run(log.thrusts[rows] @ SIDES.T, response)


def lag_table(runs):
    """Return lag and slope by axis, with 95 % jackknife intervals.

    A cross-correlation would be wrong: in a closed loop, the command reacts to the very motion that
    it is compared with.
    """
    rows = []
    for axis, name in enumerate(AXES):
        whole = np.array(estimates(runs, axis))
        parts = np.array([estimates(runs[:i] + runs[i + 1 :], axis) for i in range(len(runs))])
        spread = 1.96 * np.sqrt((len(runs) - 1) * parts.var(axis=0))
        texts = []
        for value, width in zip(whole, spread, strict=True):
            texts.append(f"{value:.3g} ± {width:.2g}")
        rows.append([name, *texts])
    heads = ("axis", "lag, ms", "of it delay, ms", "slope")
    return Table(heads, rows, "from commands to motion")


def estimates(runs, axis):
    """Return lag and delay, ms, and the acceleration for a newton, of an axis."""
    time_constant, delay, slope = fit_step(step_response(runs, axis))
    return time_constant + delay, delay, slope


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


def fit(logs, vehicle, names=FITTED, iterations=4):
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
            parts.append(np.linalg.solve(sum(squares) - one, sum(products) - other))
        step = np.clip(step, -0.5, 0.5)
        vehicle = scaled(vehicle, dict(zip(names, np.exp(step), strict=True)))
    spread = 1.96 * np.sqrt((len(logs) - 1) * np.var(parts, axis=0))
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


def fit_text(vehicle, spread):
    """Return the lines of a vehicle file that were fitted."""
    values = {"mass": vehicle.mass, "drag": vehicle.drag[0], "drag_z": vehicle.drag[2]}
    lines = []
    for name, width in zip(FITTED, spread, strict=True):
        lines.append(f"{name}: {values[name]:.4g} ± {values[name] * width:.2g}")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
