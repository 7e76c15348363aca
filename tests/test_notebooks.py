"""The notebooks of docs/notebooks run from top to bottom.

Episodes are few and short, and each training has one rollout.
"""

import re
from pathlib import Path

import matplotlib.pyplot as plt
import pytest

from sb3_quad.simulation.settings import FlightSettings

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
        "sb3_quad.algorithms.offset_correction.correct_offset", lambda *arguments: None
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
