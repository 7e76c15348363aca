"""The Gymnasium vector environment: the same flights, with Gymnasium's autoreset."""

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import (
    ClipReward,
    DictInfoToList,
    NormalizeObservation,
    NormalizeReward,
    RecordEpisodeStatistics,
)

import sb3_quad  # noqa: F401  (registers the environments)
from sb3_quad.base.seeds import row_seeds
from sb3_quad.envs.vec_env import QuadcopterVecEnv


def make(num_envs=8, **kwargs):
    return gymnasium.make_vec(
        "QuadTargetTracking-v0",
        num_envs=num_envs,
        vectorization_mode="vector_entry_point",
        **kwargs,
    )


def test_it_is_made_by_gymnasium():
    env = make(3, noise=0.0)
    assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    assert (env.unwrapped.batch.max_steps == 1500).all() and env.spec.max_episode_steps == 1500
    observations, infos = env.reset(seed=1)
    assert observations in env.observation_space and infos["distance"].tolist() == pytest.approx(
        [10.0] * 3
    )
    assert env.observation_space.shape == (3, 18) and env.action_space.shape == (3, 4)
    batch = QuadcopterVecEnv(3, seed=1, noise=0.0)
    np.testing.assert_array_equal(observations, batch.reset())
    for _ in range(20):
        actions = env.action_space.sample()
        for ours, theirs in zip(env.step(actions)[:2], batch.step(actions)[:2], strict=True):
            np.testing.assert_array_equal(ours, theirs)
    env.close()
    recovery = gymnasium.make_vec(
        "QuadStateRecovery-v0", num_envs=2, vectorization_mode="vector_entry_point"
    )
    recovery.reset(seed=0)
    assert recovery.unwrapped.true_state().velocity.any()


def test_seeds():
    env = make(3, noise=0.0)
    first, _ = env.reset(seed=5)
    second, _ = env.reset()
    assert not np.allclose(first, second)
    np.testing.assert_array_equal(env.reset(seed=row_seeds(5, 3))[0], first)


def same(ours, theirs):
    """Whether infos agree, key by key and row by row."""
    assert ours.keys() == theirs.keys()
    for key, value in theirs.items():
        if isinstance(value, dict):
            same(ours[key], value)
        elif value.dtype == object:  # the last observations, None where no episode has ended
            assert [row is None for row in ours[key]] == [row is None for row in value]
            for got, expected in zip(ours[key], value, strict=True):
                assert expected is None or np.abs(got - expected).max() < 2e-6
        else:
            np.testing.assert_allclose(ours[key], value, atol=1e-8)


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_autoreset_modes_equal_those_of_gymnasiums_vector_environment(mode):
    kwargs = {
        "task_kwargs": {"max_distance": 10.02},
        "max_episode_steps": 25,
    }  # some fall out of range, others stay
    env = make(4, autoreset_mode=mode, **kwargs)
    singles = gymnasium.vector.SyncVectorEnv(
        [lambda: gymnasium.make("QuadTargetTracking-v0", **kwargs) for _ in range(4)],
        autoreset_mode=mode,
    )
    assert env.metadata["autoreset_mode"] is mode
    (ours, our_infos), (theirs, their_infos) = (
        env.reset(seed=3),
        singles.reset(seed=row_seeds(3, 4)),
    )
    np.testing.assert_allclose(ours, theirs, atol=2e-6)
    same(our_infos, their_infos)
    terminations, truncations, actions = 0, 0, -np.ones((4, 4), dtype=np.float32)
    for _ in range(60):
        ours, theirs = env.step(actions), singles.step(actions)
        for got, expected in zip(ours[:4], theirs[:4], strict=True):
            np.testing.assert_allclose(got, expected, atol=2e-6)
        same(ours[4], theirs[4])
        terminations, truncations = terminations + ours[2].sum(), truncations + ours[3].sum()
    assert terminations > 2 and truncations > 2
    singles.close()


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_gymnasiums_wrappers_count_each_episode_once(mode):
    env = RecordEpisodeStatistics(make(4, max_episode_steps=10, autoreset_mode=mode))
    wrapped = NormalizeReward(ClipReward(env, -1.0, 0.0))
    if mode == "NextStep":  # which this one demands
        wrapped = NormalizeObservation(wrapped)
    wrapped.reset(seed=0)
    for _ in range(35):
        observations, rewards, *_ = wrapped.step(np.zeros((4, 4)))
        assert np.isfinite(observations).all() and np.isfinite(rewards).all()
    assert list(env.length_queue) == [10] * 12 and env.return_queue[0] == pytest.approx(
        -0.3, abs=0.01
    )
    assert len(DictInfoToList(make(4)).reset(seed=0)[1]) == 4
