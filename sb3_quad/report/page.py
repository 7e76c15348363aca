"""``report.html``: one file that needs nothing else; its tables as ``report.md`` and the plots as pictures beside it."""

import base64
import gzip
import html
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import refuse_existing, write_bytes, write_text
from sb3_quad.base.imports import require
from sb3_quad.envs.rendering.labels import colours_of
from sb3_quad.evaluation.folder import load_results
from sb3_quad.evaluation.records import Results
from sb3_quad.report.sections import Section, sections

PAGE, TABLES, PICTURES = "report.html", "report.md", "figures"


def write_report(folder: str | Path, overwrite: bool = False, with_pictures: bool = True) -> Path:
    """Write the report of a folder of results: its tables as ``report.md``, its plots, and the page with both.

    :param overwrite: replace a report that is there.
    :param with_pictures: also write every plot as PNG and SVG, into ``figures/``.
    :return: the page.
    :raises ConfigError: no results, damaged ones, a report that is there already, a folder that cannot be written;
        :class:`MissingExtra` if the page alone could not be written.
    """
    page = Path(folder) / PAGE
    results = load_results(folder)
    if not results.entries:
        raise ConfigError(f"{folder}: holds no flights, only failures; there is nothing to report")
    refuse_existing(page, overwrite)
    parts = sections(results, folder)
    write_text(Path(folder) / TABLES, render_markdown(results, parts))
    for plot in (plot for section in parts for plot in section.plots) if with_pictures else ():
        write_bytes(Path(folder) / PICTURES / f"{plot.name}.png", plot.png)
        write_bytes(Path(folder) / PICTURES / f"{plot.name}.svg", plot.svg)
    write_text(page, render(results, parts, with_pictures))
    return page


def render(results: Results, parts: Sequence[Section], with_pictures: bool) -> str:
    """The page as text.

    :raises MissingExtra: Jinja2 is not installed, or Plotly, where there are flights in space.
    """
    environment = _templates()
    spaces = {plot.name: plot.space for section in parts for plot in section.plots if plot.space is not None}
    text: str = environment.get_template("page.html.j2").render(
        results=results,
        sections=parts,
        colours=colours_of([record.label for record in results.controllers]),
        flights=sum(entry.metrics.n for entry in results.entries),
        backends=sorted({entry.backend for entry in results.entries}),
        dates=_first_and_last({entry.date for entry in results.entries} - {""}),
        pictures=PICTURES if with_pictures else "",
        spaces=_for_script(spaces),
        plotly=_packed(require("plotly.offline", "report", PAGE).get_plotlyjs()) if spaces else "",
    )
    return text


def render_page(title: str, facts: str, parts: Sequence[Section]) -> str:
    """A page of sections without flights in space, its plots also in ``figures/``.

    :raises MissingExtra: Jinja2 is not installed.
    """
    page: str = _templates().get_template("sweep.html.j2").render(title=title, facts=facts, sections=parts, pictures=PICTURES)
    return page


def _templates() -> Any:
    jinja2 = require("jinja2", "report", PAGE)
    return jinja2.Environment(
        loader=jinja2.PackageLoader("sb3_quad.report", "templates"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def render_markdown(results: Results, parts: Sequence[Section]) -> str:
    """The tables as text, for the pages of a repository: a heading, what it is about, and a table for each section."""
    blocks = [f"# Suite {results.suite}"]
    for part in parts:
        heading, *texts = (html.escape(" ".join(text.split()), False) for text in (part.heading, part.description, part.facts))
        blocks += [f"## {heading}", *filter(None, texts), *(table.markdown() for table in part.tables)]
    return "\n\n".join(blocks) + "\n"


def _first_and_last(dates: set[str]) -> list[str]:
    return sorted({min(dates), max(dates)}) if dates else []


def _packed(script: str) -> str:
    """A script as gzip in base64, less than half as large, which page.js unpacks."""
    return base64.b64encode(gzip.compress(script.encode(), mtime=0)).decode()


def _for_script(content: Any) -> str:
    """JSON that cannot end the ``script`` element it stands in."""
    return json.dumps(content, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
