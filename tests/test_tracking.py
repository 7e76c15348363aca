"""What of a training TensorBoard and Weights & Biases are shown; the second in its offline mode,
where it is installed.
"""

import sys
from pathlib import Path

import pytest
from conftest import HYPERPARAMS, TINY
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData

from sb3_quad.cli import main

TRAIN = ["train", "--algo", "dagger", *TINY, "--hyperparams", *HYPERPARAMS["dagger"]]


def hyperparameters(folder):
    """What TensorBoard shows under HPARAMS: the settings by name, and the names of the metrics."""
    data = EventAccumulator(str(folder)).Reload().PluginTagToContent("hparams")
    experiment, start = (
        HParamsPluginData.FromString(data[f"_hparams_/{name}"])
        for name in ("experiment", "session_start_info")
    )
    values = {
        name: getattr(value, value.WhichOneof("kind"))
        for name, value in start.session_start_info.hparams.items()
    }
    return values, [each.name.tag for each in experiment.experiment.metric_infos]


def test_tensorboard_has_the_hyperparameters(tmp_path, capsys):
    assert (
        main(
            [
                *TRAIN,
                "-f",
                str(tmp_path / "logs"),
                "-tb",
                str(tmp_path / "tb"),
                "--verbose",
                "1",
                "--seed",
                "3",
            ]
        )
        == 0
    )
    (folder,) = (tmp_path / "tb").iterdir()
    values, metrics = hyperparameters(folder)
    assert (
        values["algo"] == "dagger"
        and values["seed"] == 3
        and values["n_envs"] == 16
        and values["n_steps"] == 50
    )
    assert "eval/success_rate" in metrics
    assert len(EventAccumulator(str(folder)).Reload().Scalars("eval/success_rate")) == 2
    assert "hparams" not in capsys.readouterr().out  # SB3's tables


def test_tracking_says_what_it_needs(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "wandb", None)
    assert main([*TRAIN, "-f", str(tmp_path / "logs"), "--track"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "--track needs wandb" in line and line.endswith(
        "pip install '.[track]' from a clone of sb3_quad"
    )
    assert not [*tmp_path.iterdir()]


@pytest.mark.slow
def test_weights_and_biases_has_settings_and_evaluations(tmp_path, monkeypatch, capsys):
    """Of two trainings of one process, as the stages of a pipeline are."""
    wandb = pytest.importorskip("wandb", reason="needs wandb, the extra [track]")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("WANDB_MODE", "offline")
    runs, init = [], wandb.init

    def noted(**settings):
        runs.append(init(**settings))
        return runs[-1]

    monkeypatch.setattr(wandb, "init", noted)
    monkeypatch.setenv("WANDB_PROJECT", "quads")
    monkeypatch.setenv("WANDB_RUN_GROUP", "first")
    monkeypatch.setenv("WANDB_TAGS", "one,two")
    for seed in ("3", "4"):
        assert main([*TRAIN, "--track", "--seed", seed]) == 0
    assert [run.config["seed"] for run in runs] == [3, 4]
    assert capsys.readouterr().err.count("eval/mean_reward") == 4  # history and summary of each
    for run in runs:
        assert run.project == "quads" and run.group == "first" and {*run.tags} == {"one", "two"}
        assert run.name.startswith(f"QuadTargetTracking-v0__dagger__{run.config['seed']}__")
        assert (
            run.config["n_envs"] == 16
            and run.config["eval_episodes"] == 2
            and "sb3_quad" in run.config["versions"]
        )
        (events,) = Path("wandb").glob(f"offline-run-*-{run.id}/files/runs/*/events.*")
        assert hyperparameters(events.parent)[0]["seed"] == run.config["seed"]


def test_tracking_without_a_login_is_one_line_and_leaves_nothing(tmp_path, monkeypatch, capsys):
    wandb = pytest.importorskip("wandb", reason="needs wandb, the extra [track]")

    def refuse(**settings):
        raise wandb.errors.UsageError("no key,\nsee wandb login")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(wandb, "init", refuse)
    assert main([*TRAIN, "--track"]) == 2
    assert (
        capsys.readouterr().err.splitlines()[-1] == "error: --track: no key, see wandb login"
        and not Path("logs").exists()
    )
