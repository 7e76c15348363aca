"""Write pages: sections as ``report.md``, their plots as files, and all of it as one file,
``report.html``.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from sb3_quad.base.files import write_bytes, write_text
from sb3_quad.base.templates import render
from sb3_quad.base.types import StrPath
from sb3_quad.evaluation.tables import Table
from sb3_quad.report.plots import Plot

PAGE = "report.html"
MARKDOWN = "report.md"
PICTURES = "figures"
TEMPLATES = "sb3_quad.report.templates"


class Section(NamedTuple):
    """A part of a page.

    :param anchor: its fragment in the page's address; unique in a page.
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

    The page needs no other file and no network. Existing files are replaced.

    :param facts: a paragraph below the title.
    :return: the page.
    :raises ConfigError: a folder that cannot be written.
    """
    folder = Path(folder)
    content = {"title": title, "facts": facts, "sections": sections, "pictures": PICTURES}
    write_text(folder / MARKDOWN, render(TEMPLATES, "page.md.j2", **content))
    for section in sections:
        for plot in section.plots:
            write_bytes(folder / PICTURES / f"{plot.name}.png", plot.png)
    write_text(folder / PAGE, render(TEMPLATES, "page.html.j2", **content))
    return folder / PAGE
