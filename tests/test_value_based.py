"""Stock SAC and TD3 as runs: resumed, described, refused in a line; their zips as agents."""

import signal

import numpy as np
import pytest
import torch as th
from stable_baselines3 import SAC

from sb3_quad import QuadcopterVecEnv
from sb3_quad.agents.zips import load_model, load_zip, saved_algorithm
from sb3_quad.training.config import TrainingJob, build_config, describe, load_config
from sb3_quad.training.trainer import resume, train

ENV = "QuadStateRecovery-v0"
TINY = {
    "n_timesteps": 800,
    "n_envs": 8,
    "buffer_size": 256,  # less than the training flies
    "batch_size": 16,
    "train_freq": 5,
    "gradient_steps": 2,
    "learning_starts": 0,
    "policy_kwargs": {"net_arch": [8]},
    "env_kwargs": {"max_episode_steps": 12},
}
CASES = {"sac": {}, "td3": {"noise_type": "normal"}}


def make_job(folder, algo, **changes):
    config = build_config(algo, ENV, {**TINY, **CASES[algo], **changes})
    return TrainingJob(
        config=config, log_folder=str(folder), eval_freq=120, eval_episodes=4, seed=5
    )


@pytest.mark.parametrize("algo", CASES)
def test_an_interrupted_run_goes_on_to_the_same_agent(tmp_path, algo):
    """Also with a replay buffer that is full."""
    whole = train(make_job(tmp_path / "whole", algo), print)
    assert whole.model.replay_buffer.full and saved_algorithm(whole.run.model) == algo.upper()
    count = iter(range(1, 100))

    def interrupt(*_):
        return next(count) != 4 or not signal.raise_signal(signal.SIGINT)

    broken = train(make_job(tmp_path / "broken", algo), print, should_continue=interrupt)
    assert broken.exit_code == 130
    assert 0 < int(np.load(broken.run.resume_state)["timesteps"]) < 800
    again = resume(str(broken.run.path), print).run
    mine, theirs = (load_model(run.model).policy.state_dict() for run in (again, whole.run))
    assert all(th.equal(mine[name], theirs[name]) for name in theirs)


def test_n_step_returns_are_loaded_without_a_warning(tmp_path, recwarn):
    settings = {"n_steps": 3, "gamma": 0.9, "buffer_size": 40, "device": "cpu"}
    SAC("MlpPolicy", QuadcopterVecEnv(4), **settings).save(tmp_path / "sac.zip")
    buffer = load_zip(SAC, tmp_path / "sac.zip", env=QuadcopterVecEnv(4)).replay_buffer
    assert (buffer.n_steps, buffer.gamma) == (3, 0.9) and not recwarn.list


@pytest.mark.parametrize("algo", CASES)
def test_settings_of_the_package_describe_a_training_of_rows_with_gradient_steps(algo):
    config = load_config(algo, ENV)
    assert config.is_off_policy and config.rollout_steps * config.n_envs >= 480
    line = describe(TrainingJob(config=config))
    assert f"{algo} on {ENV}: " in line
    short = load_config(algo, ENV, overrides={"n_timesteps": config.n_envs})
    assert short.rollout_steps == 1
    # Of the returns: they stay.
    assert short.keyword("n_steps") == config.keyword("n_steps")
