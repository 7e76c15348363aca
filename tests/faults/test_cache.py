"""Compiled code: kept where it can be, made anew where it is damaged, and nothing fails where it can be neither."""

import multiprocessing
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numba
import numpy as np
import pytest

from sb3_quad.simulation import compiled as module
from sb3_quad.simulation.compiled import compiled, first_call

ROOT = Path(__file__).resolve().parents[2]


def double(x):
    return 2 * x


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    module._tell.cache_clear()
    return tmp_path


def flip(data, at):
    at %= len(data)
    return data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :]


def one_file(folder, suffix):
    (path,) = folder.rglob(f"*.{suffix}")
    return path


DAMAGE = {
    "empty": lambda path: path.write_bytes(b""),
    "cut": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    "zeros": lambda path: path.write_bytes(bytes(path.stat().st_size)),
    "bit in the middle": lambda path: path.write_bytes(flip(path.read_bytes(), path.stat().st_size // 2)),
    "missing": lambda path: path.unlink(),
}


@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE)
def test_damaged_files_are_made_anew(folder, capfd, suffix, damage):
    assert compiled(double)(3.0) == 6.0
    path = one_file(folder, suffix)
    damage(path)
    again = compiled(double)
    assert again(3.0) == 6.0 and again(np.arange(3.0)).tolist() == [0.0, 2.0, 4.0]
    said = capfd.readouterr().err.splitlines()
    assert all(str(path.parent) in line and "damaged" in line for line in said) and len(said) <= 1
    module._tell.cache_clear()
    third = compiled(double)
    assert third(3.0) == 6.0 and sum(third.stats.cache_hits.values()) == 1
    assert capfd.readouterr().err == ""


def test_a_file_that_cannot_be_written_is_done_without(folder, capfd):
    assert compiled(double)(3.0) == 6.0
    path = one_file(folder, "nbi")
    path.unlink()
    path.mkdir()
    assert compiled(double)(3.0) == 6.0
    assert "cannot be kept" in capfd.readouterr().err


def call_first(barrier, hits):
    function = compiled(double)
    barrier.wait()
    with first_call(function):
        assert function(3.0) == 6.0
    hits.put(sum(function.stats.cache_hits.values()))


@pytest.mark.slow
def test_of_processes_that_start_together_one_compiles(folder):
    context = multiprocessing.get_context("fork")
    barrier, hits = context.Barrier(3), context.Queue()
    processes = [context.Process(target=call_first, args=(barrier, hits)) for _ in range(3)]
    for process in processes:
        process.start()
    assert sorted(hits.get(timeout=60) for _ in processes) == [0, 1, 1]
    for process in processes:
        process.join()


CODE = """
import numpy as np
from sb3_quad.simulation.physics import rotation_rows
print(rotation_rows(1.0, 0.0, 0.0, 0.0)[0], sum(rotation_rows.stats.cache_hits.values()))
"""


@pytest.mark.slow
def test_a_read_only_installation_without_a_home_says_that_it_compiles_at_every_start(tmp_path):
    """Its folders for compiled code cannot be made, for the superuser either: plain files have their names."""
    for name in ("sb3_quad", "envs", "callbacks", "zoo_configs"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
    for package in [path.parent for path in tmp_path.rglob("__init__.py")]:
        (package / "__pycache__").write_text("")

    def started(**environment):
        inherited = {key: value for key, value in os.environ.items() if not key.startswith(("NUMBA", "XDG", "PYTHON"))}
        environment = {**inherited, "HOME": "/dev/null", "PYTHONDONTWRITEBYTECODE": "1", **environment}
        command = [sys.executable, "-c", CODE]
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout, done.stderr.splitlines()

    result, said = started()
    assert result == "(1.0, 0.0, 0.0) 0\n" and len(said) == 1 and "cannot be kept" in said[0] and "NUMBA_CACHE_DIR" in said[0]
    for hits in (0, 1):
        assert started(NUMBA_CACHE_DIR=str(tmp_path / "better")) == (f"(1.0, 0.0, 0.0) {hits}\n", [])
