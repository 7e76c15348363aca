"""No training sees an episode that judges it, and no two seeds have anything in common."""

import itertools

import numpy as np
from hypothesis import example, given
from hypothesis import strategies as st

from sb3_quad.base.seeds import LARGEST, PURPOSES, row_seeds, seed_for
from sb3_quad.envs import QuadcopterVecEnv
from sb3_quad.evaluation.scenarios.load import load_suite
from sb3_quad.training.config import TrainingJob, build_config
from sb3_quad.training.environments import make_environments
from sb3_quad.training.trainer import train

seeds = st.integers(0, LARGEST - 1)


@given(seeds, seeds, st.integers(1, 64))
@example(
    524_288, 0, 64
)  # in version 0.1 such a training flew the episodes of the closing tables of seed 0
@example(0, 1, 64)  # and these two shared all streams but one
def test_seeds_and_purposes_share_no_stream(one, other, n):
    runs = {(purpose, seed) for purpose in PURPOSES for seed in (one, other)}
    streams = [row_seeds(seed_for(*run), n) for run in runs]
    assert len(set(itertools.chain(*streams))) == n * len(runs)
    assert streams == [row_seeds(seed_for(*run), n + 1)[:n] for run in runs]
    assert all(0 <= seed < 2**53 for stream in streams for seed in stream)


def test_rows_of_different_seeds_start_differently():
    env = QuadcopterVecEnv(480, task="state_recovery")
    starts = []
    for seed in (0, 1):
        env.seed(seed)
        env.reset()
        starts.append(env.true_state().velocity.copy())
    assert len(np.unique(np.concatenate(starts), axis=0)) == 960


def test_a_training_flies_the_same_episodes_in_either_environment():
    flown = []
    for vec_env in ("batch", "dummy"):
        settings = {
            "n_timesteps": 64,
            "n_envs": 3,
            "vec_env": vec_env,
            "env_kwargs": {"max_episode_steps": [3, 5]},
        }
        config = build_config("ppo", "QuadStateRecovery-v0", settings)
        env = make_environments(config, 3, seed_for("training", 5), staggered=True)
        env.seed(seed_for("training", 5))
        steps = [(env.reset(), np.zeros(3))] + [env.step(np.zeros((3, 4)))[::2] for _ in range(12)]
        flown.append([np.stack(each) for each in zip(*steps, strict=True)])
        env.close()
    (batch, ends), (single, single_ends) = flown
    np.testing.assert_allclose(batch, single, atol=1e-6)
    np.testing.assert_array_equal(ends, single_ends)
    assert ends.sum(axis=0).tolist() == [4, 2, 4]


def test_a_training_flies_none_of_the_episodes_of_a_suite(tmp_path):
    settings = {"n_timesteps": 64, "n_envs": 2, "n_steps": 32, "batch_size": 32, "n_epochs": 1}
    config = build_config("ppo", "QuadStateRecovery-v0", settings)
    suite = load_suite("quick").scenarios[0].episode_seeds()
    for seed in (0, 524_288):
        job = TrainingJob(config=config, log_folder=str(tmp_path), seed=seed, eval_episodes=0)
        batch = train(job, lambda line: None).model.get_env().unwrapped.batch
        keys = batch.streams[:2].copy()
        batch.seed(row_seeds(seed_for("training", seed), 2))
        np.testing.assert_array_equal(batch.streams[:2], keys)
        assert not set(row_seeds(seed_for("training", seed), 2)) & set(suite)
