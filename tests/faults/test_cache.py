"""Compiled code: kept where it can be, and nothing fails where it cannot."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from sb3_quad.base import compiled
from sb3_quad.envs.simulation import kernel, sampling
from sb3_quad.fast import kernel as fast_kernel

ROOT = Path(__file__).resolve().parents[2]


CODE = """
import numpy as np
from sb3_quad.envs.simulation.physics import rotation_rows
print(rotation_rows(1.0, 0.0, 0.0, 0.0)[0], sum(rotation_rows.stats.cache_hits.values()))
"""


@pytest.mark.slow
def test_a_read_only_installation_without_a_home_says_that_it_compiles_at_every_start(tmp_path):
    """Its folders for compiled code cannot be made, for the superuser either: plain files have
    their names.
    """
    # As installed: the checkout's finder would give its own otherwise.
    places = {"sb3_quad": "sb3_quad"}
    places |= {name: f"sb3_quad/{name}" for name in ("envs", "callbacks", "zoo_configs")}
    for name, place in places.items():
        shutil.copytree(ROOT / name, tmp_path / place, ignore=shutil.ignore_patterns("__pycache__"))
    for package in [path.parent for path in tmp_path.rglob("__init__.py")]:
        (package / "__pycache__").write_text("")

    def started(**environment):
        inherited = {
            key: value
            for key, value in os.environ.items()
            if not key.startswith(("NUMBA", "XDG", "PYTHON"))
        }
        environment = {
            **inherited,
            "HOME": "/dev/null",
            "PYTHONDONTWRITEBYTECODE": "1",
            **environment,
        }
        command = [sys.executable, "-c", CODE]
        done = subprocess.run(
            command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        return done.stdout, done.stderr.splitlines()

    result, said = started()
    assert result == "(1.0, 0.0, 0.0) 0\n"
    assert len(said) == 1 and "NUMBA_CACHE_DIR" in said[0]
    for hits in (0, 1):
        assert started(NUMBA_CACHE_DIR=str(tmp_path / "better")) == (
            f"(1.0, 0.0, 0.0) {hits}\n",
            [],
        )


@pytest.mark.parametrize(
    ("module", "changed", "recompiles"),
    [
        (kernel, "envs.simulation.reward", True),
        (sampling, "envs.simulation.reward", False),
        (kernel, "fast.kernel", False),
        (fast_kernel, "fast.losses", True),
        (fast_kernel, "envs.simulation.reward", False),
    ],
)
def test_a_change_recompiles_what_imports_it_and_nothing_else(
    module, changed, recompiles, monkeypatch
):
    stamp = compiled._source_stamp.__wrapped__
    read = compiled._read

    def read_changed(name):
        source, imports = read(name)
        return source + b"#" * (name == f"sb3_quad.{changed}"), imports

    before = stamp(module.__name__)
    monkeypatch.setattr(compiled, "_read", read_changed)
    assert (stamp(module.__name__) != before) == recompiles


def test_python_cannot_call_what_has_no_entry_for_it():
    with pytest.raises(TypeError, match="load_rows: only compiled functions"):
        kernel.load_rows(None, 0, None)
