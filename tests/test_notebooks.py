"""The notebooks of docs/notebooks run from top to bottom, with short trainings and few episodes."""

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
    drawn = []

    def show():
        drawn.append(plt.gcf())
        plt.close("all")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(plt, "show", show)
    monkeypatch.setattr(FlightSettings, "longest_episode", 100)
    # An offset can be corrected only if the agent flies; after one rollout it does not.
    monkeypatch.setattr(
        "sb3_quad.evaluation.offset_correction.correct_offset", lambda *arguments: None
    )
    code = shortened(NOTEBOOKS[name].read_text(encoding="utf-8"))
    with plt.rc_context():
        exec(compile(code, str(NOTEBOOKS[name]), "exec"), {"__name__": name})
    assert drawn
