"""The examples of Stable-Baselines3's documentation on our environments: another id, fewer steps, nothing else.

https://stable-baselines3.readthedocs.io, pages Getting Started, Examples, Callbacks, Vectorized Environments, PPO.
"""

import importlib
import warnings

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common import results_plotter
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback, EvalCallback, StopTrainingOnRewardThreshold
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.results_plotter import load_results, ts2xy
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

import sb3_quad  # noqa: F401 - registers the environments
from sb3_quad.envs import QuadcopterVecEnv

IDS = ("QuadTargetTracking-v0", "QuadStateRecovery-v0")
SMALL = {"n_steps": 64, "batch_size": 64, "n_epochs": 1, "device": "cpu"}

TASKS = {"QuadTargetTracking-v0": "target_tracking", "QuadStateRecovery-v0": "state_recovery"}

both = pytest.mark.parametrize("env_id", IDS)
one = pytest.mark.parametrize("env_id", IDS[1:])


@both
def test_check_env_finds_nothing(env_id):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gym.make(env_id).unwrapped)


@both
def test_getting_started(env_id):
    """Train, then fly the wrapped environment on, frames taken on the way."""
    env = gym.make(env_id, render_mode="rgb_array")
    model = PPO("MlpPolicy", env, **SMALL, verbose=0)
    model.learn(total_timesteps=64)
    vec_env = model.get_env()
    obs = vec_env.reset()
    for _ in range(3):
        action, _state = model.predict(obs, deterministic=True)
        obs, reward, done, _info = vec_env.step(action)
    assert obs.shape == (1, 18) and np.isfinite(reward).all() and done.shape == (1,)
    assert vec_env.render("rgb_array").shape == (480, 640, 3)


@both
def test_one_line(env_id):
    """The id alone as the environment."""
    model = PPO("MlpPolicy", env_id, **SMALL).learn(64)
    assert model.num_timesteps == 64
    assert model.get_env().env_is_wrapped(Monitor) == [True]


@both
def test_ppo_with_parallel_environments_saves_and_loads(env_id, tmp_path):
    vec_env = make_vec_env(env_id, n_envs=4)
    model = PPO("MlpPolicy", vec_env, **SMALL)
    model.learn(total_timesteps=256)
    model.save(tmp_path / "ppo_quad")
    obs = vec_env.reset()
    before, _ = model.predict(obs, deterministic=True)
    del model
    model = PPO.load(tmp_path / "ppo_quad", device="cpu")
    after, _ = model.predict(obs, deterministic=True)
    np.testing.assert_array_equal(before, after)
    model.set_env(vec_env)
    model.learn(256, reset_num_timesteps=False)
    assert model.num_timesteps == 512


@both
def test_evaluate_policy(env_id):
    model = PPO("MlpPolicy", env_id, **SMALL)
    rewards, lengths = evaluate_policy(model, Monitor(gym.make(env_id)), n_eval_episodes=3, return_episode_rewards=True)
    assert len(rewards) == len(lengths) == 3
    assert all(0 < length <= 1500 for length in lengths) and max(rewards) < 0
    mean, std = evaluate_policy(model, QuadcopterVecEnv(3, seed=0), n_eval_episodes=3, warn=False)
    assert mean < 0 <= std


@both
def test_eval_callback_keeps_the_best_model(env_id, tmp_path):
    vec_env, eval_env = make_vec_env(env_id, n_envs=2), make_vec_env(env_id, n_envs=1)
    below = StopTrainingOnRewardThreshold(reward_threshold=-1e9)
    callback = EvalCallback(
        eval_env,
        callback_on_new_best=below,
        best_model_save_path=str(tmp_path),
        log_path=str(tmp_path),
        eval_freq=64,
        n_eval_episodes=2,
        deterministic=True,
        render=False,
        verbose=0,
    )
    model = PPO("MlpPolicy", vec_env, **SMALL)
    model.learn(1024, callback=callback)
    assert model.num_timesteps == 128  # stopped by the first evaluation, which is above that threshold
    with np.load(tmp_path / "evaluations.npz") as file:
        assert file["timesteps"].tolist() == [128] and file["results"].shape == (1, 2)
        assert file["successes"].shape == (1, 2)  # is_success is in the infos
    PPO.load(tmp_path / "best_model.zip", device="cpu")


@one
def test_checkpoints(env_id, tmp_path):
    callback = CheckpointCallback(save_freq=64, save_path=str(tmp_path), name_prefix="rl_model", save_vecnormalize=True)
    PPO("MlpPolicy", VecNormalize(make_vec_env(env_id, n_envs=1)), **SMALL).learn(128, callback=callback)
    names = {path.name for path in tmp_path.iterdir()}
    assert {"rl_model_64_steps.zip", "rl_model_128_steps.zip", "rl_model_vecnormalize_64_steps.pkl"} <= names


@both
def test_vec_normalize_saves_and_loads(env_id, tmp_path):
    vec_env = VecNormalize(make_vec_env(env_id, n_envs=2), norm_obs=True, norm_reward=True, clip_obs=10.0)
    model = PPO("MlpPolicy", vec_env, **SMALL)
    model.learn(256)
    model.save(tmp_path / "model")
    vec_env.save(tmp_path / "vec_normalize.pkl")
    loaded = VecNormalize.load(str(tmp_path / "vec_normalize.pkl"), make_vec_env(env_id, n_envs=1))
    loaded.training = False
    loaded.norm_reward = False
    model = PPO.load(tmp_path / "model", env=loaded, device="cpu")
    obs = loaded.reset()
    assert obs.shape == (1, 18) and abs(obs).max() <= 10.0
    inside = abs(obs) < 10.0
    np.testing.assert_allclose(loaded.unnormalize_obs(obs)[inside], loaded.get_original_obs()[inside], atol=1e-4)
    loaded.step(model.predict(obs)[0])


class MeanDistance(BaseCallback):
    """Logs how far from its target an episode ended."""

    def __init__(self, verbose: int = 0) -> None:
        super().__init__(verbose)
        self.distances: list[float] = []
        self.calls: list[str] = []

    def _on_training_start(self) -> None:
        self.calls.append("start")

    def _on_rollout_end(self) -> None:
        self.calls.append("rollout")

    def _on_step(self) -> bool:
        self.distances += [info["distance"] for info in self.locals["infos"] if "episode" in info]
        self.logger.record("quad/distance", np.mean(self.distances) if self.distances else 0.0)
        return True

    def _on_training_end(self) -> None:
        self.calls.append("end")


@pytest.mark.parametrize("batched", [False, True])
@both
def test_custom_callback(env_id, batched, tmp_path):
    """With a logger of one's own, which writes what the callback records."""
    env = QuadcopterVecEnv(8, task=TASKS[env_id], seed=0) if batched else make_vec_env(env_id, n_envs=2)
    callback = MeanDistance()
    model = PPO("MlpPolicy", env, **{**SMALL, "n_steps": 512}, seed=0)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(512 * env.num_envs, callback=callback)
    assert callback.calls == ["start", "rollout", "end"]
    assert callback.distances and all(distance >= 0 for distance in callback.distances)
    names, values = (line.split(",") for line in (tmp_path / "progress.csv").read_text().splitlines())
    row = dict(zip(names, values, strict=True))
    assert float(row["quad/distance"]) == pytest.approx(np.mean(callback.distances))
    assert int(row["time/total_timesteps"]) == 512 * env.num_envs


@one
def test_record_video(env_id, tmp_path):
    """By Gymnasium's own wrapper; what it needs comes with the extra [video]."""
    pytest.importorskip("moviepy")
    made = gym.make(env_id, render_mode="rgb_array", max_episode_steps=5)
    env = gym.wrappers.RecordVideo(made, str(tmp_path / "films"), name_prefix="flight")
    env.reset(seed=0)
    while not any(env.step(env.action_space.sample())[2:4]):
        pass
    env.close()
    assert (tmp_path / "films" / "flight-episode-0.mp4").stat().st_size > 1000


@one
def test_monitor_files_and_plots(env_id, tmp_path):
    """Monitor writes, the results plotter reads and draws."""
    pytest.importorskip("pandas")
    plt = importlib.import_module("matplotlib.pyplot")
    env = Monitor(gym.make(env_id), str(tmp_path), info_keywords=("is_success", "distance"))
    PPO("MlpPolicy", env, **{**SMALL, "n_steps": 512}).learn(1024)
    results = load_results(str(tmp_path))
    x, y = ts2xy(results, "timesteps")
    assert len(x) == len(y) >= 1 and 0 < x[-1] <= 1024
    assert {"is_success", "distance"} <= set(results.columns)
    results_plotter.plot_results([str(tmp_path)], 1024, results_plotter.X_TIMESTEPS, "PPO")
    assert plt.gcf().axes
    plt.close("all")


@one
def test_processes_of_the_multiprocessing_example(env_id):
    def make_env(env_id: str, rank: int, seed: int = 0):
        def _init():

            env = gym.make(env_id, render_mode="rgb_array")
            env.reset(seed=seed + rank)
            return env

        set_random_seed(seed)
        return _init

    vec_env = SubprocVecEnv([make_env(env_id, i) for i in range(2)], start_method="fork")
    model = PPO("MlpPolicy", vec_env, **SMALL)
    model.learn(total_timesteps=128)
    obs = vec_env.reset()
    action, _states = model.predict(obs)
    obs, _rewards, _dones, _info = vec_env.step(action)
    assert obs.shape == (2, 18)
    vec_env.close()


@one
@pytest.mark.parametrize("algorithm", [SAC, TD3])
def test_off_policy_saves_its_replay_buffer(env_id, algorithm, tmp_path):
    noise = {"action_noise": NormalActionNoise(np.zeros(4), 0.1 * np.ones(4))} if algorithm is TD3 else {}
    model = algorithm("MlpPolicy", env_id, learning_starts=50, buffer_size=1000, device="cpu", **noise)
    model.learn(total_timesteps=60)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = algorithm.load(tmp_path / "model", device="cpu")
    assert loaded.replay_buffer.size() == 0
    loaded.load_replay_buffer(tmp_path / "buffer")
    assert loaded.replay_buffer.size() == model.replay_buffer.size()
    loaded.set_env(DummyVecEnv([lambda: gym.make(env_id)]))
    assert loaded.predict(loaded.get_env().reset(), deterministic=True)[0].shape == (1, 4)
