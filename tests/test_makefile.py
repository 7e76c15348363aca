"""What `make` does to environments, with a Python in them that only notes what it is asked for."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest
from hypothesis import settings

ROOT = Path(__file__).resolve().parent.parent
FILES = ("Makefile", "setup.cfg", "pyproject.toml", "constraints.txt")

pytestmark = pytest.mark.skipif(shutil.which("make") is None, reason="there is no make here")


@pytest.fixture
def clones(tmp_path):
    """Two clones, the first with an environment, and the file in which its Python notes what it installs."""
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
        for file in FILES:
            shutil.copy(ROOT / file, tmp_path / name / file)
    noted = tmp_path / "noted"
    python = tmp_path / "first" / ".venv" / "bin" / "python"
    python.parent.mkdir(parents=True)
    python.write_text(f'#!/bin/sh\ncase "$*" in *--editable*) pwd >>{noted} ;; esac\n')
    python.chmod(0o755)
    return tmp_path / "first", tmp_path / "second", noted


def make(folder, *arguments):
    environment = {key: value for key, value in os.environ.items() if key not in ("MAKEFLAGS", "MAKELEVEL", "VENV")}
    command = ["make", "install", *arguments]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=True).stdout


def test_the_environment_of_another_clone_stays_that_clones(clones):
    first, second, noted = clones
    make(first)
    assert noted.read_text().split() == [str(first)]
    os.utime(first / ".venv" / ".installed", (0, 0))  # older than the second clone's setup.cfg
    assert str(first) in make(second, f"VENV={first / '.venv'}")
    assert noted.read_text().split() == [str(first)]
    make(first)
    assert noted.read_text().split() == [str(first)] * 2


def test_an_environment_apart_from_all_clones_is_installed_into(clones):
    first, second, noted = clones
    apart = first.parent / "apart"
    shutil.move(first / ".venv", apart)
    make(second, f"VENV={apart}")
    assert noted.read_text().split() == [str(second)]


def test_the_suite_tries_the_same_examples_every_time_and_fuzz_tries_others():
    assert settings.get_profile("default").derandomize
    assert not settings.get_profile("fuzz").derandomize
