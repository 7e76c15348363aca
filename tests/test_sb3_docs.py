"""Our environments in the examples of Stable-Baselines3's documentation: another id, fewer steps,
nothing else.

https://stable-baselines3.readthedocs.io, pages Getting Started, Examples, Callbacks, Vectorized
Environments, PPO.
"""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env

import sb3_quad  # noqa: F401 - registers the environments

IDS = ("QuadTargetTracking-v0", "QuadStateRecovery-v0")
RECOVERY = IDS[1]
SMALL = {"n_steps": 64, "batch_size": 64, "n_epochs": 1, "device": "cpu"}


@pytest.mark.parametrize("env_id", IDS)
def test_check_env_finds_nothing(env_id):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gym.make(env_id).unwrapped)


def test_getting_started(tmp_path):
    """Train, save, load, then fly on, with a frame taken on the way."""
    env = gym.make(RECOVERY, render_mode="rgb_array")
    PPO("MlpPolicy", env, **SMALL).learn(total_timesteps=64).save(tmp_path / "ppo_quad")
    model = PPO.load(tmp_path / "ppo_quad", env=env, device="cpu")
    vec_env = model.get_env()
    obs = vec_env.reset()
    for _ in range(3):
        action, _state = model.predict(obs, deterministic=True)
        obs, reward, done, _info = vec_env.step(action)
    assert obs.shape == (1, 18) and np.isfinite(reward).all() and done.shape == (1,)
    assert vec_env.render("rgb_array").shape == (480, 640, 3)


@pytest.mark.slow
def test_record_video(tmp_path):
    """By Gymnasium's own wrapper; what it needs comes with the extra [video]."""
    pytest.importorskip("moviepy")
    made = gym.make(RECOVERY, render_mode="rgb_array", max_episode_steps=5)
    env = gym.wrappers.RecordVideo(made, str(tmp_path / "films"), name_prefix="flight")
    env.reset(seed=0)
    while not any(env.step(env.action_space.sample())[2:4]):
        pass
    env.close()
    assert (tmp_path / "films" / "flight-episode-0.mp4").stat().st_size > 1000
