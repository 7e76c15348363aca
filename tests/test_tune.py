"""The search for hyperparameters: trials that are trainings, in a study that is shared, resumed and
never lost.
"""

import csv
import os
import shlex
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import optuna
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback

from sb3_quad.base.errors import ConfigError
from sb3_quad.cli import main
from sb3_quad.training.algorithms import ALGORITHMS
from sb3_quad.training.config import build_config, load_config
from sb3_quad.tuning import search as search_module
from sb3_quad.tuning.results import train_command
from sb3_quad.tuning.search import score
from sb3_quad.tuning.space import SPACES, load_space

ENV = "QuadTargetTracking-v0"
SMALL = {
    "n_timesteps": 800,
    "n_envs": 8,
    "n_steps": 50,
    "batch_size": 100,
    "learning_rate": "lin_1e-3",
    "dataset_capacity": 2000,
    "policy_kwargs": "dict(net_arch=[8])",
    "env_kwargs": {"max_episode_steps": 60},
}
SPACE = {
    "learning_rate": {"around": 4},
    "bc_loss": ["mse", "huber"],
    "policy_kwargs.log_std_init": {"low": -3, "high": 0},
}
FEW = ["--eval-episodes", "4", "--n-evaluations", "2", "--no-progress", "--sampler", "random"]


@pytest.fixture
def command(tmp_path, monkeypatch):
    """A search in an empty folder, of a few hundred timesteps a trial; the settings and the space
    are files there.
    """
    monkeypatch.chdir(tmp_path)
    Path("small.yml").write_text(yaml.safe_dump({ENV: SMALL}))
    Path("space.yml").write_text(yaml.safe_dump(SPACE))
    return [
        "tune",
        "--algo",
        "dagger",
        "--conf-file",
        "small.yml",
        "--search-space",
        "space.yml",
        *FEW,
    ]


def folder(number=1):
    return Path("logs", "tune", "dagger", f"{ENV}_{number}")


def trials(number=1):
    with (folder(number) / "trials.csv").open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def one_line_of_error(capsys):
    lines = [
        line
        for line in capsys.readouterr().err.splitlines()
        if not line.startswith("sb3_quad: compiling")
    ]
    assert len(lines) == 1 and lines[0].startswith("error: "), lines
    return lines[0]


VARIED = ("learning_rate", "bc_loss", "policy_kwargs.log_std_init")


def varied(row):
    return tuple(row[name] for name in VARIED)


@pytest.mark.slow
def test_a_search_leaves_settings_that_train_takes_and_resumes(command, capsys):
    assert main([*command, "--n-trials", "2", "--seed", "3"]) == 0
    output = capsys.readouterr().out
    assert (
        "trial 1 finished" in output
        and "fresh episodes" in output
        and "to train: sb3-quad train" in output
        and str(folder() / "best.yml") in output
    )
    files = {path.name for path in folder().iterdir()}
    assert files == {"best.yml", "trials.csv", "study.log", "dagger"}

    rows = trials()
    assert [row["state"] for row in rows] == ["COMPLETE"] * 2 and [
        row["evaluations"] for row in rows
    ] == ["2"] * 2
    best = max(rows, key=lambda row: float(row["value"]))
    content = yaml.safe_load((folder() / "best.yml").read_text())[ENV]
    assert content["learning_rate"] == best["learning_rate"] and content[
        "learning_rate"
    ].startswith("lin_")
    assert len(content["learning_rate"]) <= len("lin_0.0001234")
    assert str(content["policy_kwargs"]["log_std_init"]) == best["policy_kwargs.log_std_init"]
    assert content["policy_kwargs"]["net_arch"] == [8] and content["n_timesteps"] == 800
    assert PPO.load(Path(best["run"]) / f"{ENV}.zip").num_timesteps == 800
    with np.load(Path(best["run"]) / "evaluations.npz") as file:
        assert file["timesteps"].tolist() == [400, 800]
        assert float(best["value"]) == score(
            file["successes"][-1].mean(), file["results"][-1].mean(), 4
        )

    assert (
        main(
            [
                "train",
                "--algo",
                "dagger",
                "--conf-file",
                str(folder() / "best.yml"),
                "--eval-episodes",
                "0",
            ]
        )
        == 0
    )
    trained = PPO.load(Path("logs", "dagger", f"{ENV}_1", f"{ENV}.zip"))
    assert (
        trained.policy.net_arch == [8]
        and trained.policy_kwargs["log_std_init"] == content["policy_kwargs"]["log_std_init"]
    )

    before = {
        path: path.read_bytes()
        for path in folder().rglob("*")
        if path.is_file() and path.name != "study.log"
    }
    resumed = [*command, "--n-trials", "1", "--seed", "3", "--storage", str(folder() / "study.log")]
    assert main(resumed) == 0
    assert main([*command, "--n-trials", "3", "--seed", "3"]) == 0
    assert all(path.read_bytes() == content for path, content in before.items())
    assert [varied(row) for row in trials(2)] == [
        varied(row) for row in trials(3)
    ]  # as if it had never been left
    assert [row["value"] for row in trials(2)] == [row["value"] for row in trials(3)]
    assert len({varied(row) for row in trials(3)}) == 3

    capsys.readouterr()
    assert main([*resumed, "--n-evaluations", "3", "--hyperparams", "n_epochs:2"]) == 2
    error = one_line_of_error(capsys)
    assert "n_epochs, n_evaluations" in error and "--study-name" in error
    assert not folder(4).exists()


@pytest.mark.parametrize(
    ("name", "value", "settings", "evaluated"),
    [
        ("noise", 0.4, {}, {"noise": 0.05}),
        ("noise", 0.4, {"env_kwargs": "dict(noise=0.2)"}, {"noise": 0.2}),
        ("noise", 0.4, {"eval_env_kwargs": {"noise": 0.1}}, {"noise": 0.1}),
        # The agent needs these as it was trained.
        ("history", 2, {}, {}),
    ],
)
def test_trials_are_evaluated_in_the_same_environment(tmp_path, name, value, settings, evaluated):
    path = tmp_path / "space.yml"
    path.write_text(yaml.safe_dump({f"env_kwargs.{name}": [value]}))
    space = load_space(build_config("dagger", ENV, {**SMALL, **settings}), path)
    trial = space.settings({f"env_kwargs.{name}": value})
    assert trial["env_kwargs"][name] == value
    assert trial.get("eval_env_kwargs", {}) == evaluated


def test_the_command_that_trains_can_be_pasted():
    config = SimpleNamespace(algo="dagger", env_id=ENV)
    job = SimpleNamespace(config=config, log_folder="my logs", initial_policy="my agent.zip")
    command = shlex.split(train_command(SimpleNamespace(job=job)))
    assert command[-3:] == [str(Path("my logs", "best.yml")), "-i", "my agent.zip"]


def test_the_first_trial_has_the_settings_as_they_are(command, capsys):
    settings = {
        **SMALL,
        "policy_kwargs": "dict(net_arch=[8], log_std_init=-1.5)",
        "bc_loss": "huber",
        "best_by": "survival",
    }
    Path("small.yml").write_text(yaml.safe_dump({ENV: settings}))
    assert main([*command, "--n-trials", "1"]) == 0
    (trial,) = trials()
    assert varied(trial) == ("lin_0.001", "huber", "-1.5")
    # The rate has its own name.
    with np.load(Path(trial["run"]) / "evaluations.npz") as file:
        assert float(trial["survival_rate"]) == file["survivals"][-1].mean()
    assert "success_rate" not in trial
    assert "trial 0 finished, survival" in capsys.readouterr().out


@pytest.mark.slow
def test_two_processes_share_a_study(command):
    shared = [*command, "--n-trials", "2", "--storage", "shared.log"]
    environment = {
        **os.environ,
        "OMP_NUM_THREADS": "1",
        "PYTHONPATH": str(Path(__file__).parent.parent),
    }
    arguments = [sys.executable, "-m", "sb3_quad.cli", *shared]
    other = subprocess.Popen(
        arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    )
    assert main(shared) == 0
    output, errors = other.communicate(timeout=120)
    assert other.returncode == 0, errors
    assert "Traceback" not in errors and "saved in" in output
    rows = max((trials(number) for number in (1, 2)), key=len)  # of whoever ended last
    assert [int(row["number"]) for row in rows] == [0, 1, 2, 3]
    assert len({varied(row) for row in rows}) == 4
    assert len({row["run"] for row in rows}) == 4
    assert main([*command, "--max-total-trials", "5", "--storage", "shared.log"]) == 0
    assert len(trials(3)) == 5


def test_pruned_trials_end_early_and_are_never_the_best(command, monkeypatch, capsys):
    monkeypatch.setitem(
        search_module.PRUNERS,
        "median",
        lambda *arguments: optuna.pruners.ThresholdPruner(lower=10.0),
    )
    assert main([*command, "--n-trials", "2"]) == 0
    assert "trial 0 pruned, success" in capsys.readouterr().out
    rows = trials()
    assert [(row["state"], row["evaluations"], row["value"]) for row in rows] == [
        ("PRUNED", "1", "")
    ] * 2
    assert PPO.load(Path(rows[0]["run"]) / f"{ENV}.zip").num_timesteps == 400
    assert not (folder() / "best.yml").exists()


def test_a_trial_that_fails_is_reported_and_the_others_continue(command, capsys):
    Path("space.yml").write_text(yaml.safe_dump({**SPACE, "batch_size": [100, 0]}))
    assert main([*command, "--n-trials", "5", "--seed", "1"]) == 0
    output, rows = capsys.readouterr().out, trials()
    failed = [row for row in rows if row["state"] == "FAIL"]
    assert failed and len(failed) < 5
    assert all(row["batch_size"] == "0" and "batch_size is 0" in row["error"] for row in failed)
    assert all(row["state"] == "COMPLETE" for row in rows if row["batch_size"] == "100")
    assert (
        f"ConfigError: trial {failed[0]['number']}: batch_size is 0, must be at least 1" in output
    )


class InterruptSecond(BaseCallback):
    """Sends this process Ctrl-C in the second training that it is part of."""

    made = 0

    def __init__(self) -> None:
        super().__init__()
        InterruptSecond.made += 1
        self.number = InterruptSecond.made

    def _on_step(self) -> bool:
        if self.number == 2 and self.num_timesteps == 600:
            os.kill(os.getpid(), signal.SIGINT)
        return True


def test_ctrl_c_keeps_what_is_finished_and_the_rest_is_tried_again(command, capsys):
    settings = {**SMALL, "callback": "test_tune.InterruptSecond"}
    Path("small.yml").write_text(yaml.safe_dump({ENV: settings}))
    InterruptSecond.made = 0
    assert main([*command, "--n-trials", "9"]) == 130
    assert "trial 1 failed: interrupted" in capsys.readouterr().out
    assert [(row["state"], row["error"]) for row in trials()] == [
        ("COMPLETE", ""),
        ("FAIL", "interrupted"),
    ]
    assert (folder() / "best.yml").is_file()
    assert main([*command, "--n-trials", "1", "--storage", str(folder() / "study.log")]) == 0
    assert [row["state"] for row in trials(2)] == ["COMPLETE", "FAIL", "COMPLETE"]
    assert varied(trials(2)[2]) == varied(trials(2)[1])


def test_a_database_and_another_environment(command, capsys):
    pendulum = {"n_timesteps": 128, "n_envs": 2, "n_steps": 32, "batch_size": 32}
    Path("small.yml").write_text(yaml.safe_dump({"Pendulum-v1": pendulum}))
    Path("space.yml").write_text("n_minibatches: {low: 1, high: 4}\n")
    known = [
        "--env",
        "Pendulum-v1",
        "--storage",
        "sqlite:///study.db",
        "--study-name",
        "swing",
        "--n-evaluations",
        "1",
    ]
    assert main([*command, "--algo", "ppo", *known, "--n-trials", "2", "--eval-episodes", "1"]) == 0
    with Path("logs/tune/ppo/Pendulum-v1_1/trials.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["value"] for row in rows] == [
        row["mean_reward"] for row in rows
    ]  # no success there: as in rl-zoo
    study = optuna.load_study(study_name="swing", storage="sqlite:///study.db")
    assert len(study.trials) == 2
    sizes = [
        yaml.safe_load((Path(row["run"]) / "Pendulum-v1" / "config.yml").read_text())["batch_size"]
        for row in rows
    ]
    assert sizes == [-(-64 // int(row["n_minibatches"])) for row in rows]


def test_studies_of_others_are_refused_and_one_that_was_left_at_its_birth_is_begun(command, capsys):
    storage = optuna.storages.JournalStorage(
        optuna.storages.journal.JournalFileBackend("studies.log")
    )
    others = optuna.create_study(study_name="others", storage=storage, direction="maximize")
    others.add_trial(optuna.trial.create_trial(value=1.0))
    optuna.create_study(study_name="left", storage=storage, direction="maximize")
    known = [*command, "--n-trials", "1", "--storage", "studies.log", "--study-name"]
    assert main([*known, "others"]) == 2
    assert "not made by tune" in one_line_of_error(capsys)
    assert main([*known, "left"]) == 0
    assert [row["state"] for row in trials()] == ["COMPLETE"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--sampler", "tpee"], "did you mean 'tpe'"),
        (["--pruner", "medain"], "did you mean 'median'"),
        (["--n-evaluations", "0"], "--n-evaluations"),
        (["--n-startup-trials", "-1"], "--n-startup-trials"),
        (["--eval-episodes", "0"], "--eval-episodes"),
        (["--storage", "broken.log"], "storage broken.log: cannot be used"),
        (
            ["--storage", "cut.log"],
            "storage cut.log: cannot be used (ValueError: the last line is cut",
        ),
        (["--storage", "mysql+nothing://x/y"], "storage mysql+nothing://x/y: cannot be used"),
        (["--search-space", "nowhere.yml"], "nowhere.yml"),
        (["-i", "nowhere.zip"], "nowhere.zip"),
    ],
)
def test_bad_input_is_one_line(command, arguments, message, capsys):
    Path("broken.log").write_text("no journal\n")
    Path("cut.log").write_text('{"op_code": 0')
    assert main([*command, *arguments]) == 2
    assert message in one_line_of_error(capsys)
    assert not folder().exists()


@pytest.mark.parametrize(
    ("space", "message"),
    [
        ({"learning_rat": {"around": 2}}, "did you mean 'learning_rate'"),
        ({"learning_rate": {"around": 0.5}}, "greater than 1"),
        ({"ent_coef": {"around": 2}}, "give low and high"),
        ({"beta": {"low": 1, "high": 0}}, "low <= high"),
        ({"beta": {"low": 0, "high": 1, "log": True}}, "low"),
        ({"beta": {"low": 0}}, "high"),
        ({"beta": {"low": 0, "high": 1, "step": 2}}, "step"),
        ({"n_steps": {"low": 1.5, "high": 20}}, "low: Input should be a valid integer"),
        ({"bc_loss": []}, "list of values"),
        ({"bc_loss": "mse"}, "list"),
        ({"n_minibatches": [2], "batch_size": [2]}, "remove one"),
        ({}, "must hold"),
    ],
)
def test_invalid_spaces_are_refused(tmp_path, space, message):
    path = tmp_path / "space.yml"
    path.write_text(yaml.safe_dump(space))
    with pytest.raises(ConfigError, match=message) as caught:
        load_space(build_config("dagger", ENV, SMALL), path)
    assert "space.yml" in str(caught.value)


def test_without_optuna_it_names_the_extra_to_install(command, monkeypatch, capsys):
    for name in [
        name
        for name in sys.modules
        if name.startswith(("sb3_quad.tuning", "sb3_quad.cli.commands.tune"))
    ]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "optuna", None)
    assert main(command) == 2
    assert "pip install '.[tune]'" in one_line_of_error(capsys)


@pytest.mark.parametrize(
    ("algo", "file"),
    [
        *(
            ("dagger", name)
            for name in (
                "dagger.yml",
                "robust/dagger.yml",
                "nominal/dagger.yml",
                "thesis/dagger.yml",
            )
        ),
        *(
            ("ppo_bc", name)
            for name in (
                "ppo_bc.yml",
                "nominal/ppo_bc.yml",
                "robust/ppo_bc.yml",
                "thesis/ppo_bc.yml",
            )
        ),
        ("ppo", "ppo.yml"),
        ("apg", "apg.yml"),
        ("apg", "robust/apg.yml"),
    ],
)
def test_the_shipped_spaces_fit_the_shipped_settings(algo, file):
    config = load_config(algo, "QuadStateRecovery-v0" if algo != "dagger" else ENV, file)
    space = load_space(config)
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    for _ in range(20):
        settings = space.settings(study.ask(dict(space.dimensions)).params)
        assert yaml.safe_load(yaml.safe_dump(settings)) == settings
        suggested = build_config(algo, config.env_id, settings)
        assert suggested.policy_kwargs["net_arch"] == config.policy_kwargs["net_arch"]
        assert 0 < suggested.hyperparams.get("gamma", 0.5) < 1
    if "thesis" not in file:
        assert space.start() is not None


def test_every_algorithm_has_a_space():
    for algo in ALGORITHMS:
        assert SPACES.read(algo)[0]


rewards = st.floats(-1e4, 1e4).map(lambda value: round(value, 3))


@given(st.integers(1, 1000), st.data())
def test_more_success_outweighs_any_reward_and_reward_decides_between_equals(n, data):
    first, second = (data.draw(st.tuples(st.integers(0, n), rewards)) for _ in range(2))
    values = [score(successes / n, reward, n) for successes, reward in (first, second)]
    assert (values[0] > values[1]) == (first > second)
