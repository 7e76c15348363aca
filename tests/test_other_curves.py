"""What flies in the simulators of others follows the same curves, seen in the same way, as here."""

import sys
from pathlib import Path

import numpy as np
import pytest
from stable_baselines3 import PPO

from sb3_quad.envs.simulation.references import Reference
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.envs.vec_env import QuadcopterVecEnv
from sb3_quad.envs.vehicles.vehicle import load_vehicle
from sb3_quad.export.policy import export_policy

OTHERS = Path(__file__).resolve().parent.parent / "examples" / "other_simulators"


@pytest.fixture(autouse=True)
def scripts(monkeypatch):
    monkeypatch.syspath_prepend(str(OTHERS))
    yield
    for name in ("flights", "in_own"):
        sys.modules.pop(name, None)


@pytest.mark.parametrize("curve", ["figure_eight", "circle"])
def test_curves_are_those_of_a_reference(curve):
    from flights import make_curve

    table = Reference(curve=curve, speed=2.0).tracks(0.01).table
    motion = make_curve(f"{curve}_2")[: len(table)].reshape(-1, 9)
    np.testing.assert_allclose(motion, table[:, :9], atol=2e-3)


def test_an_exported_agent_sees_a_curve_as_it_does_in_training(tmp_path, monkeypatch):
    pytest.importorskip("onnxruntime")
    import flights
    from in_own import Own

    vehicle = load_vehicle("itm").model_copy(update={"delay": 0})
    settings = {
        "vehicle": vehicle,
        "task": "target_tracking",
        "task_kwargs": {"target_distance": 0.0},
        "noise": 0.0,
        "preview": [0, 5],
        "reference": "figure_eight",
    }
    env = QuadcopterVecEnv(2, **settings, seed=0)
    model = PPO("MlpPolicy", env, seed=0, device="cpu")
    FlightSettings(**settings).write_into(model)
    model.save(tmp_path / "agent.zip")
    exported = export_policy(tmp_path / "agent.zip", "onnx", n_observations=200)
    (tmp_path / "agent.onnx").write_bytes(exported.content)

    monkeypatch.setattr(flights, "STEPS", 60)
    monkeypatch.setattr(flights, "SETTLED", 0)
    simulator = Own("itm", 0.0, 2)
    agent = flights.ExportedAgent(str(tmp_path / "agent.onnx"), simulator)
    rms, greatest = flights.follow(simulator, agent, "figure_eight_2", 1, 0.0, 0)

    observation = env.reset()
    errors = []
    for _ in range(60):
        observation = env.step(model.predict(observation, deterministic=True)[0])[0]
        errors.append(env.true_state().distance)
    assert np.max(errors) > 0.1
    np.testing.assert_allclose(greatest, np.max(errors, axis=0), rtol=1e-3)
    np.testing.assert_allclose(rms, np.sqrt(np.mean(np.square(errors), axis=0)), rtol=1e-3)
