"""Anybody's batch as an environment of SB3: it gives what SB3's own DummyVecEnv gives."""

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_quad import DAgger
from sb3_quad.base.errors import ConfigError
from sb3_quad.envs import BatchVecEnv

SPACES = (spaces.Box(-np.inf, np.inf, (2,), np.float32), spaces.Box(-1.0, 1.0, (1,), np.float32))
LIMIT = 7


class Row(gymnasium.Env):
    """A number that actions move, one at a time: it fails beyond 2."""

    observation_space, action_space = SPACES

    def reset(self, *, seed=None, options=None):
        self.state = np.zeros(2, np.float32)
        return self.state.copy(), {}

    def step(self, action):
        self.state += (float(action[0]), 1.0)
        return self.state.copy(), -abs(float(self.state[0])), abs(self.state[0]) > 2.0, False, {}


class Rows(BatchVecEnv):
    """The same, all together and in place."""

    max_episode_steps = LIMIT

    def __init__(self, n_envs):
        super().__init__(n_envs, *SPACES)
        self.state = np.zeros((n_envs, 2))

    def begin(self, rows):
        self.state[rows] = 0.0
        return self.state[rows]

    def advance(self, actions):
        self.state += np.hstack([actions, np.ones_like(actions)])
        return self.state, -np.abs(self.state[:, 0]), np.abs(self.state[:, 0]) > 2.0


def test_environments_share_no_random_numbers():
    first, second = Rows(2), Rows(2)
    assert first.rng is not second.rng
    first.seed(3)
    second.seed(3)
    assert first.rng.normal() == second.rng.normal()


def test_it_is_what_sb3_makes_of_single_environments():
    batch = Rows(5)
    single = make_vec_env(
        Row, 5, wrapper_class=gymnasium.wrappers.TimeLimit, wrapper_kwargs={"max_episode_steps": 7}
    )
    # SB3 wraps by Monitor first, so that its sums lack the ends of episodes that are too long.
    np.testing.assert_array_equal(batch.reset(), single.reset())
    rng = np.random.default_rng(0)
    ended = {True: 0, False: 0}
    kept = []
    for _ in range(60):
        actions = rng.uniform(-1.0, 1.0, (5, 1)).astype(np.float32)
        ours, theirs = batch.step(actions), single.step(actions)
        for mine, its in zip(ours[:3], theirs[:3], strict=True):
            np.testing.assert_allclose(mine, its, atol=1e-6)
            assert mine.dtype == its.dtype
        for info, its in zip(ours[3], theirs[3], strict=True):
            assert ("terminal_observation" in info) == ("terminal_observation" in its)
            if info:
                np.testing.assert_allclose(
                    info["terminal_observation"], its["terminal_observation"], atol=1e-6
                )
                assert info["TimeLimit.truncated"] == its["TimeLimit.truncated"]
                ended[info["TimeLimit.truncated"]] += 1
                if "episode" in its:
                    assert info["episode"]["l"] == its["episode"]["l"]
                    assert info["episode"]["r"] == pytest.approx(its["episode"]["r"], abs=1e-5)
        kept.append((ours[0], ours[0].copy()))
    assert min(ended.values()) > 5
    # Later steps change no observation that was given before.
    assert all(np.array_equal(given, copy) for given, copy in kept)


@pytest.mark.parametrize("kind", [PPO, SAC, DAgger])
def test_sb3_and_our_algorithms_train_in_it(kind):
    keywords = {"expert": lambda seen: -seen[:, :1]} if kind is DAgger else {}
    if kind is not SAC:
        keywords |= {"n_steps": 16, "batch_size": 32}
    model = kind("MlpPolicy", VecNormalize(Rows(4)), seed=0, device="cpu", **keywords)
    model.learn(256)
    assert len(model.ep_info_buffer) > 10


def test_steps_wait_for_the_first_reset():
    env = Rows(2)
    with pytest.raises(ResetNeeded, match="reset"):
        env.step(np.zeros((2, 1), np.float32))
    assert not env.state.any()


def test_its_random_numbers_follow_the_seed():
    class Random(Rows):
        def begin(self, rows):
            self.state[rows] = self.rng.normal(size=(len(rows), 2))
            return self.state[rows]

    env = Random(3)
    first = [env.seed(5), env.reset()][1]
    second = env.reset()
    assert np.array_equal([env.seed(5), env.reset()][1], first)
    assert not np.array_equal(first, second)


@pytest.mark.parametrize(
    ("place", "change", "name"),
    [
        (0, lambda seen: seen[:1], "observations"),
        (0, lambda seen: seen + np.nan, "observations"),
        (1, lambda gained: gained[:, None], "rewards"),
        (2, lambda failed: None, "terminated"),
    ],
)
def test_what_advance_returns_is_checked(place, change, name):
    class Wrong(Rows):
        def advance(self, actions):
            given = [*super().advance(actions)]
            given[place] = change(given[place])
            return given

    env = Wrong(3)
    env.reset()
    with pytest.raises(ConfigError, match=f"advance: {name}"):
        env.step(np.zeros((3, 1), np.float32))


@pytest.mark.parametrize("given", [None, np.zeros(2), np.full((3, 2), np.nan), "near"])
def test_what_begin_returns_is_checked(given):
    class Wrong(Rows):
        def begin(self, rows):
            return given

    with pytest.raises(ConfigError, match="begin: observations"):
        Wrong(3).reset()
