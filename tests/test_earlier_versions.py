"""What version 0.1 has left on a disk still opens: an interrupted run goes on to the same agent, a zip flies the same."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from stable_baselines3 import PPO

from sb3_quad.cli import main
from sb3_quad.experts.models import load_model, saved_algorithm
from sb3_quad.training.trainer import resume

OLD = Path(__file__).parent / "data" / "version_0_1"


@pytest.fixture(scope="module")
def expected():
    return json.loads((OLD / "expected.json").read_text())


def test_an_interrupted_run_goes_on_to_the_agent_of_the_uninterrupted_one(tmp_path, expected):
    run = tmp_path / "QuadTargetTracking-v0_1"
    shutil.copytree(OLD / run.name, run)
    result = resume(str(run), report=lambda line: None)
    assert result.exit_code == 0 and result.model.num_timesteps == 1200
    for name, tensor in result.model.policy.state_dict().items():
        np.testing.assert_allclose(tensor.numpy(), expected["whole"][name], rtol=1e-3, atol=1e-5, err_msg=name)
    with np.load(run / "evaluations.npz") as file:
        assert file["timesteps"].tolist() == [400, 800, 1200, 1200]


def test_a_zip_flies_the_same(expected):
    observations = np.array(expected["observations"], dtype=np.float32)
    assert saved_algorithm(OLD / "agent.zip") == "PPOBC"
    for model in (load_model(OLD / "agent.zip"), PPO.load(OLD / "agent.zip", device="cpu")):
        actions, _ = model.predict(observations, deterministic=True)
        np.testing.assert_allclose(actions, expected["actions"], rtol=1e-4, atol=1e-6)


def test_its_agent_is_shown_with_the_settings_of_its_run(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run = tmp_path / "logs" / "dagger" / "QuadTargetTracking-v0_1"
    shutil.copytree(OLD / run.name, run)
    assert main(["enjoy", "--algo", "dagger", "--env", "QuadTargetTracking-v0", "--no-render"]) == 0
    assert "0.60 s" in capsys.readouterr().out  # 60 control steps, as its env_kwargs say
