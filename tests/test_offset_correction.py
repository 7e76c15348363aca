"""The offset correction cancels an offset, and changes nothing else."""

from functools import partial
from typing import Any

import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecNormalize

from sb3_quad.agents.pretrained import load_pretrained
from sb3_quad.base.errors import ConfigError
from sb3_quad.envs.vec_env import QuadcopterVecEnv
from sb3_quad.evaluation.flights import fly
from sb3_quad.evaluation.offset_correction import (
    correct_offset,
    first_layer,
    hover_offset,
    shift_position,
)


def measure(monkeypatch, *offsets):
    """Let the next measurements give these offsets, and then fail."""
    given = iter(offsets)

    def measured(*_, **__):
        offset = next(given, None)
        if offset is None:
            raise ConfigError("the agent crashes")
        return offset

    monkeypatch.setattr("sb3_quad.evaluation.offset_correction.hover_offset", measured)


def test_moved_and_scaled_positions_are_part_of_the_actor(monkeypatch):
    env = QuadcopterVecEnv(16, task="state_recovery", noise=0.0, seed=1)
    model = PPO("MlpPolicy", env, n_steps=8, batch_size=8, seed=0, device="cpu")
    observations, offset, std = env.reset(), np.array([0.3, -0.2, 0.5]), np.full(3, 10 / np.sqrt(3))
    moved, longer = observations.copy(), observations.copy()
    before = model.predict(observations, deterministic=True)[0]
    shift_position(first_layer(model), offset / std)
    moved[:, :3] -= (offset / std).astype(np.float32)
    np.testing.assert_allclose(model.predict(moved, deterministic=True)[0], before, atol=1e-5)
    longer[:, :3] /= 0.8
    before = model.predict(longer, deterministic=True)[0]
    measure(monkeypatch, *np.zeros((5, 3)))
    correct_offset(model, scale=0.8)
    np.testing.assert_allclose(
        model.predict(observations, deterministic=True)[0], before, atol=1e-5
    )


def test_the_correction_counts_the_scale_of_vec_normalize(monkeypatch):
    env: Any = VecNormalize(QuadcopterVecEnv(16, noise=0.0, seed=1))
    env.obs_rms.var[:] = 9.0
    model = PPO("MlpPolicy", env, n_steps=8, batch_size=8, seed=0, device="cpu")
    measure(monkeypatch, np.array([0.3, -0.2, 0.5]), *np.zeros((3, 3)))
    raw = env.venv.reset()
    moved = raw.copy()
    moved[:, :3] += (np.array([0.3, -0.2, 0.5]) / (10 / np.sqrt(3))).astype(np.float32)
    before = model.predict(env.normalize_obs(moved), deterministic=True)[0]
    correct_offset(model)
    after = model.predict(env.normalize_obs(raw), deterministic=True)[0]
    np.testing.assert_allclose(after, before, atol=1e-5)


def test_the_offset_of_an_agent_that_crashes_cannot_be_measured():
    model = PPO(
        "MlpPolicy", QuadcopterVecEnv(4, seed=1), n_steps=8, batch_size=8, seed=0, device="cpu"
    )
    with pytest.raises(ConfigError, match="cannot be measured"):
        hover_offset(model, n_episodes=8)


@pytest.mark.parametrize("scale", [np.nan, 0.5])
def test_a_correction_that_fails_leaves_the_agent_as_it_was(scale, monkeypatch):
    model = PPO("MlpPolicy", QuadcopterVecEnv(4, seed=1), n_steps=8, batch_size=8, device="cpu")
    measure(monkeypatch, np.ones(3))
    before = {name: values.clone() for name, values in model.policy.state_dict().items()}
    with pytest.raises(ConfigError):
        correct_offset(model, scale=scale)
    for name, values in model.policy.state_dict().items():
        assert values.equal(before[name])


@pytest.mark.slow
def test_the_correction_cancels_the_offset_of_a_trained_agent(monkeypatch):
    monkeypatch.setattr(
        "sb3_quad.evaluation.offset_correction.fly", partial(fly, max_episode_steps=700)
    )  # 7 s are enough to arrive
    model = load_pretrained("itm-imitation")
    shift_position(first_layer(model), np.array([0.5, 0.0, -0.5]) / (10 / np.sqrt(3)))
    assert np.linalg.norm(hover_offset(model, 40)) > 0.4
    result = correct_offset(model)
    assert result.before > 0.4 and result.after < 0.05
