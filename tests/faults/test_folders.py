"""Files of a search, an evaluation and a published policy: full disks, interrupts and two processes
at once cost nothing.
"""

import csv
import errno
import os
import platform
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import publish
import pytest
from optuna.distributions import FloatDistribution
from stable_baselines3.common.callbacks import BaseCallback

from sb3_quad.base.errors import ConfigError
from sb3_quad.cli import main
from sb3_quad.evaluation.results import load_results
from sb3_quad.tuning.search import OWNER, NumberedSampler, open_study, retry_dead_trials


def test_a_file_that_is_no_journal_keeps_its_last_line(tmp_path):
    path = tmp_path / "notes.txt"
    path.write_text("buy milk")
    with pytest.raises(ConfigError, match="cannot be used"):
        open_study("search", path)
    assert path.read_text() == "buy milk"


@pytest.mark.parametrize(
    ("process", "dead"),
    [(os.getpid(), False), (2**22 + 1, True)],
    ids=("this process", "no process"),
)
def test_trials_without_a_process_are_tried_again(tmp_path, process, dead):
    study = open_study("search", tmp_path / "study.log")
    study.ask().set_user_attr(OWNER, [platform.node(), process])
    retry_dead_trials(study)
    assert [trial.state.name for trial in study.trials] == (
        ["FAIL", "WAITING"] if dead else ["RUNNING"]
    )


def test_a_trial_that_is_tried_again_moves_no_later_one(tmp_path):
    space = {"gamma": FloatDistribution(0.5, 1.0)}
    whole, killed = (open_study(name, tmp_path / "study.log") for name in ("whole", "killed"))
    whole.sampler, killed.sampler = NumberedSampler("random", 0, 0), NumberedSampler("random", 0, 0)
    wanted = [whole.ask(space).params for _ in range(3)]
    asked = [killed.ask(space) for _ in range(2)]
    asked[1].set_user_attr(OWNER, [platform.node(), 2**22 + 1])
    retry_dead_trials(killed)
    assert [asked[0].params, *(killed.ask(space).params for _ in range(2))] == wanted


class KilledAtSecond(BaseCallback):
    """Kills this process outright in the second training that it is part of, once it has the
    environment variable KILL.
    """

    made = 0

    def _on_training_start(self) -> None:
        KilledAtSecond.made += 1

    def _on_step(self) -> bool:
        if KilledAtSecond.made == 2 and "KILL" in os.environ:
            os.kill(os.getpid(), signal.SIGKILL)
        return True


@pytest.mark.slow
def test_the_trial_of_a_search_that_was_killed_is_tried_again(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    settings = "n_timesteps: 32, n_steps: 32, batch_size: 32, callback: test_folders.KilledAtSecond"
    (tmp_path / "small.yml").write_text(f"Pendulum-v1: {{{settings}}}\n")
    (tmp_path / "space.yml").write_text("gamma: {low: 0.5, high: 1.0}\n")
    command = [
        "tune",
        "--algo",
        "ppo",
        "--env",
        "Pendulum-v1",
        "--conf-file",
        "small.yml",
        "--search-space",
        "space.yml",
    ]
    command += shlex.split(
        "--eval-episodes 1 --n-evaluations 1 --no-progress --storage study.log --sampler random"
    )
    here = Path(__file__).parent
    path = os.pathsep.join(map(str, (here.parents[1], here.parents[1] / "examples", here)))
    environment = {**os.environ, "KILL": "yes", "PYTHONPATH": path}
    killed = subprocess.run(
        [sys.executable, "-m", "sb3_quad.cli", *command], env=environment, check=False
    )
    assert killed.returncode == -signal.SIGKILL
    assert main([*command, "--max-total-trials", "2"]) == 0
    with (tmp_path / "logs/tune/ppo/Pendulum-v1_2/trials.csv").open(encoding="utf-8") as file:
        trials = list(csv.DictReader(file))
    ends = [(trial["state"], trial["error"]) for trial in trials]
    assert ends == [("COMPLETE", ""), ("FAIL", "interrupted"), ("COMPLETE", "")]
    assert trials[2]["gamma"] == trials[1]["gamma"] != trials[0]["gamma"]


SUITE = """
name: one
source: paper
scenarios: [{name: near, task_kwargs: {target_distance: 1}, duration: 2, n_episodes: 2}]
"""
codes = []


def hover(vehicle):
    return lambda observation: np.zeros((len(observation), 4))


def meanwhile(vehicle):
    """Another evaluation into the same folder, while this one is under way."""
    if not codes:
        codes.append(
            main(
                [
                    "evaluate",
                    "other=test_folders:hover",
                    "--suite",
                    "suite.yaml",
                    "-o",
                    "out",
                    "--no-report",
                ]
            )
        )
    return hover(vehicle)


def test_of_two_evaluations_into_a_folder_at_once_neither_loses_its_results(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "suite.yaml").write_text(SUITE)
    codes.clear()
    command = [
        "evaluate",
        "first=test_folders:meanwhile",
        "--suite",
        "suite.yaml",
        "-o",
        "out",
        "--no-report",
    ]
    codes.append(main(command))
    there = {entry.controller for entry in load_results("out").entries}
    assert there == {
        name for name, code in zip(("other", "first"), codes, strict=True) if code == 0
    }
    refused = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    assert len(refused) == codes.count(2) and all("another process" in line for line in refused)


def interrupted(*arguments, **settings):
    raise KeyboardInterrupt


def disk_full(*arguments, **settings):
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize(("fault", "code"), [(interrupted, 130), (disk_full, 2)])
def test_publish_replaces_both_the_zip_and_its_card_or_neither(tmp_path, monkeypatch, fault, code):
    command = ["--name", "mine", "-o", str(tmp_path), "--episodes", "1"]
    assert publish.main(["itm-imitation", *command]) == 0
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    assert len(before) == 2
    monkeypatch.setattr(publish, "measure" if code == 130 else "write_card", fault)
    assert publish.main(["itm-recovery", *command, "--overwrite"]) == code
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before
