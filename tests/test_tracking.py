"""What of a training TensorBoard and Weights & Biases are shown; the second in its offline mode,
where it is installed.
"""

import sys
from pathlib import Path

import pytest
from conftest import HYPERPARAMS, TINY
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_quad.cli import main

TRAIN = ["train", "--algo", "dagger", *TINY, "--hyperparams", *HYPERPARAMS["dagger"]]


def test_tensorboard_has_the_evaluations(tmp_path):
    folders = ["-f", str(tmp_path / "logs"), "-tb", str(tmp_path / "tb")]
    assert main([*TRAIN, *folders, "--seed", "3"]) == 0
    (folder,) = (tmp_path / "tb").iterdir()
    assert len(EventAccumulator(str(folder)).Reload().Scalars("eval/success_rate")) == 2


def test_tracking_says_what_it_needs(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "wandb", None)
    assert main([*TRAIN, "-f", str(tmp_path / "logs"), "--track"]) == 2
    line = capsys.readouterr().err.splitlines()[-1]
    assert "--track" in line and "[track]" in line and not [*tmp_path.iterdir()]


@pytest.mark.slow
def test_weights_and_biases_has_settings_and_evaluations(tmp_path, monkeypatch, capsys):
    wandb = pytest.importorskip("wandb", reason="needs wandb, the extra [track]")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("WANDB_MODE", "offline")
    assert main([*TRAIN, "--track", "-tb", "runs", "--seed", "3"]) == 0
    assert capsys.readouterr().err.count("eval/mean_reward") == 2  # history and summary
    assert [*Path("wandb").glob("offline-run-*/files/runs/*/events.*")]

    def refuse(**settings):
        raise wandb.errors.UsageError("no key,\nsee wandb login")

    monkeypatch.setattr(wandb, "init", refuse)
    assert main([*TRAIN, "--track", "-tb", "runs", "-f", "refused"]) == 2
    assert "--track" in capsys.readouterr().err.splitlines()[-1] and not Path("refused").exists()
