"""The search for hyperparameters: trials that are trainings, in a study of Optuna."""

import ast
import csv
import signal
import sys
from pathlib import Path

import optuna
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3.common.callbacks import BaseCallback

from sb3_quad.cli import main
from sb3_quad.training.config import build_config, load_config
from sb3_quad.training.tune import SPACES, load_space, score, suggest

ENV = "QuadTargetTracking-v0"
SMALL = {
    "n_timesteps": 400,
    "n_envs": 8,
    "n_steps": 25,
    "batch_size": 100,
    "learning_rate": "lin_1e-3",
    "bc_loss": "huber_mse",
    "dataset_capacity": 2000,
    "policy_kwargs": "dict(net_arch=[8], activation_fn=nn.Tanh)",
    "env_kwargs": {"max_episode_steps": 60},
}
SPACE = {
    "learning_rate": {"low": 1e-4, "high": 1e-2, "log": True},
    "bc_loss": ["mse", "huber_mse"],
    "policy_kwargs.net_arch": [[8], [4, 4]],
}


@pytest.fixture
def command(tmp_path, monkeypatch):
    """A search in an empty folder, of a few hundred timesteps a trial."""
    monkeypatch.chdir(tmp_path)
    write()
    files = ["--conf-file", "small.yml", "--search-space", "space.yml"]
    few = ["--eval-episodes", "4", "--n-evaluations", "2", "--no-progress"]
    return ["tune", "--algo", "dagger", *files, *few, "--sampler", "RandomSampler"]


def write(space=SPACE, **settings):
    Path("small.yml").write_text(yaml.safe_dump({ENV: {**SMALL, **settings}}))
    Path("space.yml").write_text(yaml.safe_dump(space))


def folder(number=1):
    return Path("logs", "tune", "dagger", f"{ENV}_{number}")


def trials(number=1):
    with (folder(number) / "trials.csv").open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_a_search_begins_with_the_settings_and_is_continued(command):
    shared = [*command, "--storage", "sqlite:///study.db", "--n-trials"]
    assert main([*shared, "2"]) == 0
    best = yaml.safe_load((folder() / "best.yml").read_text())[ENV]
    tried = [ast.literal_eval(row["user_attrs_settings"]) for row in trials()]
    assert best in tried and SMALL.items() <= tried[0].items()
    assert tried[1]["learning_rate"].startswith("lin_") and tried[1]["n_timesteps"] == 400
    # What train takes as its settings, with the classes that they name.
    assert build_config("dagger", ENV, best).policy_kwargs["activation_fn"].__name__ == "Tanh"
    assert main([*shared, "1"]) == 0
    assert [row["state"] for row in trials(2)] == ["COMPLETE"] * 3


class Ends(BaseCallback):
    """Ends the training of small networks."""

    how = None

    def _on_step(self):
        if self.model.policy.net_arch == [4, 4]:
            Ends.how()
        return True


@pytest.mark.parametrize(
    ("how", "code"), [(lambda: 1 / 0, 0), (lambda: signal.raise_signal(signal.SIGINT), 130)]
)
def test_a_trial_fails_alone_and_ctrl_c_keeps_what_is_finished(command, monkeypatch, how, code):
    monkeypatch.setattr(Ends, "how", how)
    write({"policy_kwargs.net_arch": [[4, 4]]}, callback="test_tune.Ends")
    assert main([*command, "--n-trials", "2", "--storage", "study.log"]) == code
    assert [row["state"] for row in trials()] == ["COMPLETE", "FAIL"]
    assert (folder() / "best.yml").is_file()


def test_pruned_trials_end_early(command, monkeypatch):
    monkeypatch.setattr(optuna.pruners.MedianPruner, "prune", lambda *arguments: True)
    assert main([*command, "--n-trials", "1"]) == 0
    assert [row["state"] for row in trials()] == ["PRUNED"]
    assert not (folder() / "best.yml").exists()


def test_a_log_that_is_no_journal_is_named(command, capsys):
    Path("broken.log").write_text("no journal\n")
    assert main([*command, "--storage", "broken.log"]) == 2
    # Optuna logs, too.
    assert "broken.log" in capsys.readouterr().err.split("error: ")[1]


def test_without_optuna_it_names_the_extra_to_install(command, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "optuna", None)
    assert main(command) == 2
    assert "'.[tune]'" in capsys.readouterr().err


@pytest.mark.parametrize("algo", SPACES.names())
def test_the_spaces_of_the_package_fit_its_settings(algo):
    config = load_config(algo, "QuadStateRecovery-v0")
    space = load_space(None, config)
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    for _ in range(10):
        settings = suggest(study.ask(), space, config).settings
        assert yaml.safe_load(yaml.safe_dump(settings)) == settings


FLOWN = st.tuples(st.integers(0, 48), st.integers(-10_000, 10_000))


@given(FLOWN, FLOWN)
def test_more_success_outweighs_any_reward_and_reward_decides_between_equals(first, second):
    values = [score(successes / 48, reward, 48) for successes, reward in (first, second)]
    assert (values[0] > values[1]) == (first > second)
