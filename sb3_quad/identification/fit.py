"""A vehicle's parameters from logs of its flights, by the error of predictions over many steps.

Recorded commands fly from recorded states, and least squares bring the predictions to what was
recorded: first over short horizons, then over all. What is known is held: mass, arms, directions of
the rotors. Intervals follow from leaving out one block of the flights at a time (jackknife), with
the equations linearised at the optimum.
"""

from collections.abc import Callable, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy.optimize import least_squares
from scipy.signal import detrend, savgol_filter
from scipy.stats import t as student

from sb3_quad.base.errors import ConfigError, raised_as
from sb3_quad.base.types import FloatArray, IntArray, StrDict
from sb3_quad.envs.simulation.state import VELOCITY
from sb3_quad.envs.vehicles.vehicle import MAX_PHYSICS_STEP, Vehicle
from sb3_quad.identification.curve import Curve, refuse_other_order, regress
from sb3_quad.identification.flight_log import MOTION_SIZE, Log
from sb3_quad.identification.open_loop import Windows, gaps, log_thrusts
from sb3_quad.identification.parameters import FASTEST, Guess, parameters_of

Show = Callable[[int, int, str], object]
# Short and long horizons of logs with velocity, and of body rates alone, s
HORIZONS = np.array([0.02, 0.05, 0.1]), np.array([0.05, 0.1, 0.2, 0.3, 0.5])
HORIZONS_OF_RATES = np.arange(0.02, 0.11, 0.02), np.arange(0.02, 0.21, 0.02)
WARM_UP = 0.25  # s
SMOOTHED = 0.1  # s
MOST_WINDOWS = 750
# Of position, velocity, attitude, body rates and specific force, in the units of the motion: errors
# of this size count as one in the first fit.
ERRORS = (0.1, 0.4, 0.15, 0.4, 2.0)
# Lags and delays that the regression tries, s
LAGS = np.array([0.01, 0.015, 0.02, 0.03, 0.045, 0.06, 0.08, 0.11, 0.15])
DELAYS = np.arange(0.0, 0.035, 0.005)
DIFFERENCE = 2e-3
BLOCKS = 20
MOST_THRUST = 30.0  # of a motor at full command, by what it needs to hover
# Half an interval, as a part of its value, beyond which the logs do not tell a parameter
LARGEST_WIDTH = 0.7
# No interval is narrower than this part of its value, or this many seconds of a delay: simulated
# logs with noise show such errors beyond the jackknife's intervals.
LEAST_WIDTH = 0.03
LEAST_DELAY_WIDTH = 0.0015


class Fit(NamedTuple):
    """A vehicle from logs."""

    vehicle: Vehicle
    curve: Curve  #: thrust of a motor over its command
    #: a row for each parameter: its field, name and unit, start, value, width, which is half of the
    #: 95 % interval, and the reason why the logs do not tell it, if so
    estimates: pd.DataFrame


class Model:
    """The errors of predictions as a function of a vector.

    :param logs: the logs.
    :param start: what the vector changes.
    :param horizons: where predictions are compared, s.
    """

    def __init__(self, logs: Sequence[Log], start: Guess, horizons: FloatArray) -> None:
        self.logs = logs
        self.start = start
        self.table = parameters_of(logs, start)
        self.scale = self.table["size"].to_numpy()
        self.limits = self.table[["least", "most"]].to_numpy()
        self.has_motion = logs[0].has_motion
        step = logs[0].step
        ends = sorted({max(round(horizon / step), 1) for horizon in horizons})
        # Windows of body rates alone share no sample.
        stride = ends[-1]
        if self.has_motion:
            stride = max(1, sum(log.flying.sum() for log in logs) // MOST_WINDOWS)
        self.windows = Windows(logs, start.vehicle, ends, stride, WARM_UP)
        if self.has_motion:
            # The noise of where a window begins would grow with some parameters, and bias them.
            smooth = np.concatenate([_smoothed(log) for log in logs])
            self.windows.start = smooth[self.windows.rows]
        self.force = np.concatenate([log.force for log in logs])
        self.sizes = [np.full((len(ends), 1), size) for size in ERRORS]

    def parts(self, vector: FloatArray) -> list[FloatArray]:
        """Return errors of position, velocity, attitude, body rates and specific force, (windows,
        horizons, columns) each.
        """
        guess = self.start.moved(vector * self.scale)
        windows = self.windows
        thrusts = log_thrusts(self.logs, guess.vehicle, guess.curve, guess.delay)
        errors = []
        for end, flown in zip(windows.ends, windows.fly(guess.vehicle, thrusts), strict=True):
            rows = windows.rows + end
            force = flown[:, MOTION_SIZE:] - self.force[rows]
            errors.append([*gaps(flown, windows.record[rows]), force])
        parts = [np.stack(one, axis=1) for one in zip(*errors, strict=True)]
        # The first body rate of a window is as noisy as the others: only changes count. Where the
        # airspeed is unknown, so are the moments of the air, which change slowly.
        parts[3] = detrend(parts[3], 1, "constant" if self.has_motion else "linear")
        # An accelerometer is hardly mounted exactly. Without the airspeed, x and y say nothing.
        parts[4][..., :2] -= parts[4][..., :2].mean(axis=(0, 1))
        if not self.has_motion:
            parts[4] = parts[4][..., 2:]
        return parts

    def residuals(self, vector: FloatArray) -> FloatArray:
        """Return the errors that logs tell by their sizes, (windows, n)."""
        scaled = []
        for part, size in zip(self.parts(vector), self.sizes, strict=True):
            scaled.append((part / size).reshape(len(part), -1))
        known = np.hstack(scaled if self.has_motion else scaled[3:])
        # Predictions that diverge must not become infinite.
        return np.asarray(np.clip(known, -1e3, 1e3))

    def weigh(self, vector: FloatArray) -> None:
        """Count errors by the size that they have now, each column after each horizon."""
        for number, part in enumerate(self.parts(vector)):
            spread = 1.4826 * np.median(np.abs(part), axis=0)
            self.sizes[number] = np.maximum(spread, 1e-3 * ERRORS[number])

    def solve(
        self, vector: FloatArray, free: IntArray, evaluations: int
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Find the vector with the least errors (soft L1) near a start.

        :param free: the elements of the vector that may change.
        :return: the vector, the slopes of the errors, (windows, n, free), and the errors, (windows,
            n), weighted so that their normal equations are those of soft L1.
        """
        fitted = vector.copy()

        def residuals(values: FloatArray) -> FloatArray:
            fitted[free] = values
            return self.residuals(fitted).ravel()

        def slopes(values: FloatArray) -> FloatArray:
            here = residuals(values)
            steps = DIFFERENCE * np.eye(len(free))
            return np.stack([residuals(values + step) - here for step in steps], 1) / DIFFERENCE

        limits = self.limits[free].T
        solution = least_squares(
            residuals,
            np.clip(vector[free], *limits),
            slopes,
            limits,
            loss="soft_l1",
            max_nfev=evaluations,
            xtol=1e-4,
            ftol=1e-5,
        )
        fitted[free] = solution.x
        # SciPy has weighted the slopes, but not the errors.
        errors = solution.fun * (1.0 + solution.fun**2) ** 0.25
        windows = len(self.windows.rows)
        jacobian = solution.jac.reshape(windows, -1, len(free))
        return fitted, jacobian, errors.reshape(windows, -1)


def fit_vehicle(
    logs: Sequence[Log], start: Vehicle, name: str = "fitted", show: Show | None = None
) -> Fit:
    """Fit a vehicle to logs.

    :param logs: of one vehicle, with the same step.
    :param start: what is known: mass, positions and directions of the rotors, and the ratio of the
        third moment of inertia to the sum of the others; and where the fit begins.
    :param name: of the vehicle that is returned.
    :param show: called with what is done, the total, and what is being done.
    :raises ConfigError: the logs contradict the start, or do not fly for long enough.
    """
    report = show or (lambda done, total, text: None)
    report(0, 5, "regressions")
    guess = first_guess(logs, start)
    short, long = HORIZONS if logs[0].has_motion else HORIZONS_OF_RATES
    report(1, 5, "short horizons")
    model = Model(logs, guess, short)
    table = model.table
    free = np.flatnonzero(table["reason"] == "")
    vector, *_ = model.solve(guess.vector() / model.scale, free, 12)
    report(2, 5, "all horizons")
    # Sizes are those of the fit so far, since damping grows with the inertia.
    guess = guess.moved(vector * model.scale)
    model = Model(logs, guess, long)
    vector = guess.vector() / model.scale
    for _ in range(2):
        model.weigh(vector)
        vector, slopes, errors = model.solve(vector, free, 8)
    report(3, 5, "what the logs tell")
    before = guess._replace(vehicle=start)
    known = before.vector() / model.scale
    for place, reason in _not_told(model, vector, free, slopes, errors).items():
        vector[place] = known[place]
        table.loc[place, "reason"] = reason
    free = np.flatnonzero(table["reason"] == "")
    vector, slopes, errors = model.solve(vector, free, 8)
    known[free] = vector[free]
    table["start"] = before.vector()
    table["value"] = known * model.scale
    delay = len(guess.curve.coefficients)
    widths = np.full(len(table), np.nan)
    widths[free] = jackknife(slopes, errors) * model.scale[free]
    least = LEAST_WIDTH * np.abs(table["value"].to_numpy())
    least[delay] = LEAST_DELAY_WIDTH
    table["width"] = np.maximum(widths, least)
    # The delay of a vehicle is a whole number of control steps, and its lag makes up for the rest.
    report(4, 5, "with whole steps of delay")
    steps = round(table["value"][delay] / start.control_step)
    vector[delay] = steps * start.control_step / model.scale[delay]
    vector, *_ = model.solve(vector, free[free != delay], 5)
    known[free] = vector[free]
    report(5, 5, "done")
    with raised_as(ConfigError, f"{logs[0].path}: the fit is no vehicle that can fly"):
        fitted = before.moved(known * model.scale)
    return Fit(_with_limits(fitted, name, steps), fitted.curve, table)


def _smoothed(log: Log) -> FloatArray:
    """Return the motion of a log with position, attitude and velocity smoothed, (n, 13)."""
    motion = log.motion.copy()
    slow = slice(0, VELOCITY.stop)
    size = round(SMOOTHED / log.step) // 2 * 2 + 1
    motion[:, slow] = savgol_filter(motion[:, slow], size, 2, axis=0)
    return motion


def first_guess(logs: Sequence[Log], start: Vehicle) -> Guess:
    """Return what regressions of the specific force say about curve, lag and delay of the motors.

    :raises ConfigError: motors turn the vehicle otherwise than its file says.
    """
    kind = logs[0].kind
    gains = np.array([FASTEST]) if kind == "rotor_speed" else 1.0 / LAGS
    pairs = [*product(gains.tolist(), DELAYS.tolist())]
    curves = [regress(logs, start, *pair) for pair in pairs]
    best = int(np.argmin([rest for _, rest in curves]))
    curve, _ = curves[best]
    gain, delay = pairs[best]
    for log in logs:
        refuse_other_order(log, start, log_thrusts([log], start, curve, delay))
    strongest = max(curve.thrust(log.mean_commands()).max() for log in logs)
    changes: StrDict = {
        "motor_gain": gain,
        "motor_integration": "exact",
        "control_step": logs[0].step,
        "physics_step": MAX_PHYSICS_STEP,
        "delay": 0,
        # Nothing is clipped, and the search may pass through anything.
        "allow_impossible_inertia": True,
        "rotor_thrust_limits": (0.0, 4.0 * max(strongest, start.hover_thrust)),
    }
    if kind == "rotor_speed":
        changes["thrust_coefficient"] = float(curve.coefficients[0])
    # Commands that cannot be right are refused at once.
    _with_limits(Guess(start, curve, 0.0), start.name, 0)
    return Guess(start.model_copy(update=changes), curve, delay)


def jackknife(slopes: FloatArray, errors: FloatArray) -> FloatArray:
    """Return half of the 95 % intervals by leaving out one block of windows at a time, (keys,).

    :param slopes: of the errors, (windows, n, keys).
    :param errors: (windows, n).
    """
    count = min(BLOCKS, len(errors))
    rows = np.array_split(np.arange(len(errors)), count)
    squares = np.array([np.einsum("wni,wnj->ij", slopes[one], slopes[one]) for one in rows])
    products = np.array([np.einsum("wni,wn->i", slopes[one], errors[one]) for one in rows])
    left = squares.sum(axis=0) - squares
    right = products.sum(axis=0) - products
    shifts = [np.linalg.lstsq(*one, rcond=None)[0] for one in zip(left, right, strict=True)]
    return np.asarray(student.ppf(0.975, count - 1) * np.std(shifts, axis=0) * np.sqrt(count - 1))


def _not_told(
    model: Model, vector: FloatArray, free: IntArray, slopes: FloatArray, errors: FloatArray
) -> dict[int, str]:
    """Return which elements of the vector the logs do not tell, and why.

    The least certain one is held first, which makes the others more certain.
    """
    held = {}
    least, most = model.limits.T
    # A value that runs away says nothing.
    far = (least > 0.0) & ((vector < 1.02 * least) | (vector > 0.98 * most))
    for place in free[far[free]].tolist():
        held[place] = f"it would run to {vector[place] * model.scale[place]:.2g}"
    while True:
        kept = np.flatnonzero(~np.isin(free, [*held]))
        widths = jackknife(slopes[:, :, kept], errors)
        shares = widths / np.maximum(np.abs(vector[free[kept]]), 1e-9)
        # Thrust and delay are always fitted.
        shares[: len(model.start.curve.coefficients) + 1] = 0.0
        worst = shares.argmax()
        if shares[worst] <= LARGEST_WIDTH:
            return held
        place = int(free[kept[worst]])
        held[place] = f"its interval would be ± {widths[worst] * model.scale[place]:.2g}"


def _with_limits(fitted: Guess, name: str, delay: int) -> Vehicle:
    """Return a fitted vehicle with the limits of its commands.

    :raises ConfigError: it does not hover.
    """
    vehicle = fitted.vehicle
    changes: StrDict = {"name": name, "motor_integration": "exact", "delay": delay}
    limits = {
        "thrust": vehicle.thrust_range,
        "share": (0.0, 1.0),
        "rotor_speed": vehicle.rotor_speed_range,
    }
    low, high = fitted.curve.thrust(np.array(limits[fitted.curve.kind]))
    if not 1.05 < high / vehicle.hover_thrust < MOST_THRUST:
        raise ConfigError(
            f"the motors would push with {high:.3g} N at full command, and {vehicle.name} needs "
            f"{vehicle.hover_thrust:.3g} N of each to hover; are its mass, and the commands' unit, "
            "right?"
        )
    if fitted.curve.kind == "rotor_speed":
        changes["thrust_coefficient"] = float(fitted.curve.coefficients[0])
    changes["rotor_thrust_limits"] = max(low, 0.01 * vehicle.hover_thrust), high
    return vehicle.model_copy(update=changes)
