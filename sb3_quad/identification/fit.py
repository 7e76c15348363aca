"""A vehicle's parameters from logs of its flights, by the error of predictions over many steps.

Recorded commands fly from recorded states, and least squares bring the predictions to what was
recorded: first over short horizons, then over all. What is known is held: mass, arms, directions of
the rotors.
"""

from collections.abc import Callable, Sequence
from itertools import product
from operator import itemgetter
from typing import NamedTuple

import numpy as np
import pandas as pd

from sb3_quad.base.errors import ConfigError, raised_as
from sb3_quad.base.types import FloatArray, StrDict
from sb3_quad.envs.vehicles.vehicle import MAX_PHYSICS_STEP, Vehicle
from sb3_quad.identification.curve import Curve, refuse_other_order, regress
from sb3_quad.identification.flight_log import Log
from sb3_quad.identification.intervals import jackknife, not_told
from sb3_quad.identification.open_loop import WARM_UP, log_thrusts
from sb3_quad.identification.parameters import FASTEST, Guess
from sb3_quad.identification.prediction_error import Model, Optimum

Show = Callable[[int, int, str], object]
# Short and long horizons of logs with velocity, and of body rates alone, s
HORIZONS = np.array([0.02, 0.05, 0.1]), np.linspace(0.05, 0.5, 10)
HORIZONS_OF_RATES = np.arange(0.02, 0.11, 0.02), np.arange(0.02, 0.21, 0.02)
# Lags and delays that the regression tries, s
LAGS = np.array([0.01, 0.015, 0.02, 0.03, 0.045, 0.06, 0.08, 0.11, 0.15])
DELAYS = np.arange(0.0, 0.035, 0.005)
MOST_THRUST = 30.0  # of a motor at full command, by what it needs to hover
# Radii of gyration by the rotors' distance from the centre, beyond which a unit is wrong
LEAST_GYRATION = 0.2
MOST_GYRATION = 2.0
# No interval is narrower than this part of its value or size, or this many seconds of a delay:
# simulated logs with noise show such errors beyond the jackknife's intervals.
LEAST_WIDTH = 0.03
LEAST_DELAY_WIDTH = 0.0015


class Fit(NamedTuple):
    """A vehicle from logs."""

    vehicle: Vehicle
    curve: Curve  #: thrust of a motor over its command
    #: a row for each parameter: its field, name and unit, start, value, width, which is half of the
    #: 95 % interval, and the reason why the logs do not tell it, if so
    estimates: pd.DataFrame


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
    # How the rotors turn where a log begins is unknown.
    logs = [log.part(slice(round(WARM_UP / log.step), None)) for log in logs]
    report = show or (lambda done, total, text: None)
    report(0, 3, "regressions")
    guess = first_guess(logs, start)
    report(1, 3, "predictions")
    short, long = HORIZONS if logs[0].has_motion else HORIZONS_OF_RATES
    model = Model(logs, guess, short)
    optimum = model.solve(model.vector_of(guess), 10)
    # Sizes are those of the fit so far, since damping grows with the inertia.
    guess = model.guess(optimum.vector)
    model = Model(logs, guess, long)
    vector = model.vector_of(guess)
    model.weigh(vector)
    optimum = model.solve(vector, 12)
    report(2, 3, "what the logs tell")
    before = guess._replace(vehicle=start)
    known = model.vector_of(before)
    while held := not_told(model, optimum):
        vector = optimum.vector
        for place, reason in held.items():
            vector[place] = known[place]
            model.table.loc[place, "reason"] = reason
        model.weigh(vector)
        optimum = model.solve(vector, 6)
    free = model.free()
    known[free] = optimum.vector[free]
    table = _with_intervals(model, optimum, known * model.scale)
    table["start"] = before.vector()
    report(3, 3, "done")
    with raised_as(ConfigError, f"{logs[0].path}: the fit is no vehicle that can fly"):
        fitted = before.moved(table["value"].to_numpy())
    ratios = fitted.vehicle.gyration_ratios
    if ratios.min() < LEAST_GYRATION or ratios.max() > MOST_GYRATION:
        raise ConfigError(
            f"{logs[0].path}: the moments of inertia would have radii of {ratios.min():.2g} to "
            f"{ratios.max():.2g} of the rotors' distance; are the gyro's unit, the mass and the "
            "rotors' positions right?"
        )
    steps = round(fitted.delay / start.control_step)
    has_lag = table.set_index("field")["reason"]["motor_gain_up"] == ""
    return Fit(_with_limits(fitted, name, steps, has_lag), fitted.curve, table)


def _with_intervals(model: Model, optimum: Optimum, values: FloatArray) -> pd.DataFrame:
    """Return the table of a model with values and the widths of those that are fitted."""
    free = model.free()
    widths = jackknife(optimum.slopes, optimum.errors) * model.scale[free]
    table = model.table
    least = LEAST_WIDTH * np.maximum(np.abs(values), table["size"])
    least = least.where(table["field"] != "delay", LEAST_DELAY_WIDTH)
    table["value"] = values
    table["width"] = pd.Series(widths, free)
    table["width"] = table["width"].clip(least)
    return table


def first_guess(logs: Sequence[Log], start: Vehicle) -> Guess:
    """Return what regressions of the specific force say about curve, lag and delay of the motors.

    :raises ConfigError: motors turn the vehicle otherwise than its file says.
    """
    kind = logs[0].kind
    gains = 1.0 / LAGS
    if kind == "rotor_speed":
        gains = np.array([FASTEST])
    tried = []
    for gain, delay in product(gains.tolist(), DELAYS.tolist()):
        curve, rest = regress(logs, start, gain, delay)
        tried.append((rest, gain, delay, curve))
    _, gain, delay, curve = min(tried, key=itemgetter(0))
    refuse_other_order(logs, start, log_thrusts(logs, start, curve, delay))
    strongest = max(curve.thrust(log.mean_commands()).max() for log in logs)
    step = logs[0].step
    changes: StrDict = {
        "motor_gain": gain,
        "motor_integration": "exact",
        "control_step": step,
        "physics_step": step / np.ceil(step / MAX_PHYSICS_STEP),
        "delay": 0,
        # Nothing is clipped, and the search may pass through anything.
        "allow_impossible_inertia": True,
        "rotor_thrust_limits": (0.0, 4.0 * max(strongest, start.hover_thrust)),
    }
    if kind == "rotor_speed":
        changes["thrust_coefficient"] = float(curve.coefficients[0])
    # Commands that cannot be right are refused at once.
    _with_limits(Guess(start, curve, 0.0), start.name, 0, False)
    return Guess(start.model_copy(update=changes), curve, delay)


def _with_limits(fitted: Guess, name: str, delay: int, has_lag: bool) -> Vehicle:
    """Return a fitted vehicle with the limits of its commands.

    :param delay: in whole control steps.
    :param has_lag: whether its lag may make up for the rest of the delay.
    :raises ConfigError: it does not hover.
    """
    vehicle = fitted.vehicle
    changes: StrDict = {"name": name, "motor_integration": "exact", "delay": delay}
    if has_lag:
        lag = 1.0 / vehicle.motor_gain_up + fitted.delay - delay * vehicle.control_step
        changes["motor_gain"] = 1.0 / max(lag, 1.0 / FASTEST)
    low, most = vehicle.thrust_range
    _, fastest = vehicle.rotor_speed_range
    full = {"thrust": most, "share": 1.0, "rotor_speed": fastest}
    high = fitted.curve.thrust(np.array(full[fitted.curve.kind]))
    if not 1.05 < high / vehicle.hover_thrust < MOST_THRUST:
        raise ConfigError(
            f"the motors would push with {high:.3g} N at full command, and {vehicle.name} needs "
            f"{vehicle.hover_thrust:.3g} N of each to hover; are its mass, and the commands' unit, "
            "right?"
        )
    if fitted.curve.kind == "rotor_speed":
        changes["thrust_coefficient"] = float(fitted.curve.coefficients[0])
    # No flight tells what a motor that gets hardly anything does.
    changes["rotor_thrust_limits"] = low, float(high)
    return vehicle.model_copy(update=changes)
