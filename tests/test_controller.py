"""Expert labels: whom the labeller asks, with what, and which answers it accepts."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize

from sb3_quad import PPOBC, DAgger
from sb3_quad.agents.controller import Controller
from sb3_quad.base.errors import ConfigError, ControllerError, ExpertError
from sb3_quad.envs.simulation.state import STATE_SIZE, QuadcopterState
from sb3_quad.envs.vec_env import QuadcopterVecEnv
from sb3_quad.envs.vehicles.vehicle import load_vehicle
from sb3_quad.evaluation.flights import fly
from sb3_quad.experts.geometric import privileged_geometric
from sb3_quad.experts.pid import PIDExpert


class Stateful(gym.Env):
    """An environment whose true state is its number in every entry, which observations hide."""

    observation_space = spaces.Box(-1, 1, (18,), np.float32)
    action_space = spaces.Box(-1, 1, (4,), np.float32)

    def __init__(self, number):
        self.number = number

    def reset(self, *, seed=None, options=None):
        return np.zeros(18, dtype=np.float32), {}

    def true_state(self):
        return QuadcopterState(np.full((STATE_SIZE, 1), self.number, dtype=np.float64))


class FromState:
    """Acts on the true state, by a value that observations do not have."""

    def actions(self, state):
        return np.repeat(state.position[:, :1], 4, axis=1).astype(np.float32)

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.full((len(observation), 4), -0.5, dtype=np.float32), state


def test_the_true_state_is_collected_from_single_environments():
    env = VecMonitor(DummyVecEnv([lambda n=n: Stateful(n) for n in (0.25, 0.75)]))
    labeller = Controller.for_env(FromState(), env)
    assert labeller._true_state is not None
    np.testing.assert_array_equal(
        labeller.labels(env.reset()), np.repeat([[0.25], [0.75]], 4, axis=1)
    )


@pytest.mark.parametrize(
    ("algorithm", "settings"),
    [
        (DAgger, {"n_steps": 8}),
        (PPOBC, {"n_steps": 8, "batch_size": 16, "bc_coef": 1.0}),
    ],
)
def test_an_expert_by_name_is_made_for_the_vehicle_of_the_environments(algorithm, settings):
    env = VecMonitor(QuadcopterVecEnv(2, vehicle="crazyflie", seed=0))
    model = algorithm("MlpPolicy", env, expert="pid", device="cpu", **settings).learn(16)
    labeller = Controller.for_env(model.expert, env, model._labeller)
    assert labeller is model._labeller  # made once
    assert isinstance(labeller.source, PIDExpert) and labeller.source.vehicle == load_vehicle(
        "crazyflie"
    )
    with pytest.raises(ConfigError, match="unknown expert 'pidd': did you mean 'pid'"):
        algorithm("MlpPolicy", env, expert="pidd", device="cpu", **settings).learn(16)


@pytest.mark.parametrize(
    "wrap", [lambda env: env, VecMonitor, lambda env: VecNormalize(VecMonitor(env))]
)
def test_the_true_state_of_the_batched_environment(wrap):
    env = wrap(QuadcopterVecEnv(5, seed=0))
    observation = env.reset()
    labeller = Controller.for_env(PIDExpert(), env)
    state = env.unwrapped.true_state()
    np.testing.assert_array_equal(labeller.labels(observation), PIDExpert().actions(state))
    before = state.copy()
    for _ in range(10):
        observation = env.step(np.ones((5, 4), dtype=np.float32))[0]
    labels = labeller.labels(observation)
    np.testing.assert_array_equal(labels, PIDExpert().actions(env.unwrapped.true_state()))
    assert not np.array_equal(labels, PIDExpert().actions(before))


def test_without_a_true_state_predict_is_asked():
    labeller = Controller.for_env(FromState(), make_vec_env(lambda: Blind(), 3))
    assert labeller._true_state is None
    np.testing.assert_array_equal(labeller.labels(np.zeros((3, 18))), np.full((3, 4), -0.5))


class Blind(gym.Env):
    """Our spaces without a true state."""

    observation_space = Stateful.observation_space
    action_space = Stateful.action_space

    def reset(self, *, seed=None, options=None):
        return np.zeros(18, dtype=np.float32), {}


def test_an_sb3_model_and_its_policy():
    env = make_vec_env("Pendulum-v1", 3, seed=0)
    observation = env.reset()
    model = PPO("MlpPolicy", env, device="cpu", seed=0)
    expected = model.predict(observation, deterministic=True)[0]
    for expert in (model, model.policy):
        np.testing.assert_array_equal(Controller.for_env(expert, env).labels(observation), expected)


def test_labels_are_clipped_to_the_action_space():
    env = make_vec_env("Pendulum-v1", 2, seed=0)
    labels = Controller.for_env(lambda observation: np.array([[9.0], [-9.0]]), env).labels(
        env.reset()
    )
    np.testing.assert_array_equal(labels, [[2.0], [-2.0]])
    assert labels.dtype == np.float32


def test_actions_in_another_unit_are_warned_of_once(recwarn):
    env = make_vec_env("Pendulum-v1", 2, seed=0)
    observation = env.reset()
    labeller = Controller.for_env(lambda observation: np.array([[9.0], [-2.5]]), env)
    with pytest.warns(UserWarning, match="such as 9, which are clipped; are they newtons"):
        labeller.labels(observation)
    labeller.labels(observation)
    assert not recwarn.list
    with pytest.warns(UserWarning, match="such as 4.24, which are clipped; are they newtons"):
        fly(
            lambda observation: np.full((len(observation), 4), 4.24),
            n_episodes=2,
            max_episode_steps=2,
        )


def test_an_expert_of_another_vehicle_is_warned_of(recwarn):
    env = QuadcopterVecEnv(2, vehicle="crazyflie", seed=0)
    with pytest.warns(UserWarning, match="made for the vehicle itm and flies crazyflie"):
        Controller.for_env(PIDExpert(), env)
    with pytest.warns(UserWarning, match="made for the vehicle itm and flies crazyflie"):
        fly(PIDExpert(), n_episodes=2, vehicle="crazyflie", max_episode_steps=2)
    # These know the vehicle, or fly another one on purpose.
    nominal = QuadcopterVecEnv(2, randomize={"mass": [0.8, 1.2]}, seed=0)
    Controller.for_env("pid", env)
    Controller.for_env(privileged_geometric(), env)
    Controller.for_env(PIDExpert(), nominal)
    assert not recwarn.list


def test_a_model_of_other_limits_names_the_way_out():
    rescaled = gym.wrappers.RescaleAction(Blind(), np.float32(0.0), np.float32(1.0))
    model = PPO("MlpPolicy", rescaled, device="cpu")
    with pytest.raises(ControllerError, match="train it within these, or give an environment with"):
        fly(model, n_episodes=1, max_episode_steps=1)


@pytest.mark.parametrize(
    ("expert", "message"),
    [
        (lambda observation: np.zeros(2), r"shape \(2,\), must be \(2, 1\)"),
        (lambda observation: np.zeros((2, 4)), r"shape \(2, 4\)"),
        (
            lambda observation: np.array([[0.0], [np.inf]]),
            r"\[inf\] in row 1; every number must be finite",
        ),
    ],
)
def test_unfit_labels_raise_and_name_the_row(expert, message):
    env = make_vec_env("Pendulum-v1", 2, seed=0)
    with pytest.raises(ExpertError, match=message):
        Controller.for_env(expert, env).labels(env.reset())


class OnlyState:
    def actions(self, state):
        return np.zeros((state.n, 4))


@pytest.mark.parametrize(
    ("expert", "message"),
    [
        (None, "no expert"),
        (PIDExpert, r"PIDExpert\(\)"),
        (3, "must be a function"),
        (OnlyState(), "true_state"),
    ],
)
def test_unfit_experts_raise_at_once(expert, message):
    with pytest.raises(ExpertError, match=message):
        Controller.for_env(expert, make_vec_env("Pendulum-v1", 1))


def test_a_model_of_another_environment_raises():
    with pytest.raises(
        ExpertError, match=r"observation space has shape \(3,\), the environment's \(18,\)"
    ):
        Controller.for_env(PPO("MlpPolicy", "Pendulum-v1", device="cpu"), QuadcopterVecEnv(2))


class Counter:
    """Counts its calls in its state, and records the arguments that recurrent policies get."""

    def __init__(self):
        self.given, self.starts = [], []

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        self.given.append(state)
        self.starts.append(episode_start)
        return np.zeros((len(observation), 4)), (1 if state is None else state + 1)


def test_the_state_of_a_controller_lasts_one_flight():
    counter = Counter()
    for n in (3, 2):
        fly(counter, "target_tracking", n, max_episode_steps=4)
    assert counter.given == [None, 1, 2, 3] * 2


def test_the_state_of_an_expert_lasts_in_its_environment():
    counter, env = Counter(), QuadcopterVecEnv(2, seed=0)
    labeller, observation, starts = (
        Controller.for_env(counter, env),
        env.reset(),
        np.array([True, False]),
    )
    labeller.labels(observation, np.ones(2, dtype=bool))
    Controller.for_env(counter, env, labeller).labels(observation, starts)
    Controller.for_env(counter, QuadcopterVecEnv(2, seed=0), labeller).labels(observation, starts)
    assert counter.given == [None, 1, None]
    np.testing.assert_array_equal(counter.starts[1], starts)
