"""Processes that end, or cannot be waited for: no command hangs, none is left behind, and the
others go on.
"""

import os
import signal
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from stable_baselines3.common.callbacks import BaseCallback

from sb3_quad.cli import main
from sb3_quad.evaluation.results import load_results

ROOT = Path(__file__).parents[2]
SUITE = """
name: one
source: paper
scenarios: [{name: near, task_kwargs: {target_distance: 1}, duration: 2, n_episodes: 2}]
"""


class KillLastWorker(BaseCallback):
    """Kills the last process of the environments, as the kernel does where memory ends, and notes
    all of them.
    """

    processes = ()

    def _on_step(self) -> bool:
        if self.num_timesteps == 42:
            KillLastWorker.processes = self.training_env.unwrapped.processes
            os.kill(self.processes[-1].pid, signal.SIGKILL)
        return True


def train(folder, settings, options):
    """A command that trains PPO on Pendulum."""
    file = folder / "settings.yml"
    file.write_text(f"Pendulum-v1: {{{settings}}}")
    command = f"train --algo ppo --env Pendulum-v1 -f {folder} --conf-file {file} --no-progress"
    return [*command.split(), *options.split()]


@pytest.mark.slow
@pytest.mark.timeout(100)
def test_a_training_whose_worker_dies_ends_saves_and_leaves_none_behind(tmp_path, capsys):
    settings = "n_steps: 10, batch_size: 30, n_envs: 3, callback: test_workers.KillLastWorker"
    assert main(train(tmp_path, settings, "--vec-env subproc -n 6000 --eval-episodes 0")) == 2
    assert "worker process of the environments ended" in capsys.readouterr().err.splitlines()[-1]
    assert (tmp_path / "ppo" / "Pendulum-v1_1" / "Pendulum-v1.zip").is_file()
    assert len(KillLastWorker.processes) == 3 and not any(
        process.is_alive() for process in KillLastWorker.processes
    )


def hover(vehicle):
    return lambda observation: np.zeros((len(observation), 4))


def exits(vehicle):
    sys.exit(0)


class DropsInfo(gymnasium.Wrapper):
    """A wrapper that keeps what Monitor adds to itself."""

    def step(self, action):
        *outcome, _ = self.env.step(action)
        return *outcome, {}


@pytest.mark.timeout(100)
def test_evaluations_that_would_never_end_say_why(tmp_path, capsys):
    settings = "n_steps: 10, batch_size: 10, vec_env: dummy, env_wrapper: test_workers.DropsInfo"
    assert main(train(tmp_path, settings, "-n 20 --eval-freq 10 --eval-episodes 1")) == 2
    assert "info['episode']" in capsys.readouterr().err.splitlines()[-1]


def test_a_controller_that_exits_is_a_failure_and_the_others_fly(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("suite.yaml").write_text(SUITE)
    command = ["evaluate", "bad=test_workers:exits", "hover=test_workers:hover"]
    assert main([*command, "--suite", "suite.yaml", "-o", "out", "--no-report"]) == 1
    assert [entry.controller for entry in load_results("out").entries] == ["hover"]
    assert "failed: bad" in capsys.readouterr().err
