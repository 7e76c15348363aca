"""Sweeps without Ray: which configurations they have, what they refuse, what a run trains and how
runs are compared. test_ray.py has the rest.
"""

import itertools
import json
import re
import shutil
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.nn.utils import parameters_to_vector

from sb3_quad.agents.zips import load_model
from sb3_quad.base import process
from sb3_quad.base.validate import validate
from sb3_quad.cli import main
from sb3_quad.evaluation.statistics import over_seeds
from sb3_quad.training.sweep import (
    SWEEPS,
    Sweep,
    checked_configurations,
    load_sweep,
    train_run,
)
from sb3_quad.training.sweep_results import ROWS, write_results

NET = {
    "n_steps": 20,
    "batch_size": 80,
    "gradient_steps": 2,
    "n_epochs": 1,
    "policy_kwargs": {"net_arch": [4]},
}
TINY = {
    "algo": "dagger",
    "env": "QuadStateRecovery-v0",
    "n_timesteps": 160,
    "n_envs": 4,
    "eval_episodes": 0,
    "hyperparams": NET,
    "evaluation": {"scenario": ["recovery"], "episodes": 4},
}


def sweep(**keys):
    return validate(Sweep, {**TINY, **keys}, "test")


def settings(configuration):
    """The settings of a configuration's only stage."""
    pipeline, _ = configuration.plan()
    return pipeline.stages[0].settings


def test_the_configurations_are_the_product_of_list_and_grid():
    found = checked_configurations(
        sweep(
            env_kwargs={"vehicle": "crazyflie"},
            configurations={"Calm air": {"env_kwargs": {"last_action": True}}, "b": {"n_envs": 2}},
            grid={"env_kwargs.noise": [0.0, 0.1]},
        )
    )
    names = ["calm-air,noise=0.0", "calm-air,noise=0.1", "b,noise=0.0", "b,noise=0.1"]
    assert [*found] == names
    calm, _, _, other = map(settings, found.values())
    assert calm["env_kwargs"] == {"vehicle": "crazyflie", "last_action": True, "noise": 0.0}
    assert (other["n_envs"], other["env_kwargs"]["noise"], other["n_steps"]) == (2, 0.1, 20)


def test_without_ray_it_names_the_extra_to_install(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "ray", None)
    Path("s.yaml").write_text(json.dumps(TINY))
    assert main(["sweep", "s.yaml"]) == 2
    assert "'.[ray]'" in capsys.readouterr().err
    assert not Path("logs").exists()


def test_a_dry_run_lists_the_runs_and_only_a_sweep_of_ones_own_is_resumed(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    Path("s").mkdir()
    Path("s/sweep.yaml").write_text(json.dumps({**TINY, "seed": [3, 4, 3]}))
    assert main(["sweep", "s/sweep.yaml", "--dry-run"]) == 0
    assert capsys.readouterr().out.split() == ["run/seed_3", "run/seed_4"]
    assert main(["sweep", "--resume", "s"]) == 2
    assert "--trust" in capsys.readouterr().err
    # A link in a folder from someone else must not make it write elsewhere.
    Path("s/runs").symlink_to("..")
    assert main(["sweep", "--resume", "s", "--trust"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "s/runs" in line


@pytest.mark.slow
def test_sweeps_of_the_package_have_configurations(trained_runs, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    # One of them starts from this run.
    shutil.copytree(trained_runs("dagger"), "logs/dagger/QuadTargetTracking-v0_1")
    for name in SWEEPS.names():
        assert checked_configurations(load_sweep(name))


def test_a_run_is_what_train_gives_and_is_not_trained_twice(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(process, "_most_cpus", process._most_cpus)
    planned = sweep()
    suite = planned.evaluation.load()
    choice = {"configuration": "run", "seed": 1}
    configurations = checked_configurations(planned)
    work = partial(train_run, tmp_path, configurations, suite, str(tmp_path), choice)
    first = work()
    assert len(first["flights"]["recovery"]["reward"]) == 4
    (agent,) = Path("runs/run/seed_1/dagger").glob("*_1/Quad*.zip")
    content = agent.read_bytes()
    np.testing.assert_equal(work(), first)
    assert agent.read_bytes() == content
    command = ["train", "--algo", "dagger", "--env", TINY["env"], "--seed", "1", "-n", "160"]
    command += ["--n-envs", "4", "--eval-episodes", "0", "--num-threads", "1", "--no-progress"]
    assert main([*command, "--hyperparams", *(f"{k}:{v}" for k, v in NET.items())]) == 0
    (alone,) = Path("logs/dagger").glob("*_1/Quad*.zip")
    agents = [load_model(path).policy.parameters() for path in (agent, alone)]
    assert torch.equal(*map(parameters_to_vector, agents))


def test_the_table_has_means_over_seeds(tmp_path):
    random = np.random.default_rng(0)
    flights = {}
    for mean, seed in itertools.product((0, 1), (0, 1, 2)):
        # Ray stores NaN as null.
        values = [*random.normal(mean, 0.3, 60), None]
        flights[f"mean-{mean}", seed] = {"hover": dict.fromkeys(ROWS, values)}
    table = write_results(tmp_path, flights)
    _, *cells = table.rows[2]
    numbers = [[float(each) for each in re.findall(r"\d\.\d+", cell)] for cell in cells]
    assert numbers[0][2] < 0.3 and 0.7 < numbers[1][1] < numbers[1][0] < numbers[1][2]
    lines = (tmp_path / "results.csv").read_text().splitlines()
    assert len(lines) == 7 and lines[0].startswith("configuration,seed,scenario,success")


def test_intervals_hold_the_truth_about_as_often_as_they_say():
    random = np.random.default_rng(1)
    held = 0
    for _ in range(60):
        interval = over_seeds(random.normal(0, 0.5, (10, 1)) + random.normal(size=(10, 40)))
        held += interval.low < 0 < interval.high
    assert held >= 48
    assert over_seeds(np.full((2, 5), np.nan)) is None
