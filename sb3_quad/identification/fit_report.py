"""The results of a fit: a table, a vehicle file with comments, and a picture of its predictions."""

import json
from collections.abc import Sequence
from textwrap import indent

import numpy as np
import yaml
from matplotlib.figure import Figure

from sb3_quad.base.files import write_text
from sb3_quad.base.types import StrPath
from sb3_quad.envs.simulation.state import BODY_RATES, POSITION, VELOCITY
from sb3_quad.envs.vehicles.vehicle import Vehicle
from sb3_quad.evaluation.plots import HEIGHT, WIDTH, legend, styled
from sb3_quad.evaluation.tables import COLOURS, Table
from sb3_quad.identification.curve import Curve
from sb3_quad.identification.fit import Fit
from sb3_quad.identification.flight_log import Log
from sb3_quad.identification.open_loop import Windows, log_thrusts

# How far each prediction of the picture goes, and how long the picture is, s
AHEAD = 0.25
SHOWN = 6.0
PANELS = (
    ("body rate", "rad/s", BODY_RATES),
    ("velocity", "m/s", VELOCITY),
    ("position", "m", POSITION),
)


def estimate_table(fit: Fit) -> Table:
    """Return each parameter with its start and its interval, or why logs do not tell it."""
    mass = f"{fit.vehicle.mass:.4g}"
    rows = [["mass", mass, mass, "kg", "held: logs tell thrust and moments by mass alone"]]
    for one in fit.estimates.itertuples():
        interval = f"± {one.width:.2g}"
        if one.reason:
            interval = f"held: {one.reason}"
        before = f"{one.start:.4g}"
        after = f"{one.value:.4g}"
        rows.append([one.name, before, after, one.unit, interval])
    return Table(
        ("parameter", "start", "fitted", "unit", "95 % interval"),
        rows,
        fit.vehicle.name,
        align="left",
    )


def write_vehicle(path: StrPath, fit: Fit, logs: Sequence[Log]) -> None:
    """Write the vehicle file of a fit; its comments hold the table of the estimates.

    :raises ConfigError: a folder that cannot be written, or a full disk.
    """
    seconds = sum(log.step * log.flying.sum() for log in logs)
    names = ", ".join(dict.fromkeys(log.path.name for log in logs))
    table = estimate_table(fit).markdown()
    comments = f"Fitted by sb3-quad fit to {seconds:.0f} s of {names}.\n{table}\n"
    content = fit.vehicle.model_dump_json(exclude_defaults=True)
    short = json.loads(content, parse_float=_short)
    text = yaml.safe_dump(short, sort_keys=False, default_flow_style=None)
    write_text(path, indent(comments, "# ") + text)


def _short(number: str) -> float:
    return float(f"{float(number):.6g}")


@styled
def prediction_plot(logs: Sequence[Log], vehicle: Vehicle, curve: Curve) -> Figure:
    """Draw recorded body rates, velocities and positions of the first log, and above them what the
    vehicle does on the recorded commands, from the recorded state every ``AHEAD`` seconds.

    :param logs: with rows at the vehicle's control step.
    """
    log = logs[0]
    step = vehicle.control_step
    count = round(AHEAD / step)
    windows = Windows([log], vehicle, range(1, count + 1), count)
    flown = windows.fly(vehicle, log_thrusts([log], vehicle, curve))
    predicted = np.stack([windows.start, *(motion for motion, _ in flown)])
    first = windows.rows[0]
    shown = windows.rows < first + round(SHOWN / step)
    rows = windows.rows[shown] + np.arange(count + 1)[:, None]
    recorded = np.arange(first, rows.max())
    panels = PANELS if log.has_motion else PANELS[:1]
    figure = Figure(figsize=(3 * WIDTH, HEIGHT * len(panels)), layout="constrained")
    all_axes = figure.subplots(len(panels), 3, squeeze=False, sharex=True)
    for line, (name, unit, part) in zip(all_axes, panels, strict=True):
        for k, axes in enumerate(line, part.start):
            measured = log.motion[recorded, k]
            axes.plot(step * recorded, measured, "k", label="measured")
            flight = predicted[:, shown, k]
            axes.plot(step * rows, flight, color=COLOURS[1], label="predicted")
            axis = "xyz"[k - part.start]
            axes.set(ylabel=f"{name} {axis} ({unit})", xlabel="time (s)")
    legend(figure)
    return figure


def split(logs: Sequence[Log]) -> tuple[list[Log], list[Log]]:
    """Return what to fit, and what to judge: the last third of each flight."""
    fitted = []
    judged = []
    for log in logs:
        rows = np.flatnonzero(log.flying)
        edge = rows[len(rows) * 2 // 3]
        fitted.append(log.part(slice(0, edge)))
        judged.append(log.part(slice(edge, None)))
    return fitted, judged
