"""Notebooks in jupytext's percent form on pages, with what they print and plot where
SB3_QUAD_NOTEBOOKS is run.
"""

import base64
import contextlib
import io
import os
import re
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
from sphinx.application import Sphinx

RUN = os.environ.get("SB3_QUAD_NOTEBOOKS") == "run"


def append_notebook(app: Sphinx, page: str, source: list[str]) -> None:
    """Behind a page's own text come the cells of the notebook beside it; its title is the page's."""
    path = Path(app.srcdir, f"{page}.py")
    if path.is_file():
        source[0] += (
            "\n\n" + "\n\n".join(cells_of(path.read_text(encoding="utf-8"))).partition("\n")[2]
        )


def cells_of(text: str) -> list[str]:
    """The cells in Markdown, each code cell with its output behind it."""
    scope: dict[str, object] = {"__name__": "notebook"}
    found = []
    with (
        tempfile.TemporaryDirectory() as folder,
        plt.rc_context(),
        contextlib.chdir(folder) if RUN else contextlib.nullcontext(),
    ):
        for head, cell in re.findall(
            r"^# %%([^\n]*)\n(.*?)(?=^# %%|\Z)", text, flags=re.DOTALL | re.MULTILINE
        ):
            if "[markdown]" in head:
                found.append(re.sub(r"^# ?", "", cell.strip(), flags=re.MULTILINE))
            else:
                found.append(f"```python\n{cell.strip()}\n```")
                found += run(cell, scope) if RUN else []
    return found


def run(cell: str, scope: dict[str, object]) -> list[str]:
    """What a cell prints, and its plots."""
    printed, plots = io.StringIO(), []

    def show() -> None:
        picture = io.BytesIO()
        plt.savefig(picture, format="png")
        plt.close("all")
        plots.append(
            f'<img alt="plot" src="data:image/png;base64,{base64.b64encode(picture.getvalue()).decode()}">'
        )

    shown, plt.show = plt.show, show
    with contextlib.redirect_stdout(printed):
        exec(compile(cell, "notebook", "exec"), scope)
    plt.show = shown
    return [f"```text\n{printed.getvalue().rstrip()}\n```"] * bool(printed.getvalue()) + plots
