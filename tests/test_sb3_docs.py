"""Our environments in Stable-Baselines3's checker, and in its example Getting Started."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env

import sb3_quad  # noqa: F401 - registers the environments


@pytest.mark.parametrize("env_id", ["QuadTargetTracking-v0", "QuadStateRecovery-v0"])
def test_check_env_finds_nothing(env_id):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gym.make(env_id).unwrapped)


def test_getting_started(tmp_path):
    """Train, save, load, then fly on."""
    env = gym.make("QuadStateRecovery-v0")
    model = PPO("MlpPolicy", env, n_steps=64, batch_size=64, n_epochs=1, device="cpu")
    model.learn(total_timesteps=64).save(tmp_path / "ppo_quad")
    vec_env = PPO.load(tmp_path / "ppo_quad", env=env, device="cpu").get_env()
    obs = vec_env.reset()
    action, _state = model.predict(obs, deterministic=True)
    obs, reward, done, _info = vec_env.step(action)
    assert obs.shape == (1, 18) and np.isfinite(reward).all() and done.shape == (1,)
