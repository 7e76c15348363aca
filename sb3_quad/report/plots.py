"""The style of a page's plots, and their way into the page and into files."""

import io
import re
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sb3_quad.base.types import StrDict

# The colours of the style, with their names in the page's own scheme, which may be dark
COLOURS = {"#1c2430": "ink", "#5c6672": "quiet", "#dfe3e8": "grid", "#ffffff": "paper"}
# Inches: two fit side by side in the page, and one can be read on a telephone.
WIDTH = 5.0
HEIGHT = 3.3
DPI = 150
# Letters per inch of a legend, and the width in letters of the mark before each name
LETTERS = 13
MARK = 8
POINTS: Any = {"marker": "o", "markersize": 3.5}  # on curves through few of them
STYLE = matplotlib.rc_params_from_file(
    Path(__file__).parent / "templates/plots.mplstyle", use_default_template=False
)
styled = matplotlib.rc_context(STYLE)
# None removes these from the file, so that the same results yield the same bytes.
METADATA = dict.fromkeys(("Date", "Creator", "Format", "Type"))


class Plot(NamedTuple):
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
        """The plot as an ``svg`` element in the page's colours, which may be dark."""
        text = picture(self.figure, "svg", bbox_inches="tight", metadata=METADATA).decode("utf-8")
        text = text[text.index("<svg") :]
        for colour, name in COLOURS.items():
            text = text.replace(colour, f"var(--{name})")
        # Groups have the same names in every plot, and names must be unique in a page.
        text = re.sub(r' id="[a-zA-Z0-9]+_\d+"', "", text)
        # Paths to 0.01 of a point keep the page small.
        return re.sub(r' d="[^"]*"', lambda path: re.sub(r"(\.\d\d)\d+", r"\1", path[0]), text)


@styled
def picture(figure: Figure, kind: str, **options: Any) -> bytes:
    """Return a figure of matplotlib as a file of some kind, such as ``png``.

    :param options: options of the figure's ``savefig``.
    """
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, **options)
    return buffer.getvalue()


def legend(figure: Figure) -> None:
    """Write every name in the figure once, outside of its axes, in as many columns as have room."""
    handles: StrDict = {}
    for axes in figure.axes:
        drawn, names = axes.get_legend_handles_labels()
        handles.update(zip(names, drawn, strict=True))
    longest = max(map(len, handles), default=0) + MARK
    figure.legend(
        [*handles.values()],
        [*handles],
        loc="outside upper left",
        ncols=max(1, int(LETTERS * figure.get_figwidth() / longest)),
    )


def new_axes(x_label: str, y_label: str) -> tuple[Figure, Axes]:
    """Return a figure as wide as one of two side by side, and its axes."""
    figure = Figure(figsize=(WIDTH, HEIGHT), layout="constrained")
    axes = figure.subplots()
    axes.set(xlabel=x_label, ylabel=y_label)
    return figure, axes


def band(axes: Axes, colour: str, label: str, table: pd.DataFrame, **style: Any) -> None:
    """Draw a line and the band around it over the index of a table: value, low and high."""
    middle, low, high = table.to_numpy().T
    axes.plot(table.index, middle, color=colour, label=label, **{"linewidth": 1.6, **style})
    axes.fill_between(table.index, low, high, color=colour, alpha=0.16, linewidth=0)
