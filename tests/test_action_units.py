"""Actions in other units than [-1, 1]: losses, labels and new actors count them in [-1, 1]."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_quad import PPOBC, DAgger
from sb3_quad.algorithms import dagger, ppo_bc
from sb3_quad.algorithms.controller import Controller
from sb3_quad.algorithms.losses import CLONING_LOSSES
from sb3_quad.base.errors import ConfigError, ExpertError

BOXES = {"torque": (-0.002, 0.002), "PWM": (1000.0, 2000.0), "rpm": (0.0, 21702.0)}
SIZES = {"n_steps": 50, "batch_size": 100, "seed": 0, "device": "cpu"}


class Height(gym.Env):
    """A mass on a vertical rail; two throttles between limits, whose middle is hover.

    The second one has no effect. It makes errors of the two differ.
    """

    def __init__(self, low=-1.0, high=1.0, dtype="float32"):
        self.observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)
        self.action_space = spaces.Box(low, high, (2,), dtype)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = np.array([self.np_random.uniform(-1.0, 1.0), 0.0])
        self.steps = 0
        return self.state.astype(np.float32), {}

    def step(self, action):
        space: Any = self.action_space
        low, high = space.low[0], space.high[0]
        push = 2.0 * (float(action[0]) - low) / (high - low) - 1.0
        self.state[1] += 0.3 * push
        self.state[0] += 0.1 * self.state[1]
        self.steps += 1
        height = float(self.state[0])
        return self.state.astype(np.float32), -abs(height), abs(height) > 5, self.steps >= 50, {}


def throttle(low, high):
    def expert(observation):
        push = np.clip(-1.5 * observation[:, 0] - 1.2 * observation[:, 1], -1.0, 1.0)
        return low + (high - low) * (np.stack([push, -0.3 * push], axis=1) + 1.0) / 2.0

    return expert


def trained(algorithm, low, high, dtype="float32", steps=800, **keywords):
    env = make_vec_env(Height, 8, seed=0, env_kwargs={"low": low, "high": high, "dtype": dtype})
    keywords = {**SIZES, **keywords}
    return algorithm("MlpPolicy", env, expert=throttle(low, high), **keywords).learn(steps)


def unit_actions(model, observations):
    """Mean actions of a model, as a stock PPO with its zip gives them, from -1 to 1."""
    space = model.action_space
    with th.no_grad():
        mean = model.policy.get_distribution(th.as_tensor(observations)).mode().double().numpy()
    return (2.0 * mean - space.high - space.low) / (space.high - space.low)


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize("algorithm", [DAgger, PPOBC])
@pytest.mark.parametrize(
    ("box", "bc_loss"),
    [*(("PWM", kind) for kind in CLONING_LOSSES), ("torque", "huber"), ("rpm", "nll")],
)
def test_a_training_in_other_units_is_the_one_with_unit_actions(
    monkeypatch, box, compiled, algorithm, bc_loss
):
    if not compiled:
        for module in (dagger, ppo_bc):
            monkeypatch.setattr(module, "network_of", lambda policy: policy)
    keywords = {"bc_loss": bc_loss}
    if algorithm is PPOBC:
        keywords |= {"bc_coef": 1.0, "critic_warmup": 0, "ent_coef": 0.01, "l2_coef": 1e-4}
    plain = trained(algorithm, -1.0, 1.0, **keywords)
    other = trained(algorithm, *BOXES[box], **keywords)
    seen = np.random.default_rng(0).normal(size=(100, 2)).astype(np.float32)
    np.testing.assert_allclose(unit_actions(other, seen), unit_actions(plain, seen), atol=0.01)
    half = 0.5 * (BOXES[box][1] - BOXES[box][0])
    stds = [model.policy.log_std.detach().exp().numpy() for model in (plain, other)]
    np.testing.assert_allclose(stds[1] / half, stds[0], rtol=0.01)


def test_a_cloning_weight_that_ends_leaves_the_units(tmp_path):
    models = []
    for low, high in ((-1.0, 1.0), BOXES["torque"]):
        model = trained(PPOBC, low, high, critic_warmup=0, bc_filter="none")
        model.set_bc_coef(0.0)
        model.save(tmp_path / "agent.zip")
        model = PPOBC.load(tmp_path / "agent.zip", env=model.get_env(), device="cpu")
        models.append(model.learn(400, reset_num_timesteps=False))
    seen = np.random.default_rng(0).normal(size=(100, 2)).astype(np.float32)
    plain, other = (unit_actions(model, seen) for model in models)
    np.testing.assert_allclose(other, plain, atol=0.02)


def test_actions_of_two_dimensions_are_cloned():
    def stacked():
        return gym.wrappers.TransformAction(
            Height(), np.ravel, spaces.Box(-1.0, 1.0, (2, 1), np.float32)
        )

    def expert(observation):
        return throttle(-1.0, 1.0)(observation)[:, :, None]

    env = make_vec_env(stacked, 8, seed=0)
    flat = trained(PPOBC, -1.0, 1.0)
    model = PPOBC("MlpPolicy", env, expert=expert, **SIZES).learn(800)
    for mine, theirs in zip(model.policy.parameters(), flat.policy.parameters(), strict=True):
        assert th.equal(mine, theirs)


@pytest.mark.parametrize("box", BOXES)
@pytest.mark.parametrize("algorithm", [DAgger, PPOBC])
def test_the_agent_becomes_the_expert_in_any_units(box, algorithm):
    keywords = {"learning_rate": 3e-3}
    if algorithm is PPOBC:
        keywords |= {"bc_coef": 10.0, "bc_filter": "none"}  # cloning decides, not the reward
    model = trained(algorithm, *BOXES[box], steps=8000, **keywords)
    seen = np.random.default_rng(0).uniform(-0.5, 0.5, size=(100, 2)).astype(np.float32)
    wanted = throttle(-1.0, 1.0)(seen)
    assert np.sqrt(np.square(unit_actions(model, seen) - wanted).mean()) < 0.15


def test_the_dataset_holds_actions_in_the_units_of_the_environment():
    labels = trained(DAgger, 1000.0, 2000.0).dataset.pairs["actions"]
    assert labels.min() >= 1000.0 and labels.max() <= 2000.0


def test_state_dependent_exploration_in_other_units():
    keywords = {"bc_coef": 1.0, "use_sde": True, "critic_warmup": 0}
    plain = trained(PPOBC, -1.0, 1.0, **keywords)
    other = trained(PPOBC, 1000.0, 2000.0, **keywords)
    seen = np.random.default_rng(0).normal(size=(100, 2)).astype(np.float32)
    np.testing.assert_allclose(unit_actions(other, seen), unit_actions(plain, seen), atol=0.02)


@pytest.mark.parametrize("policy_kwargs", [{"use_expln": True}, {"full_std": False}])
def test_deviations_that_cannot_be_scaled_are_refused_in_other_units_alone(policy_kwargs):
    keywords = {"use_sde": True, "policy_kwargs": policy_kwargs, **SIZES}
    PPOBC("MlpPolicy", Height(), **keywords)
    with pytest.raises(ConfigError, match="RescaleAction") as raised:
        PPOBC("MlpPolicy", Height(0.0, 3.0), **keywords)
    assert "\n" not in str(raised.value)


def test_a_stock_ppo_flies_the_zip_in_the_units_of_the_environment(tmp_path):
    model = trained(DAgger, 1000.0, 2000.0)
    model.save(tmp_path / "agent.zip")
    observation = np.zeros((1, 2), np.float32)
    stock = PPO.load(tmp_path / "agent.zip", device="cpu").predict(observation, deterministic=True)
    again = DAgger.load(tmp_path / "agent.zip", device="cpu").predict(
        observation, deterministic=True
    )
    np.testing.assert_array_equal(stock[0], again[0])
    assert 1000.0 < stock[0].min() < stock[0].max() < 2000.0


@pytest.mark.parametrize("algorithm", [DAgger, PPOBC])
def test_a_box_without_limits_is_refused(algorithm):
    with pytest.raises(ConfigError, match="limits of the actuators") as raised:
        algorithm("MlpPolicy", Height(-3e38, 3e38))
    assert "\n" not in str(raised.value)
    with pytest.raises(AssertionError, match="finite lower and upper bound"):  # SB3's own
        algorithm("MlpPolicy", Height(-np.inf, np.inf))


def test_an_action_that_cannot_change_is_learnt():
    class Fixed(Height):
        def __init__(self):
            super().__init__()
            self.action_space = spaces.Box(np.float32([-3, 7]), np.float32([5, 7]))

    def expert(observation):
        return np.full((len(observation), 2), [1.0, 7.0])

    model = DAgger("MlpPolicy", Fixed(), expert=expert, **SIZES).learn(1000)
    actions, _ = model.predict(np.zeros((1, 2), np.float32), deterministic=True)
    np.testing.assert_allclose(actions, [[1.0, 7.0]], atol=0.2)


class OddLayer(th.nn.Module):
    def forward(self, latent):
        return latent[:, :2]


class OddPolicy(ActorCriticPolicy):
    """Gives two of its hidden units as actions."""

    def _build(self, lr_schedule):
        super()._build(lr_schedule)
        self.action_net = OddLayer()


def test_an_actor_that_cannot_be_scaled_is_refused_in_other_units_alone():
    DAgger(OddPolicy, Height(), device="cpu")
    with pytest.raises(ConfigError, match="RescaleAction") as raised:
        DAgger(OddPolicy, Height(0.0, 3.0), device="cpu")
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("algorithm", [DAgger, PPOBC])
def test_an_initial_policy_of_other_units_is_refused(algorithm):
    with pytest.raises(ConfigError, match="its actions are of"):
        algorithm("MlpPolicy", Height(), initial_policy=PPO("MlpPolicy", Height(0.0, 1.0)))


# Wrappers between an expert and what it speaks of


def rescaled(low, high):
    def wrap(env):
        return gym.wrappers.RescaleAction(env, np.float32(low), np.float32(high))

    return wrap


class Doubled(gym.ActionWrapper):
    """Takes actions in [-2, 2] and gives something that is not linear."""

    def __init__(self, env):
        super().__init__(env)
        self.action_space = spaces.Box(-2.0, 2.0, env.action_space.shape)

    def action(self, action):
        return np.sign(action) * np.sqrt(np.abs(action) / 8.0)


class Speeds(gym.ActionWrapper):
    """Takes rotor speeds, whose squares are thrusts."""

    def __init__(self, env):
        super().__init__(env)
        self.action_space = spaces.Box(0.0, 1.0, env.action_space.shape)

    def action(self, action):
        return 2.0 * np.square(action) - 1.0


class Throttles(Speeds):
    """Takes throttles in another order of motors."""

    def action(self, action):
        return 2.0 * action[[3, 1, 2, 0]] - 1.0


class Renumbered(gym.ActionWrapper):
    """Keeps the space and takes the rotors in another order."""

    def action(self, action):
        return action[[1, 0, 3, 2]]


class Below(gym.ActionWrapper):
    """Another wrapper that keeps the space."""

    def action(self, action):
        return action


def quadcopters(wrapper, vec_env_cls=None):
    return make_vec_env(
        "QuadTargetTracking-v0", 2, seed=0, wrapper_class=wrapper, vec_env_cls=vec_env_cls
    )


@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (-2.0, 2.0), (-1.0, 1.0)])
def test_an_expert_of_the_true_state_flies_the_same_through_rescaled_actions(low, high):
    flown = []
    for wrapper in (None, rescaled(low, high)):
        env = quadcopters(wrapper)
        controller = Controller.for_env("pid", env)
        observation = env.reset()
        for _ in range(30):
            observation, *_ = env.step(controller.labels(observation))
        flown.append(observation)
    np.testing.assert_allclose(flown[1], flown[0], atol=1e-4)


def test_a_model_that_has_learnt_without_the_wrapper_teaches_through_it():
    teacher = PPO("MlpPolicy", make_vec_env("Pendulum-v1", 2), seed=1, device="cpu")
    with th.no_grad():
        teacher.policy.action_net.bias += 1.5
    env = make_vec_env("Pendulum-v1", 2, seed=0, wrapper_class=rescaled(0.0, 1.0))
    observation = env.reset()
    torques, _ = teacher.predict(observation, deterministic=True)
    labels = Controller.for_env(teacher, env).labels(observation)
    np.testing.assert_allclose(labels, (torques + 2.0) / 4.0, rtol=1e-5)


@pytest.mark.parametrize(
    "wrapper",
    [Doubled, Speeds, Throttles, Renumbered, lambda env: rescaled(0.0, 1.0)(Doubled(env))],
)
def test_labels_that_no_wrapper_takes_are_refused(wrapper):
    with pytest.raises(ExpertError, match="RescaleAction") as raised:
        DAgger("MlpPolicy", quadcopters(wrapper), expert="pid")
    assert "\n" not in str(raised.value)


def test_a_model_of_other_limits_is_refused():
    model = PPO("MlpPolicy", Height(0.0, 1.0), device="cpu")
    with pytest.raises(ExpertError, match="its actions are of"):
        Controller.for_env(model, make_vec_env(Height, 1))
    with pytest.raises(Exception, match="its actions are of"):
        Controller(model, Height().action_space, Height().observation_space)


def test_wrappers_that_keep_the_limits_are_left_alone():
    env = quadcopters(Below)
    labels = Controller.for_env("pid", env).labels(env.reset())
    plain = quadcopters(None)
    np.testing.assert_array_equal(labels, Controller.for_env("pid", plain).labels(plain.reset()))
