"""What lies between an expert, an agent and the simulator: known, right, or refused in one line."""

import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium import wrappers as gw
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import (
    VecCheckNan,
    VecEnvWrapper,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
)

from sb3_quad import PPOBC, DAgger, QuadcopterVecEnv, fly
from sb3_quad.agents.agent_settings import agent_settings
from sb3_quad.algorithms.chain import chain_of, describe
from sb3_quad.algorithms.labelling import Labeller
from sb3_quad.base.errors import ConfigError, ExpertError, SB3QuadError
from sb3_quad.experts.pid import PIDExpert

TINY: Any = {"n_steps": 8, "batch_size": 16, "seed": 0, "device": "cpu"}


class Passing(VecEnvWrapper):
    """Changes nothing, in its own way, and says so."""

    changes = ""

    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        return self.venv.step_wait()


class OwnReward(Passing):
    def step_wait(self):
        observations, rewards, dones, infos = self.venv.step_wait()
        (state,) = self.env_method("true_state", indices=[0])
        return observations, rewards - state.position[:, 2], dones, infos


class Scaled(Passing):
    """Other units of the same shape."""

    changes = "o"

    def reset(self):
        return self.venv.reset() * np.float32(0.2)

    def step_wait(self):
        observations, *rest = self.venv.step_wait()
        return observations * np.float32(0.2), *rest


class Half(Passing):
    changes = "a"

    def step_async(self, actions):
        self.venv.step_async(0.5 * actions)


class NoInfos(Passing):
    def step_wait(self):
        *results, infos = self.venv.step_wait()
        return *results, [{} for _ in infos]


class Silent(VecEnvWrapper):
    """Does not say what it changes."""

    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        return self.venv.step_wait()


class Smooth(gym.Wrapper):
    changes = "a"

    def reset(self, **keywords):
        self.last = np.zeros(4, np.float32)
        return self.env.reset(**keywords)

    def step(self, action):
        self.last = self.last + 0.2 * (action - self.last)
        return self.env.step(self.last)


class Increments(Smooth):
    def step(self, action):
        self.last = np.clip(self.last + 0.1 * action, -1.0, 1.0)
        return self.env.step(self.last)


class Twice(gym.Wrapper):
    changes = "s"

    def step(self, action):
        self.env.step(action)
        return self.env.step(action)


class Plain(gym.Wrapper):
    """Observations in other units, without the base class for that."""

    changes = "o"

    def step(self, action):
        observation, *rest = self.env.step(action)
        return 2.0 * observation, *rest


class Squared(gym.ObservationWrapper):
    def observation(self, observation):
        return np.square(observation)


class Percent(gym.ActionWrapper):
    """Actions in [0, 1], which it scales back."""

    changes = "s"

    def __init__(self, env):
        super().__init__(env)
        self.action_space = spaces.Box(0.0, 1.0, (4,), np.float32)

    def action(self, action):
        return 2.0 * action - 1.0


def rescaled(env):
    return gw.RescaleAction(env, np.float32(0.0), np.float32(1.0))


def negated(env):
    return gw.TransformAction(env, lambda action: -action, env.action_space)


def shifted(env):
    return gw.TransformObservation(env, lambda seen: seen + 1, env.observation_space)


# By the wrappers: what they change, and whether the PID and a model of the package may teach there.
BATCH = {
    "none": (lambda env: env, "", True, True),
    "monitor": (lambda env: VecCheckNan(VecMonitor(env)), "", True, True),
    "normalised": (VecNormalize, "", True, True),
    "own reward": (OwnReward, "", True, True),
    "own reward, normalised": (lambda env: VecNormalize(OwnReward(env)), "", True, True),
    "scaled": (Scaled, "o", True, False),
    "scaled and normalised": (lambda env: VecNormalize(Scaled(env)), "o", True, False),
    "half": (Half, "a", False, False),
    "half and normalised": (lambda env: VecNormalize(Half(env)), "a", False, False),
    "stacked": (lambda env: VecFrameStack(env, 2), "o", True, False),
    "stacked, normalised": (lambda env: VecNormalize(VecFrameStack(env, 2)), "o", True, False),
    "normalised inside": (lambda env: VecFrameStack(VecNormalize(env), 2), "o", False, False),
    "scaled outside": (lambda env: Scaled(VecNormalize(env)), "o", False, False),
    "monitor outside": (lambda env: VecMonitor(VecNormalize(env)), "", True, True),
    "silent": (Silent, "oa", False, False),
    "no infos": (NoInfos, "", True, True),
}
SINGLE = {
    "rescaled": (rescaled, "s", True, True),
    "rescaled and negated": (lambda env: rescaled(negated(env)), "soa", False, False),
    "percent": (Percent, "s", True, True),
    "smooth": (Smooth, "a", False, False),
    "increments": (Increments, "a", False, False),
    "negated": (negated, "oa", False, False),
    "sticky": (lambda env: gw.StickyAction(env, 0.02), "a", False, False),
    "twice": (Twice, "s", True, True),
    "shifted": (shifted, "o", True, False),
    "squared": (Squared, "o", True, False),
    "plain": (Plain, "o", True, False),
    "delayed": (lambda env: gw.DelayObservation(env, delay=5), "o", True, False),
    "timed": (gw.TimeAwareObservation, "o", True, False),
    "frames": (lambda e: gw.FlattenObservation(gw.FrameStackObservation(e, 2)), "o", True, False),
    "statistics": (gw.NormalizeObservation, "o", True, False),
    "rewards": (lambda env: gw.ClipReward(gw.NormalizeReward(env), -1, 1), "", True, True),
    "own reward": (lambda env: gw.TransformReward(env, abs), "", True, True),
    "again": (lambda env: gw.Autoreset(gw.RecordEpisodeStatistics(env)), "", True, True),
}


def wrapped(name, batch):
    if batch:
        return BATCH[name][0](QuadcopterVecEnv(4, seed=0))
    return make_vec_env("QuadTargetTracking-v0", 1, seed=0, wrapper_class=SINGLE[name][0])


CASES = [(name, True) for name in BATCH] + [(name, False) for name in SINGLE]


@pytest.mark.parametrize(("name", "batch"), CASES, ids=[f"{n}-{b}" for n, b in CASES])
def test_each_chain_is_described_and_teaches_right_or_is_refused(name, batch):
    """Labels that are accepted reach the simulator as the expert gives them."""
    _, changes, *teaches = (BATCH if batch else SINGLE)[name]
    env = wrapped(name, batch)
    assert describe(env).changes == {*changes}
    experts = {"pid": teaches[0], "itm-imitation": teaches[1]}
    for expert, may in experts.items():
        if may:
            Labeller(expert, env)
            continue
        with pytest.raises(SB3QuadError) as raised:
            Labeller(expert, env)
        assert "\n" not in str(raised.value)
    if teaches[0]:
        labeller, own = Labeller("pid", env), PIDExpert()
        labels = labeller.labels(env.reset()).reshape(env.num_envs, 4)
        rows = [env.unwrapped.true_state()] if batch else env.env_method("true_state")
        actions = np.concatenate([own.actions(state) for state in rows])
        least, most = env.action_space.low, env.action_space.high
        np.testing.assert_allclose(labels, least + (actions + 1) / 2 * (most - least), atol=1e-6)
    env.close()


def test_the_check_names_the_wrapper_and_can_be_left_out():
    with pytest.raises(ExpertError, match=r"Half; scale actions by RescaleAction"):
        DAgger("MlpPolicy", wrapped("half", True), expert="pid", **TINY)
    DAgger("MlpPolicy", wrapped("half", True), expert="pid", check_expert=False, **TINY).learn(32)


def test_zips_say_behind_what_they_were_trained(tmp_path):
    """Those of wrappers are refused wherever flights have none, and go on behind the same."""
    env = wrapped("scaled", True)
    zip_file = tmp_path / "scaled.zip"
    model = DAgger("MlpPolicy", env, expert="pid", **TINY).learn(32)
    model.save(zip_file)
    for use in (
        lambda: fly(str(zip_file), n_episodes=1),
        lambda: fly(model, n_episodes=1),
        lambda: agent_settings(zip_file),
        lambda: Labeller(str(zip_file), QuadcopterVecEnv(4)),
        lambda: DAgger("MlpPolicy", QuadcopterVecEnv(4), expert="pid", initial_policy=zip_file),
    ):
        with pytest.raises(ConfigError, match="Scaled") as raised:
            use()
        assert "\n" not in str(raised.value)
    seen = env.reset()
    labels = Labeller(str(zip_file), env).labels(seen)
    np.testing.assert_array_equal(labels, model.predict(seen, deterministic=True)[0])
    DAgger("MlpPolicy", env, expert="pid", initial_policy=zip_file, **TINY)
    assert vars(PPO.load(zip_file))["wrappers"] == ["Scaled"]
    # Rewards change nothing that a flight needs.
    model = DAgger("MlpPolicy", wrapped("own reward", True), expert="pid", **TINY)
    assert chain_of(model) == [] and fly(model, n_episodes=1, max_episode_steps=2)


class Columns(gym.Env):
    """The column of the bright pixel is the action."""

    observation_space = spaces.Box(0, 255, (40, 40, 3), np.uint8)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def _see(self):
        image = np.zeros((40, 40, 3), np.uint8)
        self.column = int(self.np_random.integers(40))
        image[self.np_random.integers(40), self.column] = 255
        return image

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self._see(), {}

    def step(self, action):
        reward = -abs(float(action[0]) - (self.column / 19.5 - 1.0))
        return self._see(), reward, False, False, {}


def test_a_function_sees_pictures_as_the_environment_makes_them():
    def expert(images):
        return (images.astype(np.float32).sum(axis=(1, 3)).argmax(axis=1) / 19.5 - 1.0)[:, None]

    model = DAgger("MlpPolicy", make_vec_env(Columns, 2, seed=0), expert=expert, **TINY)
    model.learn(16)
    env = model.get_env()
    labels = model._labeller.labels(env.reset())
    wanted = [[column / 19.5 - 1.0] for column in env.get_attr("column")]
    np.testing.assert_allclose(labels, wanted, atol=1e-6)


def test_a_function_is_not_normalised_by_statistics_that_go_on():
    env = make_vec_env("UnitPendulum-v0", 2, wrapper_class=gw.NormalizeObservation)
    with pytest.raises(ExpertError, match="use VecNormalize"):
        DAgger("MlpPolicy", env, expert=lambda seen: seen[:, :1], **TINY)


class Meddling(BaseCallback):
    """Changes the state of the training's environment between two steps."""

    def __init__(self, how):
        super().__init__()
        self.how = how

    def _on_step(self):
        if self.n_calls % 3 == 0:
            env = self.model.get_env()
            if self.how == "target":
                env.unwrapped.set_target((0.0, 0.0, 5.0))
            else:
                evaluate_policy(self.model, env, 1, warn=False)
        return True


@pytest.mark.parametrize("algorithm", [DAgger, PPOBC])
@pytest.mark.parametrize("how", ["target", "evaluation"])
def test_labels_belong_to_what_the_policy_has_observed(algorithm, how):
    """Without noise, the PID's label can be computed from an observation."""
    env = QuadcopterVecEnv(4, seed=0, noise=0.0, max_episode_steps=20)
    if algorithm is DAgger:
        # Its dataset keeps raw observations.
        env = VecNormalize(env)
    model = algorithm("MlpPolicy", env, expert="pid", check_expert=False, **TINY)
    model.learn(32, callback=Meddling(how))
    if algorithm is DAgger:
        seen, got = model.dataset.pairs["observations"], model.dataset.pairs["actions"]
    else:
        seen = model.rollout_buffer.observations.reshape(-1, 18)
        got = model.rollout_buffer.expert_actions.reshape(-1, 4)
    np.testing.assert_allclose(got, PIDExpert().predict(seen)[0], atol=1e-3)


def test_infos_belong_to_their_receiver():
    env = QuadcopterVecEnv(3, seed=0, max_episode_steps=5)
    env.reset()
    kept = []
    for step in range(12):
        *_, infos = env.step(np.zeros((3, 4), np.float32))
        kept.append(infos)
        if step == 2:
            infos[1]["episode"] = {"r": 0.0}
    ends = [[row for row, info in enumerate(infos) if "episode" in info] for infos in kept]
    assert [(step, rows) for step, rows in enumerate(ends) if rows] == [
        (2, [1]),
        (4, [0, 1, 2]),
        (9, [0, 1, 2]),
    ]
    assert kept[0] == [{}, {}, {}] and kept[0][:2] == [{}, {}] and len(kept[0].copy()) == 3


def test_dropped_infos_are_warned_of():
    env = NoInfos(QuadcopterVecEnv(4, seed=0, max_episode_steps=6))
    with pytest.warns(UserWarning, match="a wrapper drops infos"):
        DAgger("MlpPolicy", env, expert="pid", **TINY).learn(32)


def test_schedules_that_end_with_each_call_of_learn_are_named():
    model = DAgger("MlpPolicy", QuadcopterVecEnv(4, seed=0), expert="pid", **TINY)
    model.learn(32)
    with pytest.warns(UserWarning, match="learning_rate: its schedule ends with each call"):
        model.learn(32, reset_num_timesteps=False)
    constant = DAgger("MlpPolicy", QuadcopterVecEnv(4), 1e-3, expert="pid", **TINY).learn(32)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        constant.learn(32, reset_num_timesteps=False)
