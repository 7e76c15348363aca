"""Our environments in the examples of Stable-Baselines3's documentation: another id, fewer steps, nothing else.

https://stable-baselines3.readthedocs.io, pages Getting Started, Examples, Callbacks, Vectorized Environments, PPO.
"""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import EvalCallback, StopTrainingOnRewardThreshold
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import SubprocVecEnv, VecNormalize

import sb3_quad  # noqa: F401 - registers the environments
from sb3_quad.envs import QuadcopterVecEnv

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


@pytest.mark.parametrize("env_id", IDS)
def test_the_id_alone_trains_and_is_evaluated(env_id):
    model = PPO("MlpPolicy", env_id, **SMALL).learn(64)
    assert model.get_env().env_is_wrapped(Monitor) == [True]
    rewards, lengths = evaluate_policy(model, Monitor(gym.make(env_id)), n_eval_episodes=2, return_episode_rewards=True)
    assert all(0 < length <= 1500 for length in lengths) and max(rewards) < 0
    mean, std = evaluate_policy(model, QuadcopterVecEnv(3, seed=0), n_eval_episodes=3, warn=False)
    assert mean < 0 <= std


def test_eval_callback_logs_successes(tmp_path):
    below = StopTrainingOnRewardThreshold(reward_threshold=-1e9)
    callback = EvalCallback(
        make_vec_env(RECOVERY, n_envs=1),
        callback_on_new_best=below,
        log_path=str(tmp_path),
        eval_freq=64,
        n_eval_episodes=2,
        verbose=0,
    )
    model = PPO("MlpPolicy", make_vec_env(RECOVERY, n_envs=2), **SMALL).learn(1024, callback=callback)
    assert model.num_timesteps == 128  # stopped by the first evaluation, which is above that threshold
    with np.load(tmp_path / "evaluations.npz") as file:
        assert file["successes"].shape == (1, 2)  # is_success is in the infos


def test_vec_normalize_saves_and_loads(tmp_path):
    vec_env = VecNormalize(make_vec_env(RECOVERY, n_envs=2), norm_obs=True, norm_reward=True, clip_obs=10.0)
    model = PPO("MlpPolicy", vec_env, **SMALL).learn(256)
    vec_env.save(tmp_path / "vec_normalize.pkl")
    loaded = VecNormalize.load(str(tmp_path / "vec_normalize.pkl"), make_vec_env(RECOVERY, n_envs=1))
    loaded.training = loaded.norm_reward = False
    obs = loaded.reset()
    inside = abs(obs) < 10.0
    np.testing.assert_allclose(loaded.unnormalize_obs(obs)[inside], loaded.get_original_obs()[inside], atol=1e-4)
    loaded.step(model.predict(obs)[0])


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


@pytest.mark.slow
def test_processes_of_the_multiprocessing_example():
    vec_env = SubprocVecEnv([lambda: gym.make(RECOVERY, render_mode="rgb_array") for _ in range(2)], start_method="fork")
    model = PPO("MlpPolicy", vec_env, **SMALL).learn(total_timesteps=128)
    action, _states = model.predict(vec_env.reset())
    assert vec_env.step(action)[0].shape == (2, 18)
    vec_env.close()
