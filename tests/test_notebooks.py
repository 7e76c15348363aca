"""The notebooks of docs/notebooks run from top to bottom.

Episodes are few and short, and each training has one rollout.
"""

import importlib.util
import json
import re
from pathlib import Path

import matplotlib.pyplot as plt
import pytest

from sb3_quad.envs.simulation.settings import FlightSettings

FOLDER = Path(__file__).resolve().parent.parent / "docs" / "notebooks"
NOTEBOOKS = {path.stem: path for path in sorted(FOLDER.glob("*.py"))}
PARAMETERS = re.compile(
    r'(?<=^# %% tags=\["parameters"\]\n).*?(?=^# %%)', flags=re.DOTALL | re.MULTILINE
)


def shortened(text):
    """Replace each number in the cell of parameters (papermill's) by 2."""
    (cell,) = PARAMETERS.findall(text)
    return text.replace(cell, re.sub(r"(?m)^([A-Z]+) = [\d_]+", r"\1 = 2", cell))


@pytest.mark.slow
@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_notebook_runs(name, tmp_path, monkeypatch):
    text = NOTEBOOKS[name].read_text(encoding="utf-8")
    drawn = []

    def show():
        plt.gcf().draw_without_rendering()
        drawn.append(plt.gcf())
        plt.close("all")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(plt, "show", show)
    monkeypatch.setattr(FlightSettings, "longest_episode", 100)
    # An offset can be corrected only if the agent flies; after one rollout it does not.
    monkeypatch.setattr(
        "sb3_quad.evaluation.offset_correction.correct_offset", lambda *arguments: None
    )
    with plt.rc_context():
        exec(compile(shortened(text), str(NOTEBOOKS[name]), "exec"), {"__name__": name})
    assert drawn and all(figure.axes for figure in drawn)


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_notebook_is_in_jupytexts_form(name):
    """The head names form and kernel, the first cell is the title; the numbers can be shortened."""
    text = NOTEBOOKS[name].read_text(encoding="utf-8")
    _, head, cells = text.split("# ---\n", 2)
    assert "format_name: percent" in head and "name: python3" in head
    assert cells.startswith("\n# %% [markdown]\n# # ")
    (numbers,) = PARAMETERS.findall(shortened(text))
    assert re.fullmatch(r"(([A-Z]+) = 2 .*\n)+\n", numbers)


@pytest.fixture(scope="module")
def pages():
    """The module that writes the notebooks with their outputs, and shows them on the site."""
    spec = importlib.util.spec_from_file_location(
        "notebook_pages", FOLDER.parent / "notebook_pages.py"
    )
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_stored_outputs_are_those_of_the_present_cells(name, pages):
    """``make notebooks`` writes them. Jupyter and Colab open the file."""
    stored = json.loads(NOTEBOOKS[name].with_suffix(".ipynb").read_text(encoding="utf-8"))
    assert (stored["nbformat"], stored["nbformat_minor"]) == (4, 5)
    title, install, *rest = stored["cells"]
    assert install["metadata"]["tags"] == ["install"]
    expected = pages.cells_of(NOTEBOOKS[name].read_text(encoding="utf-8"))
    assert [cell["source"] for cell in [title, *rest]] == [cell["source"] for cell in expected]
    shown = pages.markdown_of(stored)
    assert "data:image/png" in shown and "google.colab" not in shown


def test_a_notebook_is_run_only_if_its_code_has_changed(pages, tmp_path):
    source = tmp_path / "small.py"
    cells = "# %% [markdown]\n# # Small\n\n# %%\nprint('{}')\n"

    def printed(text, rerun=False):
        source.write_text(cells.format(text))
        pages.make_notebook(source, rerun)
        (*_, last) = json.loads(source.with_suffix(".ipynb").read_text())["cells"]
        return last["outputs"][0]["text"]

    assert printed("one") == ["one\n"]
    stored = source.with_suffix(".ipynb")
    stored.write_text(stored.read_text().replace('one\\n"', 'kept\\n"'))
    assert printed("one") == ["kept\n"]
    assert printed("one", rerun=True) == ["one\n"]
    assert printed("two") == ["two\n"]


def test_a_page_links_to_colab_once_the_repository_has_an_address(pages, tmp_path, monkeypatch):
    settings = tmp_path / "setup.cfg"
    monkeypatch.setattr(pages, "SETTINGS", settings)
    settings.write_text("[metadata]\nname = sb3_quad\n")
    assert pages.colab_link("x.ipynb") == ""
    settings.write_text("[metadata]\nurl = https://github.com/me/quad\n")
    link = "https://colab.research.google.com/github/me/quad/blob/main/docs/notebooks/x.ipynb"
    assert f"({link})" in pages.colab_link("x.ipynb")
    settings.write_text("[metadata]\nurl = https://example.org/me/quad\n")
    assert pages.colab_link("x.ipynb") == ""
