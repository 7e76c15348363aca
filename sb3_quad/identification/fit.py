"""A vehicle's parameters from logs of its flights, by the error of predictions over many steps.

Recorded commands fly from recorded states, and least squares bring the predictions to what was
recorded: first over short horizons, then over all. What is known is held: mass, arms, directions of
the rotors. Intervals follow from leaving out one block of the flights at a time (jackknife), with
the equations linearised at the optimum.
"""

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.imports import require
from sb3_quad.base.types import FloatArray, StrDict
from sb3_quad.envs.simulation.state import BODY_RATES, POSITION, QUATERNION, VELOCITY
from sb3_quad.envs.vehicles.vehicle import MAX_PHYSICS_STEP, Vehicle
from sb3_quad.identification.curve import Curve, refuse_other_order, regress
from sb3_quad.identification.flight_log import MOTION_SIZE, Log
from sb3_quad.identification.open_loop import Windows, log_thrusts, turned
from sb3_quad.identification.parameters import (
    DELAY,
    FASTEST,
    FIELDS,
    LARGEST_CHANGE,
    Guess,
    Key,
    Scaling,
    keys_for,
    value,
    with_values,
)

Show = Callable[[int, int, str], object]
# s
SHORT = (0.02, 0.05, 0.1)
LONG = (0.05, 0.1, 0.2, 0.3, 0.5)
SHORT_RATES = (0.02, 0.04, 0.06, 0.08, 0.1)
LONG_RATES = (0.02, 0.04, 0.06, 0.08, 0.1, 0.12, 0.14, 0.16, 0.18, 0.2)
WARM_UP = 0.25
SMOOTHED = 0.1
MOST_WINDOWS = 1500
# Of position, velocity, attitude, body rates and specific force, in the units of the motion: errors
# of this size count as one in the first fit.
ERRORS = (0.1, 0.4, 0.15, 0.4, 2.0)
# Lags and delays that the regression tries, s
LAGS = np.array([0.01, 0.015, 0.02, 0.03, 0.045, 0.06, 0.08, 0.11, 0.15])
DELAYS = np.arange(0.0, 0.035, 0.005)
FACTORS = 2.0 ** np.arange(-3.0, 3.5, 0.5)
DIFFERENCE = 2e-3
BLOCKS = 20
# Half an interval, as a part of a positive parameter or of a typical linear one, beyond which the
# logs do not tell it
LARGEST_WIDTH = 0.4
# No interval is narrower than this part of its value, or this many seconds of a delay: simulated
# logs with noise show such errors beyond the jackknife's intervals.
LEAST_WIDTH = 0.03
LEAST_DELAY_WIDTH = 0.0015


@dataclass(frozen=True)
class Estimate:
    """A parameter by the logs."""

    key: Key
    value: float  #: in its unit
    width: float  #: half of the 95 % interval; NaN if the logs do not tell the parameter
    reason: str = ""  #: why they do not


@dataclass(frozen=True, eq=False)
class Fit:
    """A vehicle from logs."""

    vehicle: Vehicle
    curve: Curve  #: thrust of a motor over its command
    estimates: Sequence[Estimate]


class Model:
    """The errors of predictions as a function of a vector.

    :param logs: the logs.
    :param start: what the vector changes.
    :param keys: its elements.
    :param horizons: where predictions are compared, s.
    """

    def __init__(
        self, logs: Sequence[Log], start: Guess, keys: Sequence[Key], horizons: Sequence[float]
    ) -> None:
        self.logs = logs
        self.scaling = Scaling(start, keys)
        self.has_motion = all(log.has_motion for log in logs)
        step = logs[0].step
        ends = sorted({max(round(horizon / step), 1) for horizon in horizons})
        rows = sum(log.flying.sum() for log in logs)
        # Windows of body rates alone share no sample.
        stride = ends[-1] if not self.has_motion else max(1, round(rows / MOST_WINDOWS))
        self.windows = Windows(logs, start.vehicle, ends, stride, WARM_UP)
        if self.has_motion:
            # The noise of where a window begins would grow with some parameters, and bias them.
            smooth = np.concatenate([_smoothed(log) for log in logs])
            self.windows.start = smooth[self.windows.rows]
        self.force = None
        if all(log.force is not None for log in logs):
            self.force = np.concatenate([log.force for log in logs])
        self.sizes = np.array(ERRORS)[:, None] * np.ones(len(ends))
        self.calls = 0

    def parts(self, vector: FloatArray) -> list[FloatArray]:
        """Return errors of position, velocity, attitude, body rates and specific force where they
        are known, (windows, horizons, columns) each.
        """
        guess = self.scaling.guess(vector)
        windows = self.windows
        thrusts = log_thrusts(self.logs, guess.vehicle, guess.curve, guess.delay)
        found: list[list[FloatArray]] = [[] for _ in ERRORS]
        for end, flown in zip(windows.ends, windows.fly(guess.vehicle, thrusts), strict=True):
            rows = windows.rows + end
            record = windows.record[rows]
            gap = flown[:, :MOTION_SIZE] - record
            if self.has_motion:
                found[0].append(gap[:, POSITION])
                found[1].append(gap[:, VELOCITY])
                found[2].append(turned(flown[:, :MOTION_SIZE], record))
            found[3].append(gap[:, BODY_RATES])
            if self.force is not None:
                found[4].append(flown[:, MOTION_SIZE:] - self.force[rows, None])
        parts = [np.stack(one, axis=1) if one else np.zeros((0, 0, 0)) for one in found]
        # The first body rate of a window is as noisy as the others: only changes count. Where the
        # airspeed is unknown, so are the moments of the air, which change slowly.
        times = np.array(windows.ends, float)
        slow = np.vander(times / times[-1], 1 if self.has_motion else 2)
        parts[3] -= np.einsum("hk,wkc->whc", slow @ np.linalg.pinv(slow), parts[3])
        return parts

    def residuals(self, vector: FloatArray) -> FloatArray:
        """Return all errors by their sizes, (windows, n)."""
        self.calls += 1
        scaled = []
        for part, sizes in zip(self.parts(vector), self.sizes, strict=True):
            if part.size:
                scaled.append((part / sizes[None, :, None]).reshape(len(part), -1))
        # Predictions that diverge must not become infinite.
        return np.asarray(np.clip(np.nan_to_num(np.hstack(scaled), nan=1e3), -1e3, 1e3))

    def slopes(self, vector: FloatArray) -> FloatArray:
        """Return the derivatives of the errors, (windows, n, keys), by differences."""
        here = self.residuals(vector)
        columns = []
        for k in range(len(vector)):
            there = vector.copy()
            there[k] += DIFFERENCE
            columns.append((self.residuals(there) - here) / DIFFERENCE)
        return np.stack(columns, axis=2)

    def weigh(self, vector: FloatArray) -> None:
        """Count errors by the size that they have now, each kind after each horizon."""
        for number, part in enumerate(self.parts(vector)):
            if part.size:
                spread = 1.4826 * np.median(np.abs(part), axis=(0, 2))
                self.sizes[number] = np.maximum(spread, 1e-3 * ERRORS[number])

    def solve(self, vector: FloatArray, evaluations: int) -> FloatArray:
        """Return the vector with the least errors (soft L1) near a start."""
        from scipy.optimize import least_squares

        count = len(vector)
        solution = least_squares(
            lambda x: self.residuals(x).ravel(),
            np.clip(vector, self.scaling.least, self.scaling.most),
            jac=lambda x: self.slopes(x).reshape(-1, count),
            bounds=(self.scaling.least, self.scaling.most),
            loss="soft_l1",
            max_nfev=evaluations,
            xtol=1e-4,
            ftol=1e-5,
        )
        return np.asarray(solution.x)

    def equations(self, vector: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the normal equations of each block of the flights at a vector: (blocks, keys,
        keys) and (blocks, keys).
        """
        errors = self.residuals(vector)
        slopes = self.slopes(vector)
        # Gauss and Newton's weights of soft L1
        weights = 1.0 / np.sqrt(1.0 + errors**2)
        block = np.arange(len(errors)) * BLOCKS // len(errors)
        squares = []
        products = []
        for number in np.unique(block):
            rows = block == number
            weighted = weights[rows, :, None] * slopes[rows]
            squares.append(np.einsum("wni,wnj->ij", weighted, slopes[rows]))
            products.append(np.einsum("wni,wn->i", weighted, errors[rows]))
        return np.array(squares), np.array(products)


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
    :raises MissingExtra: SciPy is not installed.
    """
    require("scipy.optimize", "fit", "fitting a vehicle")
    report = show or (lambda done, total, text: None)
    report(0, 6, "regressions")
    guess = first_guess(logs, start)
    keys, held = keys_for(logs, guess)
    has_motion = all(log.has_motion for log in logs)
    short = SHORT if has_motion else SHORT_RATES
    long = LONG if has_motion else LONG_RATES
    report(1, 6, "short horizons")
    model = Model(logs, guess, keys, short)
    vector = model.solve(_scaled_moments(model), 12)
    report(2, 6, "all horizons")
    model = Model(logs, guess, keys, long)
    for _ in range(2):
        model.weigh(vector)
        vector = model.solve(vector, 8)
    report(3, 6, "intervals")
    kept, reasons = _told(model, vector)
    held |= reasons
    known = {key: value(guess._replace(vehicle=start), key) for key in reasons}
    model = _again(model, with_values(model.scaling.guess(vector), known), kept)
    report(4, 6, "what the logs tell")
    vector = model.solve(np.zeros(len(kept)), 8)
    found = model.scaling.values(vector).tolist()
    widths = model.scaling.widths(vector, jackknife(*model.equations(vector))).tolist()
    estimates = []
    for key, number, width in zip(kept, found, widths, strict=True):
        least = LEAST_DELAY_WIDTH if key == DELAY else LEAST_WIDTH * abs(number)
        estimates.append(Estimate(key, number, max(width, least)))
    for key, reason in held.items():
        estimates.append(Estimate(key, value(guess._replace(vehicle=start), key), np.nan, reason))
    # The delay of a vehicle is a whole number of control steps, and its lag makes up for the rest.
    report(5, 6, "with whole steps of delay")
    best = model.scaling.guess(vector)
    steps = round(best.delay / start.control_step)
    kept.remove(DELAY)
    model = _again(model, best._replace(delay=steps * start.control_step), kept)
    fitted = model.scaling.guess(model.solve(np.zeros(len(kept)), 5))
    report(6, 6, "done")
    return Fit(_as_file(start, fitted, logs, steps, name), fitted.curve, estimates)


def _smoothed(log: Log) -> FloatArray:
    """Return the motion of a log with position, attitude and velocity smoothed, (n, 13)."""
    from scipy.signal import savgol_filter

    motion = log.motion.copy()
    slow = slice(0, VELOCITY.stop)
    size = 2 * round(0.5 * SMOOTHED / log.step) + 1
    motion[:, slow] = savgol_filter(motion[:, slow], size, 2, axis=0)
    motion[:, QUATERNION] /= np.linalg.norm(motion[:, QUATERNION], axis=1, keepdims=True)
    return motion


def _again(model: Model, start: Guess, keys: Sequence[Key]) -> Model:
    """Return a model of the same errors from another start."""
    again = copy(model)
    again.scaling = Scaling(start, keys)
    return again


def first_guess(logs: Sequence[Log], start: Vehicle) -> Guess:
    """Return what regressions of the specific force say about curve, lag and delay of the motors.

    :raises ConfigError: motors turn the vehicle otherwise than its file says.
    """
    lags = [FASTEST] if logs[0].kind == "rotor_speed" else 1.0 / LAGS
    found = []
    for gain in lags:
        for delay in DELAYS:
            curve, rest = regress(logs, start, gain, delay)
            found.append((rest, gain, delay, curve))
    _, gain, delay, curve = min(found, key=lambda one: one[0])
    commands = np.concatenate([log.mean_commands()[log.flying] for log in logs])
    strongest = float(curve.thrust(np.array(commands.max())))
    changes: StrDict = {
        "motor_gain": gain,
        "motor_integration": "exact",
        "control_step": logs[0].step,
        "physics_step": MAX_PHYSICS_STEP,
        "delay": 0,
        # Nothing is clipped.
        "rotor_thrust_limits": (0.0, 4.0 * max(strongest, start.hover_thrust)),
    }
    if curve.kind == "rotor_speed":
        changes["thrust_coefficient"] = float(curve.coefficients[0])
    guess = Guess(start.model_copy(update=changes), curve, delay)
    for log in logs:
        refuse_other_order(log, start, log_thrusts([log], start, curve, delay))
    return guess


def _scaled_moments(model: Model) -> FloatArray:
    """Return the vector with the moments of inertia, and then the yaw moment, that fit best among
    multiples of the start's.
    """
    keys = model.scaling.keys
    vector = np.zeros(len(keys))
    for field in ("inertia", "moment_thrust_ratio"):
        places = [k for k, key in enumerate(keys) if key[0] == field]
        costs = []
        for factor in FACTORS:
            vector[places] = np.log(factor)
            costs.append(np.sqrt(1.0 + model.residuals(vector) ** 2).sum())
        vector[places] = np.log(FACTORS[np.argmin(costs)])
    return vector


def jackknife(squares: FloatArray, products: FloatArray) -> FloatArray:
    """Return half of the 95 % intervals by leaving out one block at a time, (keys,).

    :param squares: of the normal equations of each block, (blocks, keys, keys).
    :param products: their right-hand sides, (blocks, keys).
    """
    from scipy.stats import t

    count = len(squares)
    shifts = []
    for one, other in zip(squares, products, strict=True):
        left = squares.sum(axis=0) - one
        shifts.append(-np.linalg.lstsq(left, products.sum(axis=0) - other, rcond=None)[0])
    spread = np.sqrt((count - 1) * np.var(shifts, axis=0))
    return np.asarray(t.ppf(0.975, count - 1) * spread)


def _told(model: Model, vector: FloatArray) -> tuple[list[Key], dict[Key, str]]:
    """Return the parameters that the logs tell, and why they do not tell the others.

    The least certain one is held first, which makes the others more certain.
    """
    squares, products = model.equations(vector)
    scaling = model.scaling
    values = scaling.values(vector)
    # A parameter near zero must still be certain.
    allowed = np.maximum(LARGEST_WIDTH * np.abs(values), 1e-30)
    allowed[[key[0] in ("curve", "delay") for key in scaling.keys]] = np.inf
    reasons = {}
    # A value that runs away says nothing.
    limits = np.minimum(scaling.high, scaling.begin * np.exp(0.99 * LARGEST_CHANGE))
    is_free = scaling.sizes == 0.0
    far = is_free & ((values > 0.98 * limits) | (vector < -0.99 * LARGEST_CHANGE))
    for k in np.flatnonzero(far):
        reasons[scaling.keys[int(k)]] = f"it would run to {values[k]:.2g}"
    kept = np.flatnonzero(~far)
    while True:
        half = np.zeros(len(vector))
        half[kept] = jackknife(squares[:, kept][:, :, kept], products[:, kept])
        widths = scaling.widths(vector, half)
        worst = int(np.argmax(widths / allowed))
        if widths[worst] <= allowed[worst]:
            return [scaling.keys[int(k)] for k in kept], reasons
        reasons[scaling.keys[worst]] = f"its interval would be ± {widths[worst]:.2g}"
        kept = kept[kept != worst]


def _as_file(start: Vehicle, fitted: Guess, logs: Sequence[Log], delay: int, name: str) -> Vehicle:
    """Return the vehicle with what was fitted, and with the limits of its commands.

    :raises ConfigError: no vehicle can be like this.
    """
    changes: StrDict = {"name": name, "motor_integration": "exact", "delay": delay}
    for field in FIELDS:
        changes[field] = getattr(fitted.vehicle, field)
    changes["motor_gain_down"] = changes["motor_gain_up"]
    curve = fitted.curve
    if curve.kind == "thrust":
        low, high = curve.thrust(np.array(start.thrust_range))
    elif curve.kind == "share":
        low, high = curve.thrust(np.array([0.0, 1.0]))
    else:
        changes["thrust_coefficient"] = float(curve.coefficients[0])
        changes |= {"motor_gain_up": start.motor_gain_up, "motor_gain_down": start.motor_gain_down}
        commands = np.concatenate([log.mean_commands()[log.flying] for log in logs])
        low, high = curve.thrust(np.array([commands.min(), commands.max()]))
    if not high > 1.05 * start.hover_thrust:
        raise ConfigError(
            f"the motors would push with {high:.3g} N at full command, and {start.name} needs "
            f"{start.hover_thrust:.3g} N of each to hover; is its mass right?"
        )
    changes["rotor_thrust_limits"] = max(low, 0.01 * start.hover_thrust), high
    return start.model_copy(update=changes)
