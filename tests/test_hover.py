"""Trimming at the hover: the agent gives hover thrust at its target with every heading, and flies
elsewhere as before.
"""

import numpy as np
import pytest
import torch as th
from stable_baselines3 import PPO

from sb3_quad.algorithms.offset_correction import correct_hover
from sb3_quad.base.errors import ConfigError
from sb3_quad.envs.vec_env import QuadcopterVecEnv
from sb3_quad.simulation.observation import DEFAULT_STD
from sb3_quad.simulation.settings import FlightSettings
from sb3_quad.simulation.state import QuadcopterState
from sb3_quad.vehicles.vehicle import load_vehicle


@pytest.fixture
def model():
    env = QuadcopterVecEnv(4, task="state_recovery", seed=1)
    model = PPO("MlpPolicy", env, n_steps=8, batch_size=8, seed=0, device="cpu")
    with th.no_grad():  # far from hover at the target, and differently for each heading
        model.policy.action_net.weight.mul_(30.0)
        model.policy.action_net.bias.copy_(th.tensor([0.1, -0.05, 0.02, 0.0]))
    return model


def at_target(heading):
    """Noise-free observations at the target, level and at rest, built from quaternions."""
    state = np.zeros((20, heading.size))
    state[3], state[6] = np.cos(heading / 2), np.sin(heading / 2)
    features = np.zeros((heading.size, 18))
    features[:, 3:12] = np.swapaxes(QuadcopterState(state).rotation, 1, 2).reshape(-1, 9)
    return (features / DEFAULT_STD).astype(np.float32)


def test_the_agent_hovers_at_its_target_with_every_heading(model):
    observations = at_target(np.linspace(-np.pi, np.pi, 50))
    before = model.predict(observations, deterministic=True)[0]
    result = correct_hover(model, seed=3, settings=FlightSettings(noise=0.0))
    after = model.predict(observations, deterministic=True)[0]
    assert np.square(after).mean() < 0.1 * np.square(before).mean()
    assert (
        result.before == pytest.approx(np.sqrt(np.square(before).mean()), rel=0.05)
        and result.after < result.before
    )


def test_hover_of_a_vehicle_whose_middle_thrust_is_another(model):
    observations = at_target(np.linspace(-np.pi, np.pi, 50))
    hover = load_vehicle("hummingbird").hover_action
    assert hover < -0.2
    result = correct_hover(model, seed=3, settings=FlightSettings(noise=0.0, vehicle="hummingbird"))
    after = model.predict(observations, deterministic=True)[0]
    assert np.square(after - hover).mean() < 0.1 * np.square(after).mean()
    assert result.after == pytest.approx(np.sqrt(np.square(after - hover).mean()), abs=0.02)


def test_only_the_last_layer_changes_and_the_zip_stays_stock(model, tmp_path):
    before = {key: value.clone() for key, value in model.policy.state_dict().items()}
    correct_hover(model, seed=3)
    changed = {
        key for key, value in model.policy.state_dict().items() if not th.equal(value, before[key])
    }
    assert changed == {"action_net.weight", "action_net.bias"}
    model.save(tmp_path / "agent.zip")
    observation = np.random.default_rng(0).normal(size=(5, 18)).astype(np.float32)
    np.testing.assert_array_equal(
        PPO.load(tmp_path / "agent.zip").predict(observation)[0].shape, (5, 4)
    )


def test_what_is_trimmed_already_is_left_alone(model):
    correct_hover(model, seed=3)
    weight = model.policy.action_net.weight.clone()
    again = correct_hover(model, seed=3)
    assert (
        again.before < 0.05
        and (model.policy.action_net.weight - weight).norm() < 0.05 * weight.norm()
    )


@pytest.mark.parametrize("shifted", ["observation_mean", "observation_std"])
def test_the_scaling_that_the_agent_flies_with_is_taken_into_account(model, shifted):
    """Observations at the target are other numbers with another μ or σ; there, too, the agent
    hovers afterwards.
    """
    scaling = {
        "observation_mean": np.zeros(18),
        "observation_std": DEFAULT_STD,
        shifted: np.linspace(0.5, 2.0, 18),
    }
    heading = at_target(np.linspace(-np.pi, np.pi, 50)) * DEFAULT_STD
    observations = ((heading - scaling["observation_mean"]) / scaling["observation_std"]).astype(
        np.float32
    )
    before = model.predict(observations, deterministic=True)[0]
    correct_hover(model, seed=3, settings=FlightSettings(noise=0.0, **scaling))
    after = model.predict(observations, deterministic=True)[0]
    assert np.square(after).mean() < 0.2 * np.square(before).mean()


def test_an_agent_of_other_observations_is_refused():
    with pytest.raises(ConfigError, match="18 features"):
        correct_hover(PPO("MlpPolicy", "Pendulum-v1", device="cpu"))
