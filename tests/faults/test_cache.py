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

from sb3_quad.simulation import cache
from sb3_quad.simulation.compiled import compiled

ROOT = Path(__file__).resolve().parents[2]


def double(x):
    return 2 * x


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    cache._tell.cache_clear()
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
    "last byte": lambda path: path.write_bytes(path.read_bytes()[:-1]),
    "text": lambda path: path.write_bytes(b"not what was written here\n" * 20),
    "zeros": lambda path: path.write_bytes(bytes(path.stat().st_size)),
    "first bit": lambda path: path.write_bytes(flip(path.read_bytes(), 0)),
    "bit in the middle": lambda path: path.write_bytes(flip(path.read_bytes(), path.stat().st_size // 2)),
    "last bit": lambda path: path.write_bytes(flip(path.read_bytes(), -1)),
    "missing": lambda path: path.unlink(),
    "another's": lambda path: path.write_bytes(path.read_bytes()[::-1]),
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
    assert all(str(path) in line and "damaged" in line for line in said) and len(said) <= 1
    cache._tell.cache_clear()
    third = compiled(double)
    assert third(3.0) == 6.0 and sum(third.stats.cache_hits.values()) == 1
    assert capfd.readouterr().err == ""


def test_whole_files_are_used(folder):
    assert compiled(double)(3.0) == 6.0
    again = compiled(double)
    assert again(3.0) == 6.0
    assert sum(again.stats.cache_hits.values()) == 1 and not again.stats.cache_misses


def test_a_file_that_cannot_be_written_is_done_without(folder, capfd):
    assert compiled(double)(3.0) == 6.0
    path = one_file(folder, "nbi")
    path.unlink()
    path.mkdir()
    assert compiled(double)(3.0) == 6.0
    assert "cannot be kept" in capfd.readouterr().err


def first_call(barrier, hits):
    function = compiled(double)
    barrier.wait()
    with cache.compiled_by_one(function):
        assert function(3.0) == 6.0
    hits.put(sum(function.stats.cache_hits.values()))


def test_of_processes_that_start_together_one_compiles(folder):
    context = multiprocessing.get_context("fork")
    barrier, hits = context.Barrier(3), context.Queue()
    processes = [context.Process(target=first_call, args=(barrier, hits)) for _ in range(3)]
    for process in processes:
        process.start()
    assert sorted(hits.get(timeout=60) for _ in processes) == [0, 1, 1]
    for process in processes:
        process.join()


CODE = """
import sys
import numpy as np
from sb3_quad.envs import QuadcopterVectorEnv
from sb3_quad.simulation.kernel import _finite
print(_finite(np.zeros((2, 4), np.float32)), sum(_finite.stats.cache_hits.values()))
"""


@pytest.fixture(scope="module")
def read_only_installation(tmp_path_factory):
    """Its folders for compiled code cannot be made, for the superuser either: plain files have their names."""
    root = tmp_path_factory.mktemp("installation")
    for name in ("sb3_quad", "envs", "callbacks", "zoo_configs"):
        shutil.copytree(ROOT / name, root / name, ignore=shutil.ignore_patterns("__pycache__"))
    for package in [path.parent for path in root.rglob("__init__.py")]:
        (package / "__pycache__").write_text("")
    return root


def started(root, **environment):
    inherited = {key: value for key, value in os.environ.items() if not key.startswith(("NUMBA", "XDG", "PYTHON"))}
    command = [sys.executable, "-c", CODE]
    nowhere = {"HOME": "/dev/null", "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run(
        command, cwd=root, env={**inherited, **nowhere, **environment}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.split(), done.stderr.splitlines()


def test_a_read_only_installation_without_a_home_keeps_its_code_in_the_temporary_folder(read_only_installation, tmp_path):
    (finite, hits), said = started(read_only_installation, TMPDIR=str(tmp_path))
    assert (finite, hits) == ("True", "0") and len(said) == 1 and str(tmp_path) in said[0] and "NUMBA_CACHE_DIR" in said[0]
    assert started(read_only_installation, TMPDIR=str(tmp_path))[0] == ["True", "1"]
    better = tmp_path / "better"
    assert started(read_only_installation, TMPDIR=str(tmp_path), NUMBA_CACHE_DIR=str(better))[1] == []
    assert list(better.rglob("*.nbc"))


@pytest.mark.parametrize("taken_by", ["file", "open folder", "link"])
def test_a_temporary_folder_that_others_could_write_is_not_used(read_only_installation, tmp_path, taken_by):
    """What lies in it would be executed."""
    folder, elsewhere = tmp_path / f"sb3_quad-{os.getuid()}", tmp_path / "elsewhere"
    elsewhere.mkdir(mode=0o700)
    if taken_by == "file":
        folder.write_text("")
    elif taken_by == "link":
        folder.symlink_to(elsewhere)
    else:
        folder.mkdir()
        folder.chmod(0o777)
    result, said = started(read_only_installation, TMPDIR=str(tmp_path))
    assert result == ["True", "0"] and len(said) == 1 and "cannot be kept" in said[0]
    assert not list(tmp_path.rglob("*.nb*"))
