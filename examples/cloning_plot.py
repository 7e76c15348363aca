"""Plot how far RL agents hover from their targets, with the cloning term and without.

docs/research/results.md shows the plot.

    sb3-quad sweep cloning
    python examples/cloning_plot.py logs/sweep/cloning_1/results.csv cloning.png

The name of a configuration tells what it has in common with another one, and whether it clones:
"our reward, cloning, 1 M", for example.
"""

import argparse
import csv
from collections import defaultdict
from pathlib import Path

from matplotlib.figure import Figure

COLOURS = {"cloning": "#1B7EC2", "none": "#D55E00"}


def pairs(path: str | Path, scenario: str = "tracking") -> dict[str, dict[str, list[float]]]:
    """Read the median final error of each seed, m.

    :returns: lists, by what two configurations have in common and by whether they clone.
    """
    errors: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    with Path(path).open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            if row["scenario"] == scenario and row["final_error"]:
                label, kind = split_name(row["configuration"])
                errors[label][kind].append(float(row["final_error"]))
    return errors


def split_name(configuration: str) -> tuple[str, str]:
    """Split "our reward, cloning, 1 M" into ("our reward, 1 M", "cloning")."""
    kind = ""
    shared = []
    for part in configuration.replace("-", " ").split(","):
        if part.strip().startswith(tuple(COLOURS)):
            kind = part.strip()
        else:
            shared.append(part.strip())
    return ", ".join(shared), kind


def draw(errors: dict[str, dict[str, list[float]]]) -> Figure:
    """Draw a line for each pair: a point for each seed, a bar at their mean."""
    figure = Figure(figsize=(8.0, 0.55 * len(errors) + 1.2), layout="constrained")
    axes = figure.subplots()
    for y, kinds in enumerate(errors.values()):
        for kind, values in kinds.items():
            colour = COLOURS.get(kind, "#7A5BC0")
            height = y + {"cloning": -0.14, "none": 0.14}.get(kind, 0.0)
            # The legend needs each kind once.
            label = kind if y == 0 else None
            axes.plot(values, [height] * len(values), "o", color=colour, alpha=0.75, label=label)
            mean = sum(values) / len(values)
            axes.plot(mean, height, "|", color=colour, markersize=16, markeredgewidth=2.5)
    axes.set_yticks(range(len(errors)), [label or "all else unchanged" for label in errors])
    axes.invert_yaxis()
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.set_xlabel("median final error, targets 10 m away, m (points: seeds)")
    axes.grid(axis="x", color="#e4e7ec")
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.legend(frameon=False, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3)
    return figure


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("results", help="results.csv of the sweep")
    parser.add_argument("output", help="PNG")
    arguments = parser.parse_args()
    draw(pairs(arguments.results)).savefig(arguments.output, dpi=110)
    print(f"saved {arguments.output}")
