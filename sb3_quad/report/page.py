"""The one maker of pages: sections as ``report.md``, their plots as files, and all of it as one
file, ``report.html``.
"""

import html
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jinja2

from sb3_quad.base.files import write_bytes, write_text
from sb3_quad.evaluation.tables import Table
from sb3_quad.report.plots import Plot

PAGE, MARKDOWN, PICTURES = "report.html", "report.md", "figures"


@dataclass(frozen=True)
class Section:
    """A part of a page.

    :param anchor: its place in the page's address; unique in a page.
    :param facts: small print below the description.
    """

    anchor: str
    heading: str
    description: str = ""
    tables: Sequence[Table] = ()
    plots: Sequence[Plot] = ()
    facts: str = ""


def write_page(folder: str | Path, title: str, facts: str, sections: Sequence[Section]) -> Path:
    """Write ``report.md`` with the tables, ``figures/`` with each plot as PNG, and the page,
    ``report.html``.

    The page needs no other file and no network. Files that are there are replaced.

    :param facts: a paragraph below the title.
    :return: the page.
    :raises ConfigError: a folder that cannot be written.
    """
    folder = Path(folder)
    write_text(folder / MARKDOWN, _markdown(title, sections))
    for plot in (plot for section in sections for plot in section.plots):
        write_bytes(folder / PICTURES / f"{plot.name}.png", plot.png)
    write_text(folder / PAGE, render(title, facts, sections))
    return folder / PAGE


def render(title: str, facts: str, sections: Sequence[Section]) -> str:
    """The page as text, which expects its plots as files in ``figures/``."""
    loader = jinja2.PackageLoader("sb3_quad.report", "templates")
    options: Any = {
        "autoescape": True,
        "undefined": jinja2.StrictUndefined,
        "trim_blocks": True,
        "lstrip_blocks": True,
    }
    template = jinja2.Environment(loader=loader, **options).get_template("page.html.j2")
    return template.render(title=title, facts=facts, sections=sections, pictures=PICTURES)


def _markdown(title: str, sections: Sequence[Section]) -> str:
    """The tables as text, for the pages of a repository: a heading, what it is about, and a table
    for each section.
    """
    blocks = [f"# {html.escape(title, False)}"]
    for part in sections:
        heading, *texts = (
            html.escape(" ".join(text.split()), False)
            for text in (part.heading, part.description, part.facts)
        )
        blocks += [
            f"## {heading}",
            *filter(None, texts),
            *(table.markdown() for table in part.tables),
        ]
    return "\n\n".join(blocks) + "\n"
