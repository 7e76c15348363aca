"""Every command's help fits a terminal, and a misspelt name is guessed."""

from pathlib import Path

import pytest

from sb3_quad.base.errors import did_you_mean
from sb3_quad.cli import main
from sb3_quad.cli.app import COMMANDS

README = (Path(__file__).parent.parent / "README.md").read_text()


@pytest.mark.parametrize("name", ["", *COMMANDS])
def test_help_fits_a_terminal_of_80_columns(name, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "80")
    assert main([*name.split(), "--help"]) == 0
    lines = capsys.readouterr().out.splitlines()
    # argparse does not break a group of flags that exclude each other.
    assert [line for line in lines if len(line) > 80 and " | " not in line] == []
    assert f"`sb3-quad {name}" in README


TASKS = ("far_tracking", "state_recovery", "target_tracking")


@pytest.mark.parametrize(
    ("given", "valid", "meant"),
    [
        ("state_recovry", TASKS, ["state_recovery"]),
        ("hover", TASKS, []),
        ("Learning_Rtae", ("learning_rate",), ["learning_rate"]),
        ("reference.yml", ("thesis/reference.yml", "dagger.yml"), ["thesis/reference.yml"]),
        ("", TASKS, []),
        ("anything", (), []),
    ],
)
def test_a_misspelt_name_is_guessed_and_nothing_else(given, valid, meant):
    assert did_you_mean(given, valid) == (
        f"did you mean {' or '.join(map(repr, meant))}? " if meant else ""
    )
