"""How the plots of a page look, which matplotlib draws, and how they come into the page and into
files.
"""

import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sb3_quad.base.arrays import FloatArray
from sb3_quad.evaluation.statistics import Estimate

INK, QUIET, GRID, PAPER = (
    "#1c2430",
    "#5c6672",
    "#dfe3e8",
    "#ffffff",
)  # of text, small print, grid and background
WIDTH, HEIGHT = (
    5.0,
    3.3,
)  # inches: two stand side by side in the page, and one can be read on a telephone
DPI = 150
LETTERS = 13  # of a legend, per inch
POINTS: Any = {"marker": "o", "markersize": 3.5}  # on curves through few of them
STYLE: Any = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "svg.fonttype": "none",
    "svg.hashsalt": "sb3_quad",
    "text.parse_math": False,
    "grid.color": GRID,
    "figure.facecolor": PAPER,
    "axes.facecolor": PAPER,
    **dict.fromkeys(("text.color", "axes.labelcolor", "xtick.labelcolor", "ytick.labelcolor"), INK),
    **dict.fromkeys(("axes.edgecolor", "xtick.color", "ytick.color"), QUIET),
}
styled = matplotlib.rc_context(STYLE)
METADATA: Any = dict.fromkeys(
    ("Date", "Creator", "Format", "Type")
)  # left out: the same results give the same file


@dataclass(frozen=True, eq=False)
class Plot:
    """A plot of a page; ``name``, unique in a page, is that of its files."""

    name: str
    caption: str
    figure: Figure

    @property
    def png(self) -> bytes:
        """The plot as a PNG file."""
        return picture(self.figure, "png", bbox_inches="tight", dpi=DPI)

    @property
    def inline(self) -> str:
        """The plot as a part of the page: an ``svg`` element in the page's colours, which may be
        dark.
        """
        text = picture(self.figure, "svg", bbox_inches="tight", metadata=METADATA).decode("utf-8")
        text = text[text.index("<svg") :]
        for colour, name in ((INK, "ink"), (QUIET, "quiet"), (GRID, "grid"), (PAPER, "paper")):
            text = text.replace(colour, f"var(--{name})")
        text = re.sub(
            r' id="[a-zA-Z0-9]+_\d+"', "", text
        )  # names of groups, which others have, too
        return re.sub(
            r' d="[^"]*"', lambda path: re.sub(r"(\.\d\d)\d+", r"\1", path[0]), text
        )  # to 0.01 of a point


@styled
def picture(figure: Figure, kind: str, **options: Any) -> bytes:
    """A figure of matplotlib as a file of some kind, such as ``png``; ``options`` are those of its
    ``savefig``.
    """
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, **options)
    return buffer.getvalue()


def legend(figure: Figure) -> None:
    """Every name in the figure, once outside of its axes, in as many columns as have room."""
    pairs = [zip(*axes.get_legend_handles_labels(), strict=True) for axes in figure.axes]
    found = {name: handle for pair in pairs for handle, name in pair}
    room = (
        LETTERS * figure.get_figwidth() / (max(map(len, found), default=0) + 8)
    )  # 8: the mark before a name
    figure.legend([*found.values()], [*found], loc="outside upper left", ncols=max(1, int(room)))


def new_axes(x_label: str, y_label: str) -> tuple[Figure, Axes]:
    """A figure as wide as one of two side by side, and its axes."""
    figure = Figure(figsize=(WIDTH, HEIGHT), layout="constrained")
    axes = figure.subplots()
    axes.set(xlabel=x_label, ylabel=y_label)
    return figure, axes


def interval_ends(estimates: Sequence[Estimate | None], factor: float = 1.0) -> FloatArray:
    """Values and both ends of their intervals, (3, n); NaN where there is none."""
    rows = [
        [each and getattr(each, name) for each in estimates] for name in ("value", "low", "high")
    ]
    return factor * np.array(rows, dtype=np.float64)


def band(
    axes: Axes, colour: str, label: str, x: FloatArray, ends: FloatArray, **style: Any
) -> None:
    """A line and the band around it; ``ends`` are values, low and high, (3, n)."""
    axes.plot(x, ends[0], color=colour, label=label, **{"linewidth": 1.6, **style})
    axes.fill_between(x, ends[1], ends[2], color=colour, alpha=0.16, linewidth=0)
