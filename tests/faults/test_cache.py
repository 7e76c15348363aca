"""Compiled code: kept where it can be, and nothing fails where it cannot."""

import importlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from sb3_quad.base import compiled
from sb3_quad.envs.simulation import kernel

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
    ("changed", "recompiled", "kept"),
    [
        ("envs.simulation.reward", ["envs.simulation.kernel"], ["envs.simulation.sampling"]),
        ("envs.vehicles.vehicle", ["envs.simulation.kernel", "envs.simulation.sampling"], []),
        ("fast.losses", ["fast.kernel"], ["envs.simulation.kernel", "experts.geometric_law"]),
        ("envs.simulation.physics", ["envs.simulation.kernel", "experts.pid"], ["fast.kernel"]),
    ],
)
def test_a_change_recompiles_what_imports_it_and_nothing_else(
    changed, recompiled, kept, monkeypatch
):
    modules = [f"sb3_quad.{name}" for name in (*recompiled, *kept)]
    for module in modules:
        importlib.import_module(module)
    stamp = compiled._source_stamp.__wrapped__
    read = compiled._read
    before = {module: stamp(module) for module in modules}

    def read_changed(module):
        source, imports = read(module)
        return source + b"#" * (module == f"sb3_quad.{changed}"), imports

    monkeypatch.setattr(compiled, "_read", read_changed)
    differ = [module for module in modules if stamp(module) != before[module]]
    assert differ == modules[: len(recompiled)]


def test_python_cannot_call_what_has_no_entry_for_it():
    with pytest.raises(TypeError, match="load_rows: only compiled functions"):
        kernel.load_rows(None, 0, None)
