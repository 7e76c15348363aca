"""Every command's help fits a terminal, and a misspelt name is guessed."""

import importlib.util
import os
import re
import shutil
import subprocess
import sys
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


def test_help_is_coloured_where_colours_are_wanted_and_keeps_brackets(monkeypatch, capsys):
    monkeypatch.setenv("FORCE_COLOR", "1")
    main(["evaluate", "--help"])
    coloured = capsys.readouterr().out
    monkeypatch.delenv("FORCE_COLOR")
    monkeypatch.setenv("NO_COLOR", "1")
    main(["evaluate", "--help"])
    plain = capsys.readouterr().out
    assert "\x1b[" in coloured and re.sub(r"\x1b\[[\d;]*m", "", coloured) == plain


def test_a_shell_is_told_how_a_word_may_end(tmp_path):
    """As bash asks; the answer must come before anything else is printed."""
    line, answer = "sb3-quad evaluate --sui", tmp_path / "words"
    asks = {"_ARGCOMPLETE": "1", "COMP_LINE": line, "COMP_POINT": str(len(line))}
    asks |= {"_ARGCOMPLETE_STDOUT_FILENAME": str(answer), "IFS": "\013"}
    code = "from sb3_quad.cli import main; main()"
    subprocess.run([sys.executable, "-c", code], env={**os.environ, **asks}, check=True)
    assert answer.read_text().strip() == "--suite"


def test_the_doctor_names_what_is_missing(monkeypatch, capsys):
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == "optuna" else find(name)
    )
    monkeypatch.setattr(shutil, "which", lambda name: None)
    assert main(["doctor"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert any(line.startswith("extras") and "without tune" in line for line in lines)
    assert any(line.startswith("compilers") and "apt install" in line for line in lines)


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
