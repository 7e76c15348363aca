"""What version 0.1 has left on a disk still opens: an interrupted run goes on to the same agent, a zip flies the same,
results are read, and nothing in them is flown again."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from stable_baselines3 import PPO

from sb3_quad.base.errors import ConfigError
from sb3_quad.cli import main
from sb3_quad.evaluation.flightlog import read_flights
from sb3_quad.evaluation.folder import load_results, write_results
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


@pytest.mark.parametrize("name", ["QuadTargetTracking-v0.zip", "dataset.npz", "resume.npz"])
def test_an_interrupted_run_with_a_damaged_file_is_refused(tmp_path, name):
    run = tmp_path / "QuadTargetTracking-v0_1"
    shutil.copytree(OLD / run.name, run)
    (run / name).write_bytes((run / name).read_bytes()[:100])
    with pytest.raises(ConfigError, match=name):
        resume(str(run), report=lambda line: None)


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


def test_results_are_read_and_written_alike(tmp_path):
    results = load_results(OLD / "results")
    entry = results.entry("agent", "hit")
    assert entry.metrics.survival.n == 1 and entry.metrics.success is None  # which it called success
    assert entry.metrics.arrivals[0].tolerance == 0.5
    assert entry.figures is entry.metrics  # as documented in version 0.1
    assert len(entry.hit_limit.trials) == 17 and results.failures[0].controller == "missing"
    assert results.scenarios[0].reference["expert"].survival is not None
    assert results.scenarios[0].reference["expert"].time_to == {"0.5": 1.25}
    assert read_flights(OLD / "results" / entry.flights)["position"].shape == (1, 11, 3)
    shutil.copytree(OLD / "results" / "flights", tmp_path / "flights")
    write_results(tmp_path, results)
    assert load_results(tmp_path) == results
    assert (tmp_path / "episodes.csv").read_bytes() == (OLD / "results" / "episodes.csv").read_bytes()


def test_flights_of_its_random_streams_are_not_mixed_with_ours_and_are_shown(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(OLD / "results", tmp_path / "results")
    before = {path: path.read_bytes() for path in (tmp_path / "results").rglob("*.*")}
    command = ["evaluate", str(OLD / "agent.zip"), "--suite", str(OLD / "small.yaml"), "-o", "results", "--no-report"]
    assert main(command) == 2 and "give another folder with -o" in capsys.readouterr().err
    assert before == {path: path.read_bytes() for path in (tmp_path / "results").rglob("*.*")}
    assert main(["report", "results"]) == 0
    page = (tmp_path / "results" / "report.html").read_text()
    for part in ("paper", "Survival", "tilt", "half survive up to", "waypoints reached"):
        assert part.lower() in page.lower(), part


def test_names_that_were_documented_can_still_be_imported():
    from sb3_quad.dynamics.state import QuadcopterState
    from sb3_quad.dynamics.vehicle import Vehicle, load_vehicle
    from sb3_quad.errors import ConfigError as Same
    from sb3_quad.evaluation.expert_figures import measure_expert
    from sb3_quad.vehicles import Vehicle as Short

    assert isinstance(load_vehicle("itm"), Vehicle) and Vehicle is Short and Same is ConfigError and callable(measure_expert)
    assert QuadcopterState(np.zeros((20, 2))).position.shape == (2, 3)
