"""The results of a fit: a table, a vehicle file with comments, and a picture of its predictions."""

import json
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
from sb3_quad.identification.flight_log import MOTION_SIZE, Log, flown
from sb3_quad.identification.open_loop import Windows, log_thrusts
from sb3_quad.identification.parameters import TERMS

# By the kind of a command: its symbol, the unit of the thrust by it, and its meaning
COMMANDS = {
    "thrust": ("T", "1", "of its command in N"),
    "rotor_speed": ("ω", "N s²", "of its speed, rad/s"),
    "share": ("u", "N", "of its command u, 0 to 1"),
}
# How far each prediction of the picture goes, and how long the picture is, s
AHEAD = 0.25
SHOWN = 6.0
HELD = "held: logs tell thrust and moments by mass alone"


def labels(estimate: Estimate, kind: str) -> tuple[str, str, str]:
    """Return what a parameter is called, its unit, and its interval or why there is none."""
    field, element = estimate.field, estimate.element
    told = f"held: {estimate.reason}" if estimate.reason else f"± {estimate.width:.2g}"
    if field == "curve":
        symbol, unit, _ = COMMANDS[kind]
        return f"thrust, {symbol}^{POWERS[kind][element]}", unit, told
    name = field.removesuffix("_up")
    if TERMS[field].axes:
        name += " " + "xyz"[element]
    return name, TERMS[field].unit, told


def estimate_table(fit: Fit, start: Vehicle) -> Table:
    """Return each parameter with its start and its interval, or why logs do not tell it."""
    rows = [["mass", f"{start.mass:.4g}", f"{start.mass:.4g}", "kg", HELD]]
    for estimate in fit.estimates:
        before = ""
        if estimate.field == "delay":
            before = f"{start.delay * start.control_step:.4g}"
        elif estimate.field != "curve":
            before = f"{np.ravel(getattr(start, estimate.field))[estimate.element]:.4g}"
        name, unit, told = labels(estimate, fit.curve.kind)
        rows.append([name, before, f"{estimate.value:.4g}", unit, told])
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
    comments = {"mass": f"kg; {HELD}", "delay": "control steps"}
    for estimate in fit.estimates:
        _, unit, told = labels(estimate, fit.curve.kind)
        field = estimate.field.removesuffix("_up")
        if field == "delay":
            told = f"fitted {estimate.value:.4f} {told} s"
        before = comments.setdefault(field, unit)
        if not before.endswith(told):
            comments[field] = f"{before}; {told}"
    comments["inertia"] += "; Izz by its ratio to Ixx + Iyy"
    content = fit.vehicle.model_dump(mode="json", exclude_defaults=True)
    content["motor_gain"] = content.pop("motor_gain_up")
    del content["motor_gain_down"]
    content["delay"] = fit.vehicle.delay
    short = json.loads(json.dumps(content), parse_float=lambda text: float(f"{float(text):.6g}"))
    for line in yaml.safe_dump(short, sort_keys=False, default_flow_style=None).splitlines():
        comment = comments.get(line.partition(":")[0])
        lines.append(f"{line:<44} # {comment}" if comment else line)
    write_text(path, "\n".join(lines) + "\n")


def curve_text(fit: Fit) -> str:
    """Return the thrust of a motor over its command as a formula."""
    kind = fit.curve.kind
    symbol, _, meaning = COMMANDS[kind]
    terms = []
    for power, number in zip(POWERS[kind], fit.curve.coefficients, strict=True):
        terms.append(f"{number:+.4g} {symbol}^{power}")
    return f"Thrust of a motor, N, {meaning}: {' '.join(terms)}"


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
    flights = windows.fly(vehicle, log_thrusts([log], vehicle, curve))
    pieces = [windows.start, *(flight[:, :MOTION_SIZE] for flight in flights)]
    # A row without numbers parts each prediction from the next.
    pieces.append(np.full_like(windows.start, np.nan))
    predicted = np.stack(pieces, axis=1).reshape(-1, MOTION_SIZE)
    times = step * (windows.rows[:, None] + np.arange(count + 2)).ravel()
    rows = np.arange(windows.rows[0], windows.rows[-1] + count)
    panels = [("body rate", "rad/s", BODY_RATES)]
    if log.has_motion:
        panels += [("velocity", "m/s", VELOCITY), ("position", "m", POSITION)]
    figure = Figure(figsize=(3 * WIDTH, HEIGHT * len(panels)), layout="constrained")
    all_axes = figure.subplots(len(panels), 3, squeeze=False, sharex=True)
    for line, (name, unit, part) in zip(all_axes, panels, strict=True):
        for k, axes in enumerate(line):
            axes.plot(step * rows, log.motion[rows, part.start + k], "k", label="measured")
            axes.plot(times, predicted[:, part.start + k], color=COLOURS[1], label="predicted")
            axes.set(ylabel=f"{name} {'xyz'[k]} ({unit})", xlabel="time (s)")
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
        rows = np.flatnonzero(log.flying)
        edge = int(rows[len(rows) * 2 // 3])
        fitted.append(log.part(slice(0, edge)))
        judged.append(log.part(slice(edge, None)))
    return fitted, judged
