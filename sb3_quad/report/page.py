"""``report.html``: one file that needs nothing else; its tables as ``report.md`` and the figures as pictures beside it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import refuse_existing, write_bytes, write_text
from sb3_quad.evaluation.folder import load_results
from sb3_quad.evaluation.records import Results
from sb3_quad.report import interactive, pictures
from sb3_quad.report.figures import LineFigure
from sb3_quad.report.markdown import render_markdown
from sb3_quad.report.sections import Section, sections

PAGE, TABLES, PICTURES = "report.html", "report.md", "figures"


def write_report(
    folder: str | Path,
    overwrite: bool = False,
    with_pictures: bool = True,
    progress: Callable[[str], None] = lambda heading: None,
) -> Path:
    """Write the report of a folder of results; its tables as ``report.md`` too.

    :param overwrite: replace a report that is there.
    :param with_pictures: also write every figure as PNG and SVG, into ``figures/``.
    :param progress: told the heading of each section before its pictures are made.
    :return: the page.
    :raises ConfigError: no results, damaged ones, a report that is there already, a folder that cannot be written.
    """
    page = Path(folder) / PAGE
    results = load_results(folder)
    if not results.entries:
        raise ConfigError(f"{folder}: holds no flights, only failures; there is nothing to report")
    refuse_existing(page, overwrite)
    parts = sections(results, folder)
    if with_pictures:
        for section in parts:
            progress(section.heading)
            for figure in section.figures:
                for name, content in pictures.files(figure).items():
                    write_bytes(Path(folder) / PICTURES / name, content)
    write_text(Path(folder) / TABLES, render_markdown(results, parts))
    write_text(page, render(results, parts, with_pictures))
    return page


def render(results: Results, parts: list[Section], with_pictures: bool) -> str:
    """The page as text."""
    from jinja2 import Environment, PackageLoader, StrictUndefined
    from plotly.offline import get_plotlyjs

    from sb3_quad.drawing.palette import colours_of

    figures = {figure.name: interactive.draw(figure) for section in parts for figure in section.figures}
    environment = Environment(
        loader=PackageLoader("sb3_quad.report", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    kept = {name: {"data": figure["data"], "layout": figure["layout"]} for name, figure in figures.items()}
    return environment.get_template("page.html.j2").render(
        results=results,
        sections=parts,
        heights={name: figure["height"] for name, figure in figures.items()},
        kinds={name: "space" if "scene" in figure["layout"] else "plane" for name, figure in figures.items()},
        narrow={
            figure.name for section in parts for figure in section.figures if isinstance(figure, LineFigure) and figure.marks
        },
        colours=colours_of([record.label for record in results.controllers]),
        flights=sum(entry.metrics.n for entry in results.entries),
        backends=sorted({entry.backend for entry in results.entries}),
        pictures=PICTURES if with_pictures else "",
        figures_json=_for_script(kept),
        plotly=get_plotlyjs(),
    )


def _for_script(content: Any) -> str:
    """JSON that cannot end the ``script`` element it stands in."""
    return json.dumps(content, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
