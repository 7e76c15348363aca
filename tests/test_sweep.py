"""Sweeps: what they expand to, what they refuse, and that nothing of them is lost; trainings of a
few hundred timesteps.
"""

import itertools
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import Future
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3.common.callbacks import BaseCallback
from torch.nn.utils import parameters_to_vector

from sb3_quad.agents.zips import load_model
from sb3_quad.base.errors import ConfigError, WorkerDied
from sb3_quad.base.process import StopSignals
from sb3_quad.base.validate import validate
from sb3_quad.cli import main
from sb3_quad.evaluation.scenarios.load import load_suite
from sb3_quad.executors import as_they_end, start_executor
from sb3_quad.sweep import run
from sb3_quad.sweep.folder import Sweep, read_results, write_sweep
from sb3_quad.sweep.results import over_seeds, verdict
from sb3_quad.sweep.runs import make_runs
from sb3_quad.sweep.spec import SWEEPS, Evaluation, SweepSpec, load_sweep
from sb3_quad.training.config import TrainingJob, build_config

ROOT = Path(__file__).resolve().parent.parent
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
}


STAGE = {
    "name": "one",
    "algo": "dagger",
    "env": "QuadStateRecovery-v0",
    "settings": {**NET, "n_timesteps": 160, "n_envs": 4},
}


class Fails(BaseCallback):
    """Ends the training of noisy environments."""

    limit = 0.4

    def _on_step(self):
        if self.training_env.unwrapped.batch.noise_level.max() > self.limit:
            raise ValueError("too noisy")
        return True


class Slow(BaseCallback):
    """Takes its time where the environment says so."""

    def _on_rollout_start(self):
        time.sleep(float(os.environ.get("SLOW", "0")))

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
    runs = make_runs(
        spec(seed=seeds, grid={"env_kwargs.noise": noise, "hyperparams.learning_rate": rate})
    )
    settings = [(run.stages[0].settings, run.seed) for run in runs]
    found = [(each["env_kwargs"]["noise"], each["learning_rate"], seed) for each, seed in settings]
    assert found == list(itertools.product(noise, rate, seeds))
    assert len({run.name for run in runs}) == len(runs)
    assert all(re.fullmatch(r"[\w.=,+-]+/seed_\d+", run.name) for run in runs)


def test_runs_from_an_agent_have_its_observation_and_networks():
    keys = {"algo": "apg", "initial_policy": "itm-robust", "n_timesteps": 100}
    (run,) = make_runs(validate(SweepSpec, keys, "sweep"))
    settings = run.stages[0].settings
    assert settings["env_kwargs"]["history"] == [0, 1, 2, 4, 8, 16, 32, 96]
    assert settings["policy_kwargs"]["net_arch"]["pi"] == [192, 128, 128, 64]


def test_entries_of_a_list_have_their_names_and_inherit():
    own = [
        {"name": "calm", "env_kwargs": {"noise": 0}},
        {"hyperparams": {"n_epochs": 2}, "eval_freq": "1e3"},
    ]
    calm, other = make_runs(spec(configurations=own))
    settings, others = calm.stages[0].settings, other.stages[0].settings
    assert (
        calm.name == "calm/seed_0"
        and settings["env_kwargs"]["noise"] == 0
        and settings["n_epochs"] == 1
    )
    assert (
        others["n_epochs"] == 2
        and others["n_steps"] == NET["n_steps"]
        and other.job["eval_freq"] == 1000
    )


@pytest.mark.parametrize(
    ("keys", "flags", "words"),
    [
        ({"gird": {}}, [], "did you mean 'grid'"),
        ({"grid": {"algo": []}}, [], "grid: algo: must be a list of at least one"),
        ({"grid": {"env_kwargs.noise": 0.1}}, [], "env_kwargs.noise: must be a list"),
        ({"grid": {"env_kwarg.noise": [0]}}, [], "did you mean 'env_kwargs'"),
        ({"grid": {"algo": ["dagger", "ppo"]}}, [], "'ppo': "),
        ({"grid": {"vehicle": ["itm", "no-such"]}}, [], "no-such"),
        ({"seed": []}, [], "seed"),
        ({"seed": -1}, [], "seed.0: Input should be greater than or equal to 0"),
        (
            {"configurations": [{"name": "a"}, {"name": "a"}]},
            [],
            "two runs are called 'a/seed_0'",
        ),
        ({"eval_freq": "often"}, [], "eval_freq"),
        ({"evaluation": {"suite": "no-such"}}, [], "no-such"),
        ({"resources": {"num_cpus": -1}}, [], "num_cpus"),
        (
            {"configurations": [{"name": "a", "n_timesteps": 480}]},
            ["-n", "960"],
            "n_timesteps differs between the runs of ",
        ),
        (
            {"configurations": [{"env_kwargs": {"noise": 0.1}}]},
            ["--env-kwargs", "noise:0"],
            "env_kwargs.noise differs between the runs of ",
        ),
        (
            {"configurations": [{"algo": "dagger"}, {"algo": "ppo_bc"}]},
            ["--algo", "sac_bc"],
            "algo differs between the runs of ",
        ),
        (
            {"grid": {"env_kwargs": [{"noise": 0.0}, {"noise": 0.1}]}},
            ["--env-kwargs", "noise:0.2"],
            "env_kwargs.noise differs between the runs of ",
        ),
        (
            {"grid": {"hyperparams.learning_rate": [1e-3, 5e-3]}},
            ["--hyperparams", "learning_rate:0.1"],
            "hyperparams.learning_rate differs between the runs of ",
        ),
        (
            {"hyperparams": {"n_timesteps": 480}, "n_timesteps": 960},
            [],
            "n_timesteps: given by itself and in hyperparams",
        ),
        ({}, ["--executor", "rya"], "did you mean 'ray'"),
        ({}, ["--address", "auto"], "goes with --executor ray"),
        ({}, ["--executor", "ray"], "pip install '.[ray]'"),
    ],
)
def test_bad_input_is_one_line_before_anything_is_trained(
    tmp_path, monkeypatch, capsys, keys, flags, words
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "ray", None)
    assert main(["sweep", write(tmp_path / "s.yaml", **keys), *flags]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert words in line
    assert not (tmp_path / "logs").exists()


@pytest.mark.parametrize(
    ("expert", "words"),
    [("nobody", "unknown expert 'nobody'"), ("teacher.zip", "teacher.zip: no such file")],
)
def test_a_dry_run_finds_its_experts(tmp_path, capsys, monkeypatch, expert, words):
    monkeypatch.chdir(tmp_path)
    assert main(["sweep", "--algo", "dagger", "--expert", expert, "--dry-run"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert words in line


def test_values_are_named_by_their_keys_where_they_do_not_say_enough():
    first, _ = make_runs(spec(grid={"expert": ["pid"], "hyperparams.bc_loss": ["mse", "nll"]}))
    assert first.configuration == "pid,bc_loss=mse"


def test_an_unknown_vehicle_is_found_before_anything_is_trained():
    with pytest.raises(ConfigError, match="unknown vehicle 'no-such'"):
        make_runs(spec(vehicle="no-such", expert="itm-recovery"))


def test_environments_of_others_have_no_suites(monkeypatch):
    monkeypatch.setattr(run, "load_model", lambda agent: object())
    job = TrainingJob(config=build_config("ppo", "Pendulum-v1", {"n_timesteps": 100}))
    with pytest.raises(ConfigError, match="not for Pendulum-v1"):
        run._fly(Path("agent.zip"), job, load_suite("quick"), Evaluation(suite="quick"))


def test_dry_run_lists_the_runs(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert (
        main(
            [
                "sweep",
                write(tmp_path / "s.yaml", seed=[3, 4], grid={"algo": ["dagger"]}),
                "--dry-run",
            ]
        )
        == 0
    )
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in lines] == [
        "dagger/seed_3",
        "dagger/seed_4",
        "2 runs",
    ]
    assert [path.name for path in tmp_path.iterdir()] == ["s.yaml"]


def test_a_dry_run_of_a_sweep_that_was_begun_lists_its_runs(tmp_path, capsys):
    begun = spec(seed=[3, 4], grid={"algo": ["dagger"]})
    write_sweep(tmp_path, Sweep(spec=begun, runs=make_runs(begun)))
    resume = ["sweep", "--resume", str(tmp_path)]
    assert main([*resume, "--dry-run"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "2 runs"
    assert not (tmp_path / "runs").exists()
    assert main([*resume, "-f", "elsewhere"]) == 2
    assert "remove --log-folder" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["pid", "nominal"])
def test_a_sweep_of_the_package_refuses_a_file_that_would_replace_its_settings(
    tmp_path, capsys, monkeypatch, name
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "nominal").mkdir()
    for file in ("thesis.yml", "nominal/dagger.yml"):
        (tmp_path / file).write_text("QuadStateRecovery-v0: {}")
    assert main(["sweep", name, "--dry-run"]) == 2
    assert "would replace the package's in the sweep" in capsys.readouterr().err


@pytest.mark.parametrize("name", SWEEPS.names())
def test_sweeps_of_the_package_make_runs(name, trained_runs, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(
        trained_runs("dagger"), "logs/dagger/QuadTargetTracking-v0_1"
    )  # from which `cloning` starts
    assert {run.seed for run in make_runs(load_sweep(name))} == {0, 1, 2}


def test_who_is_better_is_known_where_it_is_clear():
    random = np.random.default_rng(0)
    common = random.normal(size=(1, 60))  # some episodes are harder, for all
    low, high = (common + random.normal(shift, 0.3, (3, 60)) for shift in (0.0, 1.0))
    verdicts = [
        verdict(over_seeds(difference)) for difference in (high - low, low - high, low - low)
    ]
    assert verdicts == ["better", "worse", "cannot tell"]
    interval = over_seeds(low)
    assert interval.low < low.mean() < interval.high and interval.value == pytest.approx(low.mean())
    some = np.where(random.random((3, 60)) < 0.5, np.nan, low)
    assert over_seeds(some).value == pytest.approx(np.nanmean(some, axis=1).mean())
    assert over_seeds(some, np.nanmedian).value == pytest.approx(np.nanmedian(some, axis=1).mean())
    assert over_seeds(np.full((2, 5), np.nan)) is None


def test_intervals_hold_the_truth_about_as_often_as_they_say():
    random = np.random.default_rng(1)
    held = 0
    for _ in range(60):
        interval = over_seeds(random.normal(0, 0.5, (10, 1)) + random.normal(size=(10, 40)))
        held += interval.low < 0 < interval.high
    assert held >= 48


class Inline:
    """An executor that calls at once, in this process."""

    workers = 1

    def __init__(self, *arguments, **resources):
        self.stop = lambda: None

    def submit(self, function, *arguments):
        future = Future()
        future.set_result(function(*arguments))
        return future

    __enter__ = lambda self: self  # noqa: E731
    __exit__ = lambda self, *error: None  # noqa: E731


def test_a_sweep_trains_compares_and_resumes_what_failed(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sb3_quad.executors.start_executor", Inline)
    own = [{"name": "one"}, {"name": "noisy", "env_kwargs": {"noise": 0.5}}]
    keys = {"hyperparams": {**NET, "callback": "test_sweep.Fails"}, "configurations": own}
    assert main(["sweep", write(tmp_path / "s.yaml", **keys), "--no-progress"]) == 1
    output = capsys.readouterr()
    assert (
        "failed: noisy/seed_0: ValueError: too noisy" in output.err
        and "1 of 2 runs finished, 1 failed" in output.out
    )
    place = Path("logs/sweep/s_1")
    before = {path: path.read_bytes() for path in place.rglob("records/one/*")}
    monkeypatch.setattr(Fails, "limit", 1.0)
    assert main(["sweep", "--resume", str(place), "--no-progress"]) == 0
    assert all(path.read_bytes() == content for path, content in before.items())
    output = capsys.readouterr().out
    assert "one than noisy" in output
    found = json.loads((place / "results.json").read_text())
    assert (
        list(found["configurations"]) == ["one", "noisy"]
        and found["finished"] == 2
        and not found["failed"]
    )
    assert {each["measure"] for each in found["comparisons"]} == {"success", "reward"}
    assert len((place / "results.csv").read_text().splitlines()) == 5  # two scenarios each
    assert (place / "report.html").is_file() and "one (n = 1)" in (place / "report.md").read_text()


def test_resuming_rereads_no_settings_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sb3_quad.executors.start_executor", Inline)
    (tmp_path / "two.yml").write_text(
        json.dumps({"stages": [STAGE, {**STAGE, "name": "two", "seed_offset": 1}]})
    )
    keys = {"algo": None, "env": None, "n_timesteps": None, "conf_file": "two.yml"}
    sweep = Sweep(spec=spec(**keys), runs=tuple(make_runs(spec(**keys))))
    place = Path("logs/s_1")
    write_sweep(place, sweep)
    (tmp_path / "two.yml").unlink()
    assert main(["sweep", "--resume", "logs/s_1", "--no-progress"]) == 0
    (record,) = read_results(place).values()
    assert record.state == "finished" and record.timesteps == 320


def kill_seven(number):
    if number == 7:
        os.kill(os.getpid(), signal.SIGKILL)
    return number * number


@pytest.mark.slow
def test_a_worker_that_dies_fails_its_own_call_alone():
    with start_executor("local", 2) as executor:
        futures = {number: executor.submit(kill_seven, number) for number in (1, 7, 2, 3)}
        assert [futures[number].result() for number in (1, 2, 3)] == [1, 4, 9]
        with pytest.raises(WorkerDied):
            futures[7].result()


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_calls_that_were_cancelled_are_not_waited_for():
    with start_executor("local", 1) as executor:
        calls = {executor.submit(time.sleep, 0.5 * (k == 0)): k for k in range(3)}
        [waiting] = [future for future, k in calls.items() if k == 2]
        assert waiting.cancel()
        ended = [k for k, _ in as_they_end(executor, calls, StopSignals(), print)]
    assert sorted(ended) == [0, 1]


def test_a_sweep_gives_what_train_gives(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    keys = {"env_kwargs": {"noise": 0.05}, "seed": [0, 1]}
    assert (
        main(["sweep", write(tmp_path / "s.yaml", **keys), "--workers", "2", "--no-progress"]) == 0
    )
    place = Path("logs/sweep/s_1")
    records = read_results(place)
    hyperparams = [
        "n_steps:20",
        "batch_size:80",
        "gradient_steps:2",
        "n_epochs:1",
        "policy_kwargs:dict(net_arch=[4])",
    ]
    single = [
        "--algo",
        "dagger",
        "--env",
        "QuadStateRecovery-v0",
        "-n",
        "160",
        "--n-envs",
        "4",
        "--eval-episodes",
        "0",
    ]
    command = [
        "train",
        *single,
        "--hyperparams",
        *hyperparams,
        "--env-kwargs",
        "noise:0.05",
        "--seed",
        "1",
    ]
    assert main([*command, "--num-threads", "1", "-f", "alone", "--no-progress"]) == 0
    alone = parameters(Path("alone/dagger/QuadStateRecovery-v0_1/QuadStateRecovery-v0.zip"))
    first, second = (
        parameters(place / "runs" / name / records[name].agent)
        for name in ("dagger/seed_0", "dagger/seed_1")
    )
    assert torch.equal(alone, second) and not torch.equal(first, second)


def parameters(agent):
    """The parameters of an agent's policy, as one vector."""
    return parameters_to_vector(load_model(agent).policy.parameters())


def start(folder, *arguments):
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(ROOT), str(Path(__file__).parent)]),
        "SLOW": "0.5",
    }
    command = [sys.executable, "-m", "sb3_quad.cli", "sweep", *arguments, "--no-progress"]
    return subprocess.Popen(
        command,
        cwd=folder,
        env=environment,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_driver_that_is_ended_resumes_with_the_same_table(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(
        "sb3_quad.executors.start_executor", Inline
    )  # one thread, as workers have: equal bits
    keys = {
        "seed": [0, 1, 2],
        "n_timesteps": 400,
        "hyperparams": {**NET, "callback": "test_sweep.Slow"},
    }
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
            assert (
                f"{len(kept)} of 3 runs finished" in output
                and (tmp_path / f"logs/sweep/s_{k}/results.csv").is_file()
            )
        assert main(["sweep", "--resume", f"logs/sweep/s_{k}", "--no-progress"]) == 0
        assert {path: path.read_bytes() for path in kept} == kept
        tables.append((tmp_path / f"logs/sweep/s_{k}/results.json").read_text())
    assert main(["sweep", file, "--no-progress"]) == 0
    assert tables == [(tmp_path / "logs/sweep/s_3/results.json").read_text()] * 2


def test_a_grid_fills_what_a_configuration_leaves_empty():
    data = {
        "algo": "dagger",
        "env": "QuadStateRecovery-v0",
        "configurations": [{"name": "one", "env_kwargs": None}],
    }
    runs = make_runs(SweepSpec(**data, grid={"env_kwargs.noise": [0.0, 0.1]}))
    assert [run.stages[0].settings["env_kwargs"]["noise"] for run in runs] == [0.0, 0.1]


def test_mappings_of_a_grid_are_merged_with_the_shared_keys():
    runs = make_runs(
        spec(
            env_kwargs={"vehicle": "crazyflie"},
            grid={"env_kwargs": [{"noise": 0.0}, {"noise": 0.1}]},
        )
    )
    flown = [run.stages[0].settings["env_kwargs"] for run in runs]
    assert flown == [{"vehicle": "crazyflie", "noise": noise} for noise in (0.0, 0.1)]


def test_a_vehicle_is_given_once():
    with pytest.raises(ConfigError, match="vehicle crazyflie: env_kwargs have one, too"):
        make_runs(spec(vehicle="crazyflie", grid={"env_kwargs.vehicle": ["itm", "hummingbird"]}))
