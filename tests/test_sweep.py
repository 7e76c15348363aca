"""Sweeps: what they expand to, what they refuse, and that nothing of them is lost; trainings of a few hundred timesteps."""

import itertools
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3.common.callbacks import BaseCallback

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.validate import validate
from sb3_quad.cli import main
from sb3_quad.executors import as_completed, start_executor
from sb3_quad.sweep.expand import expand
from sb3_quad.sweep.folder import SweepFolder
from sb3_quad.sweep.run import digest
from sb3_quad.sweep.spec import SWEEPS, SweepSpec, load_sweep
from sb3_quad.sweep.statistics import compare, over_seeds

ROOT = Path(__file__).resolve().parent.parent
NET = {"n_steps": 20, "batch_size": 80, "gradient_steps": 2, "n_epochs": 1, "policy_kwargs": {"net_arch": [4]}}
TINY = {
    "algo": "dagger",
    "env": "QuadStateRecovery-v0",
    "n_timesteps": 160,
    "n_envs": 4,
    "eval_episodes": 0,
    "hyperparams": NET,
}


class Fails(BaseCallback):
    """Ends the training of noisy environments."""

    def _on_step(self):
        if self.training_env.unwrapped.batch.noise_level.max() > 0.4:
            raise ValueError("too noisy")
        return True


class Slow(BaseCallback):
    """Takes its time, and tells that it has begun."""

    def _on_rollout_start(self):
        Path(f"{os.getpid()}.begun").touch()
        time.sleep(0.5)

    def _on_step(self):
        return True


def spec(**keys):
    return validate(SweepSpec, {**TINY, "evaluation": {"episodes": 4}, **keys}, "test")


def write(path, **keys):
    path.write_text(json.dumps({**TINY, "evaluation": {"episodes": 4}, **keys}))
    return str(path)


@given(
    noise=st.lists(st.sampled_from([0, 0.05, 0.1, 0.2]), min_size=1, max_size=3, unique=True),
    rate=st.lists(st.sampled_from([1e-3, 2e-3]), min_size=1, max_size=2, unique=True),
    seeds=st.lists(st.integers(0, 99), min_size=1, max_size=3, unique=True),
)
def test_the_runs_are_the_product_of_grid_and_seeds(noise, rate, seeds):
    runs = expand(spec(seed=seeds, grid={"env_kwargs.noise": noise, "hyperparams.learning_rate": rate}))
    found = [(run.settings["env_kwargs"]["noise"], run.settings["learning_rate"], run.seed) for run in runs]
    assert found == list(itertools.product(noise, rate, seeds))
    assert len({run.name for run in runs}) == len(runs)
    assert all(re.fullmatch(r"[\w.=,+-]+/seed_\d+", run.name) for run in runs)


def test_entries_of_a_list_have_their_names_and_inherit():
    own = [{"name": "calm", "env_kwargs": {"noise": 0}}, {"hyperparams": {"n_epochs": 2}}]
    calm, other = expand(spec(configurations=own))
    assert calm.name == "calm/seed_0" and calm.settings["env_kwargs"]["noise"] == 0 and calm.settings["n_epochs"] == 1
    assert other.settings["n_epochs"] == 2 and other.settings["n_steps"] == NET["n_steps"]


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"gird": {}}, "did you mean 'grid'"),
        ({"grid": {"algo": []}}, "grid: algo: must be a list of at least one"),
        ({"grid": {"env_kwargs.noise": 0.1}}, "must be a list"),
        ({"grid": {"env_kwarg.noise": [0]}}, "did you mean 'env_kwargs'"),
        ({"grid": {"algo": ["dagger", "ppo"]}}, "'ppo': "),
        ({"grid": {"vehicle": ["itm", "no-such"]}}, "no-such"),
        ({"seed": []}, "seed"),
        ({"seed": -1}, "seed -1"),
        ({"configurations": [{"name": "a"}, {"name": "a"}]}, "two configurations are called 'a'"),
        ({"evaluation": {"suite": "no-such"}}, "no-such"),
        ({"resources": {"num_cpus": -1}}, "num_cpus"),
        ({"algo": None}, "algo is missing"),
    ],
)
def test_bad_input_is_one_line_before_anything_is_trained(tmp_path, monkeypatch, capsys, keys, words):
    monkeypatch.chdir(tmp_path)
    file = write(tmp_path / "s.yaml", **keys)
    if keys == {"algo": None}:
        with pytest.raises(ConfigError, match=words):
            expand(load_sweep(file))
        return
    assert main(["sweep", file]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert words in line
    assert not (tmp_path / "logs").exists()


def test_executors_that_cannot_be_are_one_line(tmp_path, capsys):
    file = write(tmp_path / "s.yaml")
    for flags, words in {
        ("--executor", "rya"): "did you mean 'ray'",
        ("--address", "auto"): "goes with --executor ray",
    }.items():
        assert main(["sweep", file, *flags]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert words in line


def test_a_missing_ray_is_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "ray", None)
    assert main(["sweep", write(tmp_path / "s.yaml"), "--executor", "ray"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "pip install '.[ray]'" in line


def test_dry_run_lists_the_runs(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["sweep", write(tmp_path / "s.yaml", seed=[3, 4], grid={"algo": ["dagger"]}), "--dry-run"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in lines] == ["dagger/seed_3", "dagger/seed_4", "2 runs of 1 configuration"]
    assert [path.name for path in tmp_path.iterdir()] == ["s.yaml"]


@pytest.mark.parametrize("name", SWEEPS.names())
def test_sweeps_of_the_package_expand(name):
    assert {run.seed for run in expand(load_sweep(name))} == {0, 1, 2}


def test_the_slurm_script_is_bash():
    (script,) = re.findall(r"```bash\n(#!/bin/bash\n.*?)```", (ROOT / "docs/sweeps.md").read_text(), flags=re.DOTALL)
    subprocess.run(["bash", "-n"], input=script, text=True, check=True)
    assert "ray symmetric-run" in script


def test_who_is_better_is_known_where_it_is_clear():
    random = np.random.default_rng(0)
    common = random.normal(size=(1, 60))  # some episodes are harder, for all
    low, high = (common + random.normal(shift, 0.3, (3, 60)) for shift in (0.0, 1.0))
    assert (compare(high, low).verdict, compare(low, high).verdict, compare(low, low).verdict) == (
        "better",
        "worse",
        "cannot tell",
    )
    interval = over_seeds(low, "reward")
    assert interval.low < low.mean() < interval.high and interval.value == pytest.approx(low.mean())
    some = np.where(random.random((3, 60)) < 0.5, np.nan, low)
    assert over_seeds(some, "time").value == pytest.approx(np.nanmean(some, axis=1).mean())
    assert over_seeds(some, "final_error").value == pytest.approx(np.nanmedian(some, axis=1).mean())
    assert over_seeds(np.full((2, 5), np.nan), "time") is None


def test_intervals_hold_the_truth_about_as_often_as_they_say():
    random = np.random.default_rng(1)
    held = 0
    for _ in range(60):
        interval = over_seeds(random.normal(0, 0.5, (10, 1)) + random.normal(size=(10, 40)), "reward")
        held += interval.low < 0 < interval.high
    assert held >= 48


def square(number):
    return number * number, os.getpid()


def test_as_completed_hands_out_every_task_once():
    with start_executor("local", 2) as executor:
        tasks = {executor.submit(square, number): number for number in range(5)}
        found = [(tasks[task], task.result()[0]) for task in as_completed(executor)]
        assert sorted(found) == [(number, number * number) for number in range(5)]


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_sweep_gives_what_train_gives_and_names_the_run_that_fails(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), str(Path(__file__).parent)]))
    keys = {"hyperparams": {**NET, "callback": "test_sweep.Fails"}, "grid": {"env_kwargs.noise": [0.05, 0.5]}}
    assert main(["sweep", write(tmp_path / "s.yaml", seed=[0, 1], **keys), "--workers", "2", "--no-progress"]) == 1
    output = capsys.readouterr()
    failed = [line for line in output.err.splitlines() if line.startswith("failed: ")]
    assert len(failed) == 2 and all("noise=0.5/seed_" in line and "too noisy" in line for line in failed)
    place = SweepFolder("logs/sweep/s_1")
    plan = place.read()
    records = place.records(plan.runs)
    assert [record.state for record in records.values()] == ["finished"] * 2 + ["failed"] * 2
    results = json.loads((place.path / "results.json").read_text())
    assert list(results["configurations"]) == ["noise=0.05"] and len(results["failed"]) == 2
    assert (place.path / "report.html").is_file()

    hyperparams = ["n_steps:20", "batch_size:80", "gradient_steps:2", "n_epochs:1", "policy_kwargs:dict(net_arch=[4])"]
    single = ["--algo", "dagger", "--env", "QuadStateRecovery-v0", "-n", "160", "--n-envs", "4", "--eval-episodes", "0"]
    for seed in (0, 1):
        command = ["train", *single, "--hyperparams", *hyperparams, "--env-kwargs", "noise:0.05", "--seed", str(seed)]
        assert main([*command, "--num-threads", "1", "-f", "alone", "--no-progress"]) == 0
        alone = Path(f"alone/dagger/QuadStateRecovery-v0_{1 + seed}/QuadStateRecovery-v0.zip")
        assert digest(alone) == records[f"noise=0.05/seed_{seed}"].weights
    assert records["noise=0.05/seed_0"].weights != records["noise=0.05/seed_1"].weights


def start(folder, *arguments):
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(Path(__file__).parent)])}
    command = [sys.executable, "-m", "sb3_quad.cli", "sweep", *arguments, "--no-progress"]
    return subprocess.Popen(command, cwd=folder, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_driver_that_is_ended_goes_on_with_the_same_table(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), str(Path(__file__).parent)]))
    keys = {"seed": [0, 1, 2], "n_timesteps": 400, "hyperparams": {**NET, "callback": "test_sweep.Slow"}}
    file = write(tmp_path / "s.yaml", **keys)
    tables = []
    for k, number in enumerate((signal.SIGKILL, signal.SIGTERM), start=1):
        process = start(tmp_path, file, "--workers", "2")
        records, end = tmp_path / f"logs/sweep/s_{k}/records", time.monotonic() + 400
        while not list(records.rglob("*.json")) and process.poll() is None:
            assert time.monotonic() < end
            time.sleep(0.1)
        process.send_signal(number)
        output, _ = process.communicate(timeout=120)
        assert process.returncode == (143 if number == signal.SIGTERM else -signal.SIGKILL)
        kept = {path: path.read_bytes() for path in records.rglob("*.json")}
        assert 0 < len(kept) < 3, output
        if number == signal.SIGTERM:
            assert f"{len(kept)} of 3 runs finished" in output and (tmp_path / f"logs/sweep/s_{k}/results.csv").is_file()
        assert main(["sweep", "--resume", f"logs/sweep/s_{k}", "--workers", "1", "--no-progress"]) == 0
        assert {path: path.read_bytes() for path in kept} == kept
        tables.append((tmp_path / f"logs/sweep/s_{k}/results.json").read_text())
    assert main(["sweep", file, "--workers", "1", "--no-progress"]) == 0
    assert tables == [(tmp_path / "logs/sweep/s_3/results.json").read_text()] * 2
