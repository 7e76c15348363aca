"""The results of a fit: a table, a vehicle file with comments, and a picture of its predictions."""

from collections.abc import Sequence

import numpy as np
import yaml
from matplotlib.figure import Figure

from sb3_quad.base.files import write_text
from sb3_quad.base.types import StrPath
from sb3_quad.envs.simulation.state import BODY_RATES, POSITION, VELOCITY
from sb3_quad.envs.vehicles.vehicle import Vehicle
from sb3_quad.evaluation.plots import HEIGHT, WIDTH, legend, styled
from sb3_quad.evaluation.tables import COLOURS, Table
from sb3_quad.identification.curve import POWERS, Curve
from sb3_quad.identification.fit import Estimate, Fit
from sb3_quad.identification.flight_log import Log, flown
from sb3_quad.identification.open_loop import Windows, log_thrusts
from sb3_quad.identification.parameters import FIELDS, Guess, unit, value

SYMBOLS = {"thrust": "T", "rotor_speed": "ω", "share": "u"}
# How far each prediction of the picture goes, and how long the picture is, s
AHEAD = 0.25
SHOWN = 6.0
HELD = "held: logs tell thrust and moments by mass alone"


def label(estimate: Estimate, kind: str) -> str:
    """Return what a parameter is called."""
    field, element = estimate.key
    if field == "curve":
        return f"thrust, {SYMBOLS[kind]}^{POWERS[kind][element]}"
    field = field.removesuffix("_up")
    if field in FIELDS and len(FIELDS[field].elements) > 1:
        return f"{field} {'xyz'[element]}"
    return field


def estimate_table(fit: Fit, start: Vehicle) -> Table:
    """Return each parameter with its start and its interval, or why logs do not tell it."""
    rows = [["mass", f"{start.mass:.4g}", f"{start.mass:.4g}", "kg", HELD]]
    before = Guess(start, fit.curve, start.delay * start.control_step)
    for estimate in fit.estimates:
        field, _ = estimate.key
        known = "" if field == "curve" else f"{value(before, estimate.key):.4g}"
        text = f"held: {estimate.reason}" if estimate.reason else f"± {estimate.width:.2g}"
        name = label(estimate, fit.curve.kind)
        rows.append(
            [name, known, f"{estimate.value:.4g}", unit(estimate.key, fit.curve.kind), text]
        )
    heads = ("parameter", "start", "fitted", "unit", "95 % interval")
    return Table(heads, rows, fit.vehicle.name, align="left")


def write_vehicle(path: StrPath, fit: Fit, start: Vehicle, logs: Sequence[Log]) -> None:
    """Write the vehicle file of a fit; comments hold the intervals and what was held.

    :raises ConfigError: a folder that cannot be written, or a full disk.
    """
    names = ", ".join(dict.fromkeys(log.path.name for log in logs))
    lines = [
        f"# Fitted by sb3-quad fit to {flown(logs):.0f} s of {names}. Start: {start.name}.",
        "# ± is half of a 95 % interval, from leaving out one block of the flights at a time.",
        f"# {curve_text(fit)}",
    ]
    content = fit.vehicle.model_dump(mode="json", exclude_defaults=True)
    content["motor_gain"] = content.pop("motor_gain_up")
    del content["motor_gain_down"]
    comments = {"mass": f"kg, {HELD}"}
    for field in content:
        of_field = [one for one in fit.estimates if one.key[0].removesuffix("_up") == field]
        if of_field:
            texts = [one.reason or f"± {one.width:.2g}" for one in of_field]
            measure = unit(of_field[0].key, fit.curve.kind)
            comments[field] = f"{measure}; {', '.join(dict.fromkeys(texts))}"
    if "inertia" in comments:
        comments["inertia"] += "; Izz by its ratio to Ixx + Iyy"
    delays = [one for one in fit.estimates if one.key[0] == "delay"]
    comments["delay"] = f"control steps; fitted {delays[0].value:.4f} ± {delays[0].width:.2g} s"
    content.setdefault("delay", fit.vehicle.delay)
    for field, entry in content.items():
        # Lists of numbers take a line.
        style = None if isinstance(entry, list) else False
        text = yaml.safe_dump(
            {field: _rounded(entry)}, default_flow_style=style, width=1000
        ).strip()
        comment = comments.get(field)
        lines.append(f"{text:<44} # {comment}" if comment else text)
    write_text(path, "\n".join(lines) + "\n")


def _rounded(entry: object) -> object:
    """Return numbers with six digits."""
    if isinstance(entry, list):
        return [_rounded(one) for one in entry]
    return float(f"{entry:.6g}") if isinstance(entry, float) else entry


def curve_text(fit: Fit) -> str:
    """Return the thrust of a motor over its command as a formula."""
    kind = fit.curve.kind
    symbol = SYMBOLS[kind]
    terms = []
    for power, number in zip(POWERS[kind], fit.curve.coefficients, strict=True):
        terms.append(f"{number:.4g}" + (f" {symbol}^{power}" if power else ""))
    meaning = {"thrust": "of its command in N", "rotor_speed": "of its speed, rad/s"}
    text = meaning.get(kind, "of its command u, 0 to 1")
    return f"Thrust of a motor, N, {text}: {' + '.join(terms)}".replace("+ -", "- ")


@styled
def prediction_plot(logs: Sequence[Log], vehicle: Vehicle, curve: Curve) -> Figure:
    """Draw recorded body rates, velocities and positions of the first log, and above them what the
    vehicle does on the recorded commands, from the recorded state every ``AHEAD`` seconds.

    :param logs: with rows at the vehicle's control step.
    """
    step = vehicle.control_step
    log = logs[0]
    first = int(np.argmax(log.flying))
    shown = log.part(slice(first, first + round((SHOWN + 1.0) / step)))
    count = round(AHEAD / step)
    windows = Windows([shown], vehicle, range(1, count + 1), count)
    pieces = [windows.start]
    thrusts = log_thrusts([log], vehicle, curve)
    pieces += [flight[:, : windows.start.shape[1]] for flight in windows.fly(vehicle, thrusts)]
    # A row without numbers parts each prediction from the next.
    predicted = np.stack([*pieces, np.full_like(windows.start, np.nan)], axis=1)
    times = step * (windows.rows[:, None] + np.arange(count + 2))
    rows = slice(windows.rows[0], windows.rows[-1] + count)
    panels = [("body rate", "rad/s", BODY_RATES)]
    if log.has_motion:
        panels += [("velocity", "m/s", VELOCITY), ("position", "m", POSITION)]
    figure = Figure(figsize=(3 * WIDTH, HEIGHT * len(panels)), layout="constrained")
    all_axes = figure.subplots(len(panels), 3, squeeze=False, sharex=True)
    for line, (name, unit_name, part) in zip(all_axes, panels, strict=True):
        for axes, axis, k in zip(line, "xyz", range(part.start, part.stop), strict=True):
            recorded = log.motion[rows, k]
            axes.plot(step * np.arange(rows.start, rows.stop), recorded, "k", label="measured")
            flat = predicted[:, :, k].ravel()
            axes.plot(times.ravel(), flat, color=COLOURS[1], label="predicted", linewidth=1.2)
            axes.set(ylabel=f"{name} {axis} ({unit_name})", xlabel="time (s)")
    legend(figure)
    return figure


def split(logs: Sequence[Log]) -> tuple[list[Log], list[Log]]:
    """Return what to fit and what to judge: of three logs or more every third one judges, of fewer
    the last third of each flight.
    """
    if len(logs) > 2:
        return [log for k, log in enumerate(logs) if k % 3 != 1], [*logs[1::3]]
    fitted = []
    judged = []
    for log in logs:
        done = np.cumsum(log.flying)
        edge = int(np.searchsorted(done, done[-1] * 2 // 3))
        fitted.append(log.part(slice(0, edge)))
        judged.append(log.part(slice(edge, None)))
    return fitted, judged
