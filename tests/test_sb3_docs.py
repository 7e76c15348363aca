"""Our environments in Stable-Baselines3's example Getting Started."""

import gymnasium as gym
import numpy as np
from stable_baselines3 import PPO

import sb3_quad  # noqa: F401 - registers the environments


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
