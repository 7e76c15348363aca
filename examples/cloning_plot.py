"""How far agents hover from their targets after stage two, with the cloning term and without:
docs/research/results.md.

    sb3-quad sweep cloning
    python examples/cloning_plot.py logs/sweep/cloning_1/results.csv cloning.png

A configuration is called after what it shares with another and whether it clones, such as "our
reward, cloning, 1 M".
"""

import argparse
import csv
from collections import defaultdict
from pathlib import Path

from matplotlib.figure import Figure

COLOURS = {"cloning": "#1B7EC2", "none": "#D55E00"}


def pairs(path: str | Path, scenario: str = "tracking") -> dict[str, dict[str, list[float]]]:
    """By what two configurations share, and by whether they clone, the median final error of each
    seed, m.
    """
    found: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    with Path(path).open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            if row["scenario"] == scenario and row["final_error"]:
                parts = [part.replace("-", " ").strip() for part in row["configuration"].split(",")]
                kind = next(part for part in parts if part.startswith(tuple(COLOURS)))
                label = ", ".join(part for part in parts if part != kind)
                found[label][kind].append(float(row["final_error"]))
    return found


def draw(found: dict[str, dict[str, list[float]]]) -> Figure:
    """A line for each pair: a point for each seed, a bar at their mean."""
    figure = Figure(figsize=(8.0, 0.55 * len(found) + 1.2), layout="constrained")
    axes = figure.subplots()
    for y, kinds in enumerate(found.values()):
        for kind, errors in kinds.items():
            colour = COLOURS[kind.split(" ")[0]] if kind in COLOURS else "#7A5BC0"
            height = y + {"cloning": -0.14, "none": 0.14}.get(kind, 0.0)
            shown = kind if y == 0 else None  # in the legend
            axes.plot(errors, [height] * len(errors), "o", color=colour, alpha=0.75, label=shown)
            axes.plot(
                sum(errors) / len(errors),
                height,
                "|",
                color=colour,
                markersize=16,
                markeredgewidth=2.5,
            )
    axes.set_yticks(range(len(found)), [label or "all else as it is" for label in found])
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
