"""Run folders: no two runs share one, files are whole or absent, and a run can be read again."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import write_bytes, write_text
from sb3_quad.training.runs import claim_run, find_run, open_run

ENV = "QuadTargetTracking-v0"


def test_runs_are_numbered_and_never_reused(tmp_path):
    first, second = (claim_run(tmp_path, "dagger", ENV) for _ in range(2))
    assert [run.path.name for run in (first, second)] == [f"{ENV}_1", f"{ENV}_2"]
    (tmp_path / "dagger" / f"{ENV}_7").mkdir()
    (tmp_path / "dagger" / f"{ENV}_notes").mkdir()
    assert claim_run(tmp_path, "dagger", ENV).path.name == f"{ENV}_8"
    assert claim_run(tmp_path, "ppo", ENV).path.name == f"{ENV}_1"


def test_a_run_whose_start_alone_was_evaluated_has_not_begun(tmp_path):
    run = claim_run(tmp_path, "apg", ENV)
    assert run.not_begun
    run.best_model.touch()
    for timesteps, expected in (([0], True), ([0, 400], False)):
        np.savez(run.evaluations, timesteps=timesteps)
        assert run.not_begun == expected


def test_the_latest_run_is_the_latest_with_an_agent(tmp_path):
    first, empty = (claim_run(tmp_path, "dagger", ENV) for _ in range(2))
    assert find_run(tmp_path, "dagger", ENV).path == empty.path
    first.model.write_bytes(b"")
    assert find_run(tmp_path, "dagger", ENV).path == first.path
    assert find_run(tmp_path, "dagger", ENV, 2).path == empty.path


@pytest.mark.slow
def test_processes_and_threads_never_share_a_folder(tmp_path):
    code = (
        "import sys\nfrom sb3_quad.training.runs import claim_run\n"
        f"for _ in range(40): print(claim_run(sys.argv[1], 'dagger', '{ENV}').path.name)"
    )
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE, text=True
        )
        for _ in range(2)
    ]
    with ThreadPoolExecutor(4) as pool:
        claimed = [
            run.path.name
            for run in pool.map(lambda _: claim_run(tmp_path, "dagger", ENV), range(40))
        ]
    for process in processes:
        claimed += process.communicate(timeout=60)[0].split()
        assert process.returncode == 0
    assert len(claimed) == len(set(claimed)) == 120


def test_environment_ids_with_slashes_stay_in_their_folder(tmp_path):
    run = claim_run(tmp_path, "ppo", "package:ALE/Pong-v5")
    assert run.path.parent == tmp_path / "ppo"
    assert run.model.parent == run.path


def test_settings_and_arguments_come_back(tmp_path):
    run = claim_run(tmp_path, "dagger", ENV)
    settings, arguments = {"n_envs": 3}, {"seed": 7, "initial_policy": None}
    run.write_yaml(settings, arguments)
    # Who has args.yml lacks nothing.
    times = [path.stat().st_mtime_ns for path in (run.config, run.arguments)]
    assert max(times) == times[-1]
    assert vars(open_run(run.path)) == vars(run)
    assert run.read_yaml() == (settings, arguments)
    run.arguments.write_text("- no mapping")
    with pytest.raises(ConfigError, match=r"args\.yml"):
        run.read_yaml()


def test_files_are_replaced_whole(tmp_path, monkeypatch):
    path = tmp_path / "file.txt"
    write_text(path, "old")

    def full(*args):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(ConfigError, match="No space left"):
        write_bytes(path, b"new")
    assert path.read_text() == "old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["file.txt"]


def test_a_device_or_pipe_is_not_replaced_by_a_file(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with pytest.raises(ConfigError, match="pipe"):
        write_text(pipe, "text")
    assert pipe.is_fifo()
