"""Fit a vehicle file to logs of its flights.

It reads PX4's ULog, Betaflight's blackbox, the logs of a Crazyflie's µSD card,
and CSV files. It prints each parameter with its interval, how far predictions
are off before and after on flights that were not fitted, and draws them.

examples:
  # a Crazyflie's logs
  sb3-quad fit log10 log15 -o mine.yaml
  # any other vehicle: a file with its mass and rotors, and guesses for the rest
  sb3-quad fit flight.ulg --vehicle start.yaml -o mine.yaml
  # choose the flights that judge
  sb3-quad fit a.bbl b.bbl --vehicle start.yaml --judge c.bbl -o mine.yaml

What a log needs, and what to do next: docs/your_vehicle.md.
"""

import sys
from argparse import Namespace
from pathlib import Path

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import refuse_existing
from sb3_quad.cli.parser import (
    OVERWRITE,
    PROGRESS,
    SEVERAL,
    Flags,
)

FLAGS: Flags = {
    "logs LOG": (SEVERAL, "logs of one vehicle, or folders of them"),
    "--vehicle": "name or file with the known numbers: mass, rotors (crazyflie for logs of one)",
    "--judge LOG": (SEVERAL, [], "logs that judge the fit (the last third of each log)"),
    "-o --output FILE": (str, "fitted.yaml", "vehicle file to write, with a .png (fitted.yaml)"),
    **OVERWRITE,
    **PROGRESS,
}


def run(options: Namespace) -> int:
    """Read, fit, judge, write. Returns the exit code."""
    from sb3_quad.cli.output import console, progress_bar
    from sb3_quad.envs.vehicles.vehicle import load_vehicle
    from sb3_quad.evaluation.plots import save_figure
    from sb3_quad.identification.fit import fit_vehicle
    from sb3_quad.identification.fit_report import (
        estimate_table,
        prediction_plot,
        split,
        write_vehicle,
    )
    from sb3_quad.identification.logs import read_logs
    from sb3_quad.identification.open_loop import error_table

    output = Path(options.output)
    picture = output.with_suffix(".png")
    for path in (output, picture):
        refuse_existing(path, options.overwrite)
    logs = read_logs(options.logs)
    if options.vehicle is None and logs[0].order != "crazyflie":
        raise ConfigError(
            f"{logs[0].path}: give --vehicle, a file with the mass and the rotors of your vehicle"
        )
    start = load_vehicle(options.vehicle or "crazyflie")
    for log in logs:
        for note in log.notes:
            print(note, file=sys.stderr)
    fitted = logs if options.judge else split(logs)[0]
    # Vehicles are judged at their own control step.
    again = read_logs(options.judge or options.logs, start.control_step)
    judged = again if options.judge else split(again)[1]
    with progress_bar(options.progress) as show:
        fit = fit_vehicle(fitted, start, output.stem, show)
    console().print(estimate_table(fit))
    vehicles = {"before": (start, None), "fitted": (fit.vehicle, fit.curve)}
    console().print(error_table(judged, vehicles))
    write_vehicle(output, fit, fitted)
    save_figure(prediction_plot(judged, fit.vehicle, fit.curve), picture)
    print("saved", output, "and", picture)
    return 0
