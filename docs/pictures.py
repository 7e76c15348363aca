r"""Make pictures of the pages again, each by the commands that stand with its name.

Scripts drew cloning.png and learning_speed.png, and a report tracking_times.png; commit 5e3ee3c0 is
the last that has them.

    make pictures                       # all of them
    make pictures ARGS="starts.png"     # only these

Learning curves are not among them: they need trainings of hours, and the pages say which. The
commands run in ``build/pictures/``, which a call empties first, so that the agents of today fly.
What several pictures show is flown once.
"""

import argparse
import math
import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from sb3_quad.evaluation.results import Results

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent
BUILD = ROOT / "build/pictures"

# Evaluations that several pictures show.
CHAPTER_4 = """
sb3-quad evaluate PID=pid geometric "imitation agent=itm-imitation" "RL agent=itm-recovery"
    --suite thesis --scenario side_hit side_hit_size tracking -o thesis
"""

# By the picture's name: commands, one after the other; a line that is indented continues one. The
# last one draws the picture.
PICTURES = {
    "recovery.webp": """
sb3-quad enjoy "our agent (itm-robust)=itm-robust" "PID expert=pid"
    --scenario thesis:recovery_s1 -n 260 --size 320x320 -o recovery.webp
""",
    "film_frame.png": """
sb3-quad enjoy "RL agent=itm-recovery" geometric "PID expert=pid"
    --task state_recovery --seed 13 -n 90 --speed 0.5 --size 320x320 -o film.webp
frame film.webp 32 film_frame.png
""",
    "side_hit_size.png": CHAPTER_4
    + "success thesis side_hit_size.png 'side_hit_size 0 factor of the hit'",
    "starts.png": """
sb3-quad evaluate PID=pid geometric "imitation agent=itm-imitation" "RL agent=itm-recovery"
    --suite robustness --scenario starts -o starts
success starts starts.png 'starts 0 tilt at the start, °'
""",
    "robustness.png": """
sb3-quad evaluate PID=pid geometric "RL agent=itm-recovery" itm-robust any-quadcopter
    --suite robustness --scenario mass constant_force motor_gain delay noise wandering_gusts
    -o robustness
success robustness robustness.png
    "mass 0 mass (times the vehicle's own)" "constant_force 0 force (N)"
    "wandering_gusts 0 gusts, standard deviation (N)"
    "motor_gain 0 motor gain (times the vehicle's own)" "delay 0 delay (control steps)"
    "noise 0 observation noise (relative)"
""",
}


# What is drawn, and the least of it that is
LEAST = {"success": 0.0, "final_error_median": 1e-3}


def commands(text: str) -> list[list[str]]:
    """Return the words of each command of a picture."""
    return [shlex.split(line) for line in text.strip().replace("\n    ", " ").splitlines() if line]


def run(words: list[str]) -> None:
    """Run a command in BUILD.

    :raises subprocess.CalledProcessError: it fails.
    """
    program, *arguments = words
    if program == "frame":
        frame(BUILD / arguments[0], int(arguments[1]), BUILD / arguments[2])
        return
    if program == "success":
        folder, picture, *panels = arguments
        success(BUILD / folder, BUILD / picture, *panels)
        return
    if program == "sb3-quad":
        arguments = ["-m", "sb3_quad.cli", *arguments]
        if words[1] == "enjoy":
            arguments.append("--overwrite")
    paths = [str(ROOT), os.environ.get("PYTHONPATH", "")]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, paths))}
    subprocess.run([sys.executable, *arguments], cwd=BUILD, env=environment, check=True)


def frame(film: Path, number: int, picture: Path) -> None:
    """Write one frame of a film as a picture."""
    from PIL import Image

    with Image.open(film) as frames:
        frames.seek(number)
        frames.convert("RGB").save(picture, optimize=True)


def success(folder: Path, picture: Path, *panels: str) -> None:
    """Draw success over a number in the names of a grid's cells. With several panels, draw the
    median of the final errors of flights that survive below each.

    :param panels: "SCENARIO AXIS LABEL": the grid, the place of its number, and the name of that.
    """
    from matplotlib import pyplot

    from sb3_quad.evaluation.plots import STYLE, legend
    from sb3_quad.evaluation.results import load_results

    results = load_results(folder)
    pyplot.rcParams.update(STYLE)
    quantities = [*LEAST][: len(panels)]
    columns = min(len(panels), 3)
    lines = -(-len(panels) // columns) * len(quantities)
    figure = pyplot.figure(figsize=(4.2 * columns + 0.8, 2.5 * lines + 0.8), layout="constrained")
    for number, panel in enumerate(panels):
        scenario, place, label = panel.split(maxsplit=2)
        for row, quantity in enumerate(quantities):
            line = number // columns * len(quantities) + row
            axes = figure.add_subplot(lines, columns, line * columns + number % columns + 1)
            draw(axes, results, scenario, int(place), quantity)
        axes.set(xlabel=label)
    legend(figure)
    figure.savefig(picture, dpi=150)


def draw(axes: "Axes", results: "Results", scenario: str, place: int, quantity: str) -> None:
    """Draw a quantity of all controllers over a number of the cells: the mean over the other
    numbers, in a band from the least to the greatest.
    """
    import pandas as pd

    for controller, colour in results.colours.items():
        cells = []
        for entry in results.entries:
            name, _, cell = entry.scenario.partition(".")
            if (name, entry.controller) == (scenario, controller):
                # Without a survivor there is no final error.
                metric = getattr(entry.metrics, quantity)
                value = metric.value if metric else math.nan
                cells.append((float(cell.split("_")[place]), value))
        table = pd.DataFrame(cells, dtype=float).groupby(0)[1].agg(["mean", "min", "max"])
        table = table.clip(LEAST[quantity])
        axes.plot(table["mean"], "o-", color=colour, label=controller, markersize=3.5)
        axes.fill_between(table.index, table["min"], table["max"], color=colour, alpha=0.16)
    if quantity == "success":
        axes.set(ylabel="success", ylim=(-0.03, 1.03))
    else:
        axes.set(ylabel="final error, median (m)", yscale="log", ylim=(8e-4, 10.0))
        axes.yaxis.set_major_formatter("{x:g}")


def main() -> None:
    """Make the pictures that the command line names, and move them into the folder of the pages."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("pictures", nargs="*", metavar="PICTURE", help="only these")
    parser.add_argument("--into", type=Path, default=DOCS, help="folder for them (docs/)")
    options = parser.parse_args()
    unknown = set(options.pictures) - set(PICTURES)
    if unknown:
        parser.error(f"unknown: {', '.join(sorted(unknown))}; there are {', '.join(PICTURES)}")
    shutil.rmtree(BUILD, ignore_errors=True)
    BUILD.mkdir(parents=True)
    flown = set()
    for name in options.pictures or PICTURES:
        for words in commands(PICTURES[name]):
            line = shlex.join(words)
            if line in flown:
                continue
            print("$", line, flush=True)
            run(words)
            if words[1] == "evaluate":
                flown.add(line)
        options.into.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(BUILD / name, options.into / name)
        print(f"{options.into / name}", flush=True)


if __name__ == "__main__":
    main()
