"""How far predictions over many steps are off, and the parameters with which they are off least.

Recorded commands fly from recorded states, see :mod:`.open_loop`.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import approx_fprime, least_squares
from scipy.signal import detrend

from sb3_quad.base.types import FloatArray, IntArray
from sb3_quad.identification.flight_log import Log
from sb3_quad.identification.open_loop import Windows, gaps, log_thrusts
from sb3_quad.identification.parameters import Guess, parameters_of
from sb3_quad.identification.smoothing import smoothed

# Windows overlap; nearer ones, s, hardly tell more.
APART = 0.16
MOST_WINDOWS = 750
# Of position, velocity, attitude, body rates and specific force, in the units of the motion: errors
# of this size count as one in the first fit.
ERRORS = (0.1, 0.4, 0.15, 0.4, 2.0)
RATES = 3
DIFFERENCE = 2e-3
# How far above its lower limit an element begins
INSIDE = 0.1


class Optimum(NamedTuple):
    """The vector with the least errors, and the equations linearised there."""

    vector: FloatArray
    #: of the errors, (windows, n, free elements)
    slopes: FloatArray
    #: (windows, n), weighted so that their normal equations are those of soft L1
    errors: FloatArray


class Model:
    """The errors of predictions as a function of a vector, whose elements are about 1.

    :param logs: the logs.
    :param start: what the vector changes.
    :param horizons: where predictions are compared, s.
    """

    def __init__(self, logs: Sequence[Log], start: Guess, horizons: FloatArray) -> None:
        self.logs = logs
        self.start = start
        self.table = parameters_of(logs, start)
        self.scale: FloatArray = self.table["size"].to_numpy()
        self.has_motion = logs[0].has_motion
        step = logs[0].step
        ends = sorted({max(round(horizon / step), 1) for horizon in horizons})
        # Windows of body rates alone share no sample.
        stride = ends[-1]
        if self.has_motion:
            flying = sum(log.flying.sum() for log in logs)
            stride = max(round(APART / step), flying // MOST_WINDOWS)
        self.windows = Windows(logs, start.vehicle, ends, stride)
        if self.has_motion:
            # The noise of where a window begins would grow with some parameters, and bias them.
            motion = np.concatenate([smoothed(log) for log in logs])
            self.windows.start = motion[self.windows.rows]
        self.force = np.concatenate([log.force for log in logs])
        self.usual = ERRORS if self.has_motion else ERRORS[RATES:]
        self.sizes = [np.array(size) for size in self.usual]

    def vector_of(self, guess: Guess) -> FloatArray:
        """Return the vector of a guess."""
        return guess.vector() / self.scale

    def guess(self, vector: FloatArray) -> Guess:
        """Return what the start becomes with a vector."""
        return self.start.moved(vector * self.scale)

    def free(self) -> IntArray:
        """Return the elements that the logs may tell."""
        return np.flatnonzero(self.table["reason"] == "")

    def parts(self, vector: FloatArray) -> list[FloatArray]:
        """Return errors of position, velocity, attitude, body rates and specific force, (windows,
        horizons, columns) each.
        """
        guess = self.guess(vector)
        windows = self.windows
        thrusts = log_thrusts(self.logs, guess.vehicle, guess.curve, guess.delay)
        flown = windows.fly(guess.vehicle, thrusts)
        errors = []
        for end, (motion, force) in zip(windows.ends, flown, strict=True):
            rows = windows.rows + end
            errors.append(gaps(motion, windows.record[rows]))
            errors[-1].append(force - self.force[rows])
        *others, rates, forces = (np.stack(part, axis=1) for part in zip(*errors, strict=True))
        if not self.has_motion:
            # What depends on attitude and airspeed is unknown, and the moments of the air change
            # slowly.
            return [detrend(rates, 1, "linear"), forces[..., 2:]]
        # The first body rate of a window is as noisy as the others: only changes count.
        rates = detrend(rates, 1, "constant")
        # An accelerometer is hardly mounted exactly.
        forces[..., :2] -= forces[..., :2].mean(axis=(0, 1))
        return [*others, rates, forces]

    def residuals(self, vector: FloatArray) -> FloatArray:
        """Return the errors that logs tell by their sizes, (windows, n)."""
        scaled = []
        for part, size in zip(self.parts(vector), self.sizes, strict=True):
            flat = (part / size).reshape(len(part), -1)
            scaled.append(flat)
        # Predictions that diverge must not become infinite.
        return np.asarray(np.clip(np.hstack(scaled), -1e3, 1e3))

    def weigh(self, vector: FloatArray) -> None:
        """Count errors by the size that they have now, each column after each horizon."""
        for number, part in enumerate(self.parts(vector)):
            median = np.median(np.abs(part), axis=0)
            least = 1e-3 * self.usual[number]
            self.sizes[number] = np.maximum(1.4826 * median, least)

    def solve(self, vector: FloatArray, evaluations: int) -> Optimum:
        """Find the free elements of a vector with the least errors (soft L1) near a start."""
        free = self.free()
        fitted = vector.copy()

        def residuals(values: FloatArray) -> FloatArray:
            fitted[free] = values
            return self.residuals(fitted).ravel()

        limits = self.table.loc[free, ["least", "most"]].to_numpy().T
        # A search that begins at a limit hardly leaves it.
        begin = np.clip(vector[free], limits[0] + INSIDE, limits[1])
        solution = least_squares(
            residuals,
            begin,
            lambda values: approx_fprime(values, residuals, DIFFERENCE),
            limits,
            loss="soft_l1",
            max_nfev=evaluations,
            xtol=1e-4,
            ftol=3e-5,
        )
        fitted[free] = solution.x
        # SciPy has weighted the slopes, but not the errors.
        errors = solution.fun * (1.0 + solution.fun**2) ** 0.25
        windows = len(self.windows.rows)
        jacobian = solution.jac.reshape(windows, -1, len(free))
        return Optimum(fitted, jacobian, errors.reshape(windows, -1))
