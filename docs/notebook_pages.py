"""Run the notebooks of docs/notebooks, and show them with their outputs on the site.

A notebook is a .py file in jupytext's percent form. Beside it lies the same as an .ipynb file with
outputs, which `make notebooks` writes: it runs a notebook whose code has changed. The site shows
those outputs and runs nothing.
"""

import argparse
import base64
import configparser
import contextlib
import io
import json
import os
import re
import tempfile
import time
from pathlib import Path
from typing import Any

NOTEBOOKS = Path(__file__).resolve().parent / "notebooks"
SETTINGS = NOTEBOOKS.parent.parent / "setup.cfg"
GITHUB = "https://github.com/"
UNKNOWN = f"{GITHUB}OWNER/REPOSITORY"
CELL = re.compile(r"^# %%([^\n]*)\n(.*?)(?=^# %%|\Z)", flags=re.DOTALL | re.MULTILINE)
# The first code cell of an .ipynb: on Colab the package must be installed first.
INSTALL = """\
import sys

if "google.colab" in sys.modules:
    !git clone --quiet --depth 1 {address} sb3_quad
    %pip install --quiet ./sb3_quad"""
# Colours of a stored plot; with all of them a file would be three times as large.
PALETTE = 64


def append_notebook(app: Any, page: str, source: list[str]) -> None:
    """Append the cells of the notebook of the same name to a page, which has its title already."""
    path = Path(app.srcdir, f"{page}.ipynb")
    if path.is_file():
        notebook = json.loads(path.read_text(encoding="utf-8"))
        _, _, without_title = markdown_of(notebook).partition("\n")
        source[0] += f"{colab_link(path.name)}\n\n{without_title}"


def repository_address() -> str:
    """Return the address of the repository, which setup.cfg has once there is one."""
    settings = configparser.ConfigParser()
    settings.read(SETTINGS, encoding="utf-8")
    return settings["metadata"].get("url", UNKNOWN)


def colab_link(name: str) -> str:
    """Return a sentence with a link to Colab, which opens notebooks of GitHub."""
    address = repository_address()
    if address == UNKNOWN or not address.startswith(GITHUB):
        return ""
    colab = f"https://colab.research.google.com/github/{address.removeprefix(GITHUB)}"
    return (
        f"\n[Open it in Colab]({colab}/blob/main/docs/notebooks/{name}): it installs the package."
    )


def markdown_of(notebook: dict[str, Any]) -> str:
    """Convert the cells to Markdown, each code cell followed by its output."""
    parts = []
    for cell in notebook["cells"]:
        text = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(text)
            continue
        tags = cell["metadata"].get("tags", [])
        if "install" in tags:
            continue
        code = f"```python\n{text}\n```"
        if "hide-input" in tags:
            code = f"<details><summary>Show the code of the plot</summary>\n\n{code}\n\n</details>"
        parts.append(code)
        for output in cell["outputs"]:
            if output["output_type"] == "stream":
                parts.append(f"```text\n{''.join(output['text']).rstrip()}\n```")
            else:
                data = output["data"]["image/png"]
                parts.append(f'<img alt="plot" src="data:image/png;base64,{data}">')
    return "\n\n".join(parts)


def cells_of(text: str) -> list[dict[str, Any]]:
    """Return the cells of a .py file as Jupyter has them, without outputs."""
    cells = []
    for head, body in CELL.findall(text):
        cell: dict[str, Any] = {"id": f"cell-{len(cells)}", "metadata": {}}
        if "[markdown]" in head:
            cell["cell_type"] = "markdown"
            body = re.sub(r"^# ?", "", body.strip(), flags=re.MULTILINE)
        else:
            cell |= {"cell_type": "code", "execution_count": None, "outputs": []}
            tags = re.search(r"tags=(\[.*\])", head)
            if tags:
                cell["metadata"]["tags"] = json.loads(tags[1])
        cell["source"] = body.strip().splitlines(keepends=True)
        cells.append(cell)
    return cells


def make_notebook(path: Path, rerun: bool) -> None:
    """Write the .ipynb file of a .py file.

    :param rerun: also run a notebook whose code is that of the .ipynb file.
    """
    target = path.with_suffix(".ipynb")
    cells = cells_of(path.read_text(encoding="utf-8"))
    codes = [cell for cell in cells if cell["cell_type"] == "code"]
    before = []
    if target.is_file():
        for cell in json.loads(target.read_text(encoding="utf-8"))["cells"]:
            if "outputs" in cell and "install" not in cell["metadata"].get("tags", []):
                before.append(cell)
    if rerun or [cell["source"] for cell in before] != [cell["source"] for cell in codes]:
        run(codes, path)
    else:
        for cell, old in zip(codes, before, strict=True):
            cell["outputs"] = old["outputs"]

    install = INSTALL.format(address=repository_address())
    cells.insert(
        1,
        {
            "cell_type": "code",
            "execution_count": None,
            "id": "install",
            "metadata": {"tags": ["install"]},
            "outputs": [],
            "source": install.splitlines(keepends=True),
        },
    )
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    notebook = {
        "cells": cells,
        "metadata": {"kernelspec": kernel, "language_info": {"name": "python"}},
        "nbformat": 4,
        "nbformat_minor": 5,
    }
    text = json.dumps(notebook, indent=1, ensure_ascii=False, sort_keys=True)
    target.write_text(f"{text}\n", encoding="utf-8")


def run(codes: list[dict[str, Any]], path: Path) -> None:
    """Run the code cells of a notebook, and keep in them what they print and plot."""
    import matplotlib.pyplot as plt

    scope: dict[str, object] = {"__name__": "notebook"}
    start = time.process_time()
    with contextlib.ExitStack() as stack:
        stack.enter_context(plt.rc_context())
        # Notebooks write files.
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        stack.callback(os.chdir, os.getcwd())
        os.chdir(folder)
        stack.callback(setattr, plt, "show", plt.show)
        pictures: list[str] = []
        plt.show = lambda: pictures.append(drawn(plt))
        for cell in codes:
            pictures.clear()
            printed = io.StringIO()
            with contextlib.redirect_stdout(printed):
                exec(compile("".join(cell["source"]), path.name, "exec"), scope)
            cell["outputs"] = []
            if printed.getvalue():
                text = printed.getvalue().splitlines(keepends=True)
                cell["outputs"].append({"output_type": "stream", "name": "stdout", "text": text})
            for picture in pictures:
                output = {"output_type": "display_data", "metadata": {}}
                cell["outputs"].append(output | {"data": {"image/png": picture}})
    print(f"{path.name}: {time.process_time() - start:.0f} CPU s")


def drawn(plt: Any) -> str:
    """Return the present plot as a PNG file in base64, and close it."""
    from PIL import Image

    picture = io.BytesIO()
    plt.savefig(picture, format="png")
    plt.close("all")
    small = io.BytesIO()
    Image.open(picture).convert("RGB").quantize(PALETTE, dither=Image.Dither.NONE).save(
        small, format="png", optimize=True
    )
    return base64.b64encode(small.getvalue()).decode()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Run the notebooks whose code has changed.")
    parser.add_argument("notebooks", nargs="*", help="names, such as robustness (all)")
    parser.add_argument("--rerun", action="store_true", help="run those that are the same, too")
    options = parser.parse_args()
    for file in sorted(NOTEBOOKS.glob("*.py")):
        if not options.notebooks or file.stem in options.notebooks:
            make_notebook(file, options.rerun)
