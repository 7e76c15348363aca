"""What the figures of a report show, apart from how they are drawn: ``interactive.py`` and ``pictures.py`` draw each kind."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Line:
    """A line, (n,) and (n,), and a band around it; NaN leaves a gap.

    :param faint: one of many, drawn thin and left out of the legend.
    """

    name: str
    colour: str
    x: FloatArray
    y: FloatArray
    low: FloatArray | None = None
    high: FloatArray | None = None
    faint: bool = False


@dataclass(frozen=True, eq=False)
class LineFigure:
    """Lines over a common axis.

    :param spans: intervals of x to shade, with what they mean.
    :param y_range: limits of the y axis; None: what the lines need.
    :param marks: whether each point is marked: few were measured.
    """

    name: str
    caption: str
    x_label: str
    y_label: str
    lines: Sequence[Line]
    spans: Sequence[tuple[float, float, str]] = ()
    y_range: tuple[float, float] | None = None
    marks: bool = False
    log_x: bool = False


@dataclass(frozen=True, eq=False)
class BarGroup:
    """The bars of one controller, one per category; NaN: none. ``low`` and ``high`` are the ends of the intervals.

    :param notes: what each bar says beside its value.
    """

    name: str
    colour: str
    values: FloatArray
    low: FloatArray
    high: FloatArray
    notes: Sequence[str] = ()


@dataclass(frozen=True, eq=False)
class BarFigure:
    """Bars in groups, and figures from elsewhere as marks among them."""

    name: str
    caption: str
    x_label: str
    y_label: str
    categories: Sequence[str]
    groups: Sequence[BarGroup]
    references: Sequence[tuple[str, FloatArray]] = ()


@dataclass(frozen=True, eq=False)
class HeatPanel:
    """Shares in percent on a grid, (rows, columns); NaN: not flown."""

    row: str
    column: str
    values: FloatArray


@dataclass(frozen=True, eq=False)
class HeatFigure:
    """Panels in rows (controllers) and columns (a third quantity) with common axes.

    :param colours: of the rows' names.
    """

    name: str
    caption: str
    x_label: str
    y_label: str
    x_values: Sequence[str]
    y_values: Sequence[str]
    panels: Sequence[HeatPanel]
    colours: dict[str, str]
    value_label: str = "success (%)"


@dataclass(frozen=True, eq=False)
class Path:
    """A way through space, (n, 3), m; ``lost``: it ends in a crash or out of range.

    :param first: carries the name in the legend; others of the same name do not.
    """

    name: str
    colour: str
    points: FloatArray
    lost: str = ""
    first: bool = True


@dataclass(frozen=True, eq=False)
class Arrow:
    """A force at a point of a path; ``vector`` in m as drawn."""

    at: FloatArray
    vector: FloatArray
    text: str


@dataclass(frozen=True, eq=False)
class PathFigure:
    """Ways through space with their targets, (k, 3), and the forces met on them."""

    name: str
    caption: str
    paths: Sequence[Path]
    targets: FloatArray
    start: FloatArray
    arrows: Sequence[Arrow] = field(default_factory=tuple)


Figure: TypeAlias = "LineFigure | BarFigure | HeatFigure | PathFigure"
