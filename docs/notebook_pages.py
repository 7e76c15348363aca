"""Show notebooks in jupytext's percent form on pages.

With SB3_QUAD_NOTEBOOKS=run they are run, and the page shows what they print and plot.
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
CELL = re.compile(r"^# %%([^\n]*)\n(.*?)(?=^# %%|\Z)", flags=re.DOTALL | re.MULTILINE)


def append_notebook(app: Sphinx, page: str, source: list[str]) -> None:
    """Append the cells of the notebook of the same name to a page, which has its title already."""
    path = Path(app.srcdir, f"{page}.py")
    if path.is_file():
        cells = "\n\n".join(cells_of(path.read_text(encoding="utf-8")))
        _, _, without_title = cells.partition("\n")
        source[0] += f"\n\n{without_title}"


def cells_of(text: str) -> list[str]:
    """Convert the cells to Markdown, each code cell followed by its output."""
    scope: dict[str, object] = {"__name__": "notebook"}
    parts = []
    with contextlib.ExitStack() as stack:
        stack.enter_context(plt.rc_context())
        # Notebooks write files. Keep them out of docs/.
        if RUN:
            folder = stack.enter_context(tempfile.TemporaryDirectory())
            stack.enter_context(contextlib.chdir(folder))
        for head, cell in CELL.findall(text):
            if "[markdown]" in head:
                parts.append(re.sub(r"^# ?", "", cell.strip(), flags=re.MULTILINE))
                continue
            parts.append(f"```python\n{cell.strip()}\n```")
            if RUN:
                parts += run(cell, scope)
    return parts


def run(cell: str, scope: dict[str, object]) -> list[str]:
    """Run a cell. Returns what it prints, and its plots, in Markdown."""
    printed = io.StringIO()
    plots: list[str] = []

    def show() -> None:
        picture = io.BytesIO()
        plt.savefig(picture, format="png")
        plt.close("all")
        data = base64.b64encode(picture.getvalue()).decode()
        plots.append(f'<img alt="plot" src="data:image/png;base64,{data}">')

    original = plt.show
    plt.show = show
    with contextlib.redirect_stdout(printed):
        exec(compile(cell, "notebook", "exec"), scope)
    plt.show = original
    if not printed.getvalue():
        return plots
    return [f"```text\n{printed.getvalue().rstrip()}\n```", *plots]
