"""A vehicle's parameters from logs of its flights, by the error of predictions over many steps.

Recorded commands fly from recorded states, and least squares bring the predictions to what was
recorded: first over short horizons, then over all. What is known is held: mass, arms, directions of
the rotors. Intervals follow from leaving out one block of the flights at a time (jackknife), with
the equations linearised at the optimum.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import savgol_filter
from scipy.stats import t as student

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.types import FloatArray, IntArray, StrDict
from sb3_quad.envs.simulation.state import QUATERNION, VELOCITY
from sb3_quad.envs.vehicles.vehicle import MAX_PHYSICS_STEP, Vehicle
from sb3_quad.identification.curve import Curve, refuse_other_order, regress
from sb3_quad.identification.flight_log import MOTION_SIZE, Log
from sb3_quad.identification.open_loop import Windows, gaps, log_thrusts
from sb3_quad.identification.parameters import FASTEST, TERMS, Guess, keys_for

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

    field: str  #: of the vehicle, or ``curve`` or ``delay``
    element: int
    value: float  #: in its unit
    width: float  #: half of the 95 % interval; NaN if the logs do not tell the parameter
    reason: str  #: why they do not


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
    :param horizons: where predictions are compared, s.
    """

    def __init__(self, logs: Sequence[Log], start: Guess, horizons: Sequence[float]) -> None:
        self.logs = logs
        self.start = start
        self.scale = start.sizes()
        numbers = start.numbers()
        counts = [len(one) for one in numbers.values()]
        self.least = np.repeat([TERMS[field].least for field in numbers], counts)
        self.most = np.repeat([TERMS[field].most for field in numbers], counts)
        self.has_motion = all(log.has_motion for log in logs)
        step = logs[0].step
        ends = sorted({max(round(horizon / step), 1) for horizon in horizons})
        rows = sum(log.flying.sum() for log in logs)
        # Windows of body rates alone share no sample.
        stride = max(1, round(rows / MOST_WINDOWS)) if self.has_motion else ends[-1]
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
        found = []
        for end, flown in zip(windows.ends, windows.fly(guess.vehicle, thrusts), strict=True):
            rows = windows.rows + end
            force = flown[:, MOTION_SIZE:] - self.force[rows, None]
            found.append([*gaps(flown, windows.record[rows]), force])
        parts = [np.stack(one, axis=1) for one in zip(*found, strict=True)]
        # The first body rate of a window is as noisy as the others: only changes count. Where the
        # airspeed is unknown, so are the moments of the air, which change slowly.
        times = np.array(windows.ends, float)
        slow = np.vander(times / times[-1], 1 if self.has_motion else 2)
        parts[3] -= np.einsum("hk,wkc->whc", slow @ np.linalg.pinv(slow), parts[3])
        return parts

    def residuals(self, vector: FloatArray) -> FloatArray:
        """Return the errors that logs tell by their sizes, (windows, n)."""
        pairs = zip(self.parts(vector), self.sizes, strict=True)
        scaled = [(part / size).reshape(len(part), -1) for part, size in pairs]
        known = scaled if self.has_motion else scaled[3:]
        # Predictions that diverge must not become infinite.
        return np.asarray(np.clip(np.nan_to_num(np.hstack(known), nan=1e3), -1e3, 1e3))

    def weigh(self, vector: FloatArray) -> None:
        """Count errors by the size that they have now, each kind after each horizon."""
        for number, part in enumerate(self.parts(vector)):
            spread = 1.4826 * np.median(np.abs(part), axis=(0, 2))
            self.sizes[number] = np.maximum(spread, 1e-3 * ERRORS[number])[:, None]

    def solve(
        self, vector: FloatArray, free: IntArray, evaluations: int
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Find the vector with the least errors (soft L1) near a start.

        :param free: the elements of the vector that may change.
        :return: the vector, the slopes of the errors, (windows, n, free), and the errors, (windows,
            n), weighted so that their normal equations are those of soft L1.
        """
        found = vector.copy()

        def residuals(values: FloatArray) -> FloatArray:
            found[free] = values
            return self.residuals(found).ravel()

        def slopes(values: FloatArray) -> FloatArray:
            here = residuals(values)
            steps = DIFFERENCE * np.eye(len(free))
            return np.stack([(residuals(values + h) - here) / DIFFERENCE for h in steps], axis=1)

        limits = self.least[free], self.most[free]
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
        found[free] = solution.x
        # SciPy has weighted the slopes, but not the errors.
        weighted = solution.fun * (1.0 + solution.fun**2) ** 0.25
        windows = len(self.windows.rows)
        slopes_by_window = solution.jac.reshape(windows, -1, len(free))
        return found, slopes_by_window, weighted.reshape(windows, -1)

    def best_multiple(self, vector: FloatArray, places: IntArray) -> FloatArray:
        """Return the vector with that multiple of some elements that fits best."""
        trials = []
        for factor in FACTORS:
            trial = vector.copy()
            trial[places] *= factor
            trials.append(trial)
        costs = [np.sqrt(1.0 + self.residuals(trial) ** 2).sum() for trial in trials]
        return trials[int(np.argmin(costs))]


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
    reasons = keys_for(logs, guess)
    keys = [*reasons]
    fields = np.array([field for field, _ in keys])
    free = np.flatnonzero([not reason for reason in reasons.values()])
    has_motion = all(log.has_motion for log in logs)
    report(1, 5, "short horizons")
    model = Model(logs, guess, SHORT if has_motion else SHORT_RATES)
    vector = guess.vector() / model.scale
    for field in ("inertia", "moment_thrust_ratio"):
        vector = model.best_multiple(vector, np.flatnonzero(fields == field))
    vector, *_ = model.solve(vector, free, 12)
    report(2, 5, "all horizons")
    # Sizes are those of what has been found, since damping grows with the inertia.
    guess = guess.moved(vector * model.scale)
    vector = guess.vector() / guess.sizes()
    model = Model(logs, guess, LONG if has_motion else LONG_RATES)
    for _ in range(2):
        model.weigh(vector)
        vector, slopes, errors = model.solve(vector, free, 8)
    report(3, 5, "what the logs tell")
    reasons_held = _not_told(model, vector, free, slopes, errors)
    known = guess._replace(vehicle=start).vector()
    for place, reason in reasons_held.items():
        vector[place] = known[place] / model.scale[place]
        reasons[keys[place]] = reason
    free = np.setdiff1d(free, [*reasons_held])
    vector, slopes, errors = model.solve(vector, free, 8)
    values = known.copy()
    values[free] = (vector * model.scale)[free]
    widths = np.full(len(keys), np.nan)
    widths[free] = jackknife(slopes, errors) * model.scale[free]
    widths = np.maximum(widths, np.where(fields == "delay", LEAST_DELAY_WIDTH, LEAST_WIDTH * values))
    estimates = []
    for (key, reason), value, width in zip(reasons.items(), values, widths, strict=True):
        estimates.append(Estimate(*key, float(value), float(width), reason))
    # The delay of a vehicle is a whole number of control steps, and its lag makes up for the rest.
    report(4, 5, "with whole steps of delay")
    is_delay = fields == "delay"
    steps = round(values[is_delay].item() / start.control_step)
    vector[is_delay] = steps * start.control_step / model.scale[is_delay]
    vector, *_ = model.solve(vector, free[~is_delay[free]], 5)
    fitted = guess.moved(vector * model.scale)
    report(5, 5, "done")
    return Fit(_as_file(start, fitted, logs, steps, name), fitted.curve, estimates)


def _smoothed(log: Log) -> FloatArray:
    """Return the motion of a log with position, attitude and velocity smoothed, (n, 13)."""
    motion = log.motion.copy()
    slow = slice(0, VELOCITY.stop)
    size = 2 * round(0.5 * SMOOTHED / log.step) + 1
    motion[:, slow] = savgol_filter(motion[:, slow], size, 2, axis=0)
    motion[:, QUATERNION] /= np.linalg.norm(motion[:, QUATERNION], axis=1, keepdims=True)
    return motion


def first_guess(logs: Sequence[Log], start: Vehicle) -> Guess:
    """Return what regressions of the specific force say about curve, lag and delay of the motors.

    :raises ConfigError: motors turn the vehicle otherwise than its file says.
    """
    gains = [FASTEST] if logs[0].kind == "rotor_speed" else 1.0 / LAGS
    pairs = list(product(gains, DELAYS))
    found = [regress(logs, start, *pair) for pair in pairs]
    best = int(np.argmin([rest for _, rest in found]))
    gain, delay = pairs[best]
    curve, _ = found[best]
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


def jackknife(slopes: FloatArray, errors: FloatArray) -> FloatArray:
    """Return half of the 95 % intervals by leaving out one block of windows at a time, (keys,).

    :param slopes: of the errors, (windows, n, keys).
    :param errors: (windows, n).
    """
    count = min(BLOCKS, len(errors))
    rows = np.array_split(np.arange(len(errors)), count)
    squares = [np.einsum("wni,wnj->ij", slopes[one], slopes[one]) for one in rows]
    products = [np.einsum("wni,wn->i", slopes[one], errors[one]) for one in rows]
    shifts = []
    for square, right in zip(squares, products, strict=True):
        left = sum(squares) - square
        shifts.append(np.linalg.lstsq(left, right - sum(products), rcond=None)[0])
    spread = np.sqrt((count - 1) * np.var(shifts, axis=0))
    return np.asarray(student.ppf(0.975, count - 1) * spread)


def _not_told(
    model: Model, vector: FloatArray, free: IntArray, slopes: FloatArray, errors: FloatArray
) -> dict[int, str]:
    """Return which elements of the vector the logs do not tell, and why.

    The least certain one is held first, which makes the others more certain.
    """
    # A value that runs away says nothing.
    far = (vector < 1.02 * model.least) | (vector > 0.98 * model.most)
    held = {}
    for place in free[(far & (model.least > 0.0))[free]].tolist():
        held[place] = f"it would run to {vector[place] * model.scale[place]:.2g}"
    while True:
        kept = np.flatnonzero(~np.isin(free, [*held]))
        places = free[kept]
        widths = jackknife(slopes[:, :, kept], errors)
        shares = widths / np.maximum(np.abs(vector[places]), 1e-9)
        # Thrust and delay are always fitted.
        shares[: len(model.start.curve.coefficients) + 1] = 0.0
        worst = int(np.argmax(shares))
        if shares[worst] <= LARGEST_WIDTH:
            return held
        place = int(places[worst])
        held[place] = f"its interval would be ± {widths[worst] * model.scale[place]:.2g}"


def _as_file(start: Vehicle, fitted: Guess, logs: Sequence[Log], delay: int, name: str) -> Vehicle:
    """Return the vehicle with what was fitted, and with the limits of its commands.

    :raises ConfigError: no vehicle can be like this.
    """
    changes: StrDict = {"name": name, "motor_integration": "exact", "delay": delay}
    for field in [*TERMS][2:]:
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
