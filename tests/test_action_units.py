"""Actions in other units than [-1, 1]: refused, or converted by a wrapper as labels are."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env

from sb3_quad import PPOBC, DAgger
from sb3_quad.algorithms.labelling import Labeller
from sb3_quad.base.errors import ConfigError, ExpertError


def swing_back(observation):
    return -0.5 * observation[:, 2:3]


def test_actions_beyond_one_are_refused_where_cloning_would_begin():
    """Pendulum's torque goes from -2 to 2."""
    learners = [
        lambda: DAgger("MlpPolicy", "Pendulum-v1"),
        lambda: PPOBC("MlpPolicy", "Pendulum-v1", expert=swing_back),
        lambda: PPOBC("MlpPolicy", "Pendulum-v1", bc_coef=0.0).set_bc_coef(0.1),
    ]
    for learner in learners:
        with pytest.raises((ConfigError, ExpertError)) as raised:
            learner()
        assert "\n" not in str(raised.value)
    with pytest.raises(ConfigError, match="RescaleAction"):
        learners[0]()
    # Without cloning it is PPO, which takes any actions.
    PPOBC("MlpPolicy", "Pendulum-v1", bc_coef=0.0)


def test_actions_of_two_dimensions_are_cloned():
    def stacked():
        space = spaces.Box(-1.0, 1.0, (1, 1), np.float32)
        return gym.wrappers.TransformAction(gym.make("UnitPendulum-v0"), np.ravel, space)

    def expert(observation):
        return swing_back(observation)[:, :, None]

    sizes = {"n_steps": 50, "batch_size": 100, "seed": 0, "device": "cpu"}
    flat = make_vec_env("UnitPendulum-v0", 4, seed=0)
    theirs = PPOBC("MlpPolicy", flat, expert=swing_back, **sizes).learn(400)
    mine = PPOBC("MlpPolicy", make_vec_env(stacked, 4, seed=0), expert=expert, **sizes).learn(400)
    for one, other in zip(mine.policy.parameters(), theirs.policy.parameters(), strict=True):
        assert th.equal(one, other)


# Wrappers between an expert and what it speaks of


def rescaled(low, high):
    def wrap(env):
        return gym.wrappers.RescaleAction(env, np.float32(low), np.float32(high))

    return wrap


class Speeds(gym.ActionWrapper):
    """Takes rotor speeds, whose squares are thrusts."""

    def __init__(self, env):
        super().__init__(env)
        self.action_space = spaces.Box(0.0, 1.0, env.action_space.shape)

    def action(self, action):
        return 2.0 * np.square(action) - 1.0


class Renumbered(gym.ActionWrapper):
    """Keeps the space and takes the rotors in another order."""

    def action(self, action):
        return action[[1, 0, 3, 2]]


def quadcopters(wrapper):
    return make_vec_env("QuadTargetTracking-v0", 2, seed=0, wrapper_class=wrapper)


def test_an_expert_of_the_true_state_flies_the_same_through_rescaled_actions():
    flown = []
    for wrapper in (None, rescaled(0.0, 1.0)):
        env = quadcopters(wrapper)
        labeller = Labeller("pid", env)
        observation = env.reset()
        for _ in range(30):
            observation, *_ = env.step(labeller.labels(observation))
        flown.append(observation)
    np.testing.assert_allclose(flown[1], flown[0], atol=1e-4)


def test_a_model_that_has_learnt_without_the_wrapper_teaches_through_it():
    teacher = PPO("MlpPolicy", make_vec_env("Pendulum-v1", 2), seed=1, device="cpu")
    with th.no_grad():
        teacher.policy.action_net.bias += 1.5
    env = make_vec_env("Pendulum-v1", 2, seed=0, wrapper_class=rescaled(0.0, 1.0))
    observation = env.reset()
    torques, _ = teacher.predict(observation, deterministic=True)
    labels = Labeller(teacher, env).labels(observation)
    np.testing.assert_allclose(labels, (torques + 2.0) / 4.0, rtol=1e-5)


@pytest.mark.parametrize("wrapper", [Speeds, Renumbered])
def test_labels_that_no_wrapper_takes_are_refused(wrapper):
    with pytest.raises(ExpertError, match="RescaleAction") as raised:
        DAgger("MlpPolicy", quadcopters(wrapper), expert="pid")
    assert "\n" not in str(raised.value)
