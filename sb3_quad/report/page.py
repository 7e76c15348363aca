"""Write pages: sections as ``report.md``, their plots as files, and all of it as one file,
``report.html``.
"""

import html
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import jinja2

from sb3_quad.base.files import write_bytes, write_text
from sb3_quad.base.types import StrPath
from sb3_quad.evaluation.tables import Table
from sb3_quad.report.plots import Plot

PAGE = "report.html"
MARKDOWN = "report.md"
PICTURES = "figures"


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


def write_page(folder: StrPath, title: str, facts: str, sections: Sequence[Section]) -> Path:
    """Write ``report.md`` with the tables, ``figures/`` with each plot as PNG, and the page,
    ``report.html``.

    The page needs no other file and no network. Files that are there are replaced.

    :param facts: a paragraph below the title.
    :return: the page.
    :raises ConfigError: a folder that cannot be written.
    """
    folder = Path(folder)
    write_text(folder / MARKDOWN, _markdown(title, sections))
    for section in sections:
        for plot in section.plots:
            write_bytes(folder / PICTURES / f"{plot.name}.png", plot.png)
    write_text(folder / PAGE, render(title, facts, sections))
    return folder / PAGE


def render(title: str, facts: str, sections: Sequence[Section]) -> str:
    """Return the page as text, which expects its plots as files in ``figures/``."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("sb3_quad.report", "templates"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    template = environment.get_template("page.html.j2")
    return template.render(title=title, facts=facts, sections=sections, pictures=PICTURES)


def _markdown(title: str, sections: Sequence[Section]) -> str:
    """Return headings, descriptions and tables as text, for the pages of a repository."""
    blocks = [f"# {_escape(title)}"]
    for section in sections:
        texts = (section.heading, section.description, section.facts)
        heading, *paragraphs = map(_escape, texts)
        blocks += [f"## {heading}", *paragraphs]
        blocks += [table.markdown() for table in section.tables]
    return "\n\n".join(filter(None, blocks)) + "\n"


def _escape(text: str) -> str:
    """Return a text as one line that holds no HTML."""
    return html.escape(" ".join(text.split()), False)
