"""RecurrentDAgger: what is remembered and for how long, what is learnt from it, and where its zips load."""

import importlib.util
import json
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_quad import PPOBC, DAgger
from sb3_quad.base.errors import ConfigError, ExpertError, MissingExtra
from sb3_quad.cli import main
from sb3_quad.common import CLONING_LOSSES
from sb3_quad.envs.vec_env import QuadcopterVecEnv
from sb3_quad.evaluation.flights import fly
from sb3_quad.experts.controller import Controller
from sb3_quad.experts.models import load_model, saved_algorithm
from sb3_quad.experts.pid import PIDExpert

pytest.importorskip("sb3_contrib", reason="needs the extra [recurrent]")

from sb3_contrib import RecurrentPPO
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy

from sb3_quad.dagger import recurrent
from sb3_quad.dagger.recurrent import RecurrentDAgger, through_time

N_ENVS, N_STEPS = 4, 20
ROLLOUT = N_ENVS * N_STEPS
NETWORKS = {"lstm_hidden_size": 8, "net_arch": [8]}
SMALL = {"n_steps": N_STEPS, "batch_size": 40, "n_epochs": 2, "seed": 3, "device": "cpu"}


class Recall(gym.Env):
    """The first observation of an episode is ±1, the others are 0; the expert repeats the first one in every step."""

    observation_space = spaces.Box(-1.0, 1.0, (1,), dtype=np.float32)
    action_space = spaces.Box(-1.0, 1.0, (1,), dtype=np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.sign, self.left = self.np_random.choice([-1.0, 1.0]), int(self.np_random.integers(5, 10))
        return np.array([self.sign], dtype=np.float32), {}

    def step(self, action):
        self.left -= 1
        ended = self.left == 0
        truncated = bool(ended and self.sign > 0)
        reward = -abs(float(action[0]) - self.sign)
        return np.zeros(1, dtype=np.float32), reward, bool(ended and not truncated), truncated, {}


class Repeat:
    """The expert of Recall. It remembers the first observation of each row's episode, and counts its steps."""

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        first, steps = (observation, np.zeros(len(observation))) if state is None else state
        if state is not None and episode_start is not None:
            first = np.where(episode_start[:, None], observation, first)
            steps = np.where(episode_start, 0, steps)
        return first, (first, steps + 1)


def recall(n_envs=N_ENVS, seed=1):
    return make_vec_env(Recall, n_envs, seed=seed)


def build(env=None, expert=None, policy="MlpLstmPolicy", **kwargs):
    settings = {**SMALL, "policy_kwargs": NETWORKS, **kwargs}
    return RecurrentDAgger(policy, env or recall(), expert=expert or Repeat(), **settings)


def parameters(model):
    return th.cat([p.detach().flatten() for p in model.policy.parameters()])


def everything(model):
    return model.dataset.sequences(th.arange(len(model.dataset)))


# --- Experts that remember ----------------------------------------------------------------------------------------------


class Rollouts(BaseCallback):
    """Observations and labels of every rollout, (n_steps, n_envs)."""

    def __init__(self):
        super().__init__()
        self.observations, self.labels = [], []

    def _on_rollout_end(self):
        buffer, labels = self.model.rollout_buffer, self.locals.get("labels")
        self.observations += list(buffer.observations[..., 0].copy())
        self.labels += list((buffer.expert_actions if labels is None else labels)[..., 0].copy())

    def _on_step(self):
        return True


@pytest.mark.parametrize("algorithm", [DAgger, PPOBC, RecurrentDAgger])
def test_labels_are_of_the_rows_own_episode_across_rollouts(algorithm):
    """Rollouts of 6 steps end within episodes of 5 to 9: the expert's memory must go on from one to the next."""
    policy = "MlpLstmPolicy" if algorithm is RecurrentDAgger else "MlpPolicy"
    model, seen = algorithm(policy, recall(), expert=Repeat(), **{**SMALL, "n_steps": 6, "batch_size": 12}), Rollouts()
    for _ in range(2):  # nor does it end with learn
        model.learn(6 * N_ENVS * 5, callback=seen, reset_num_timesteps=False)
    signs = np.zeros(N_ENVS)
    for observation, label in zip(seen.observations, seen.labels, strict=True):
        signs = np.where(observation != 0.0, observation, signs)
        np.testing.assert_array_equal(label, signs)
    assert len(seen.labels) == 60


def test_an_expert_that_remembers_is_evaluated_as_it_labels():
    env = recall()
    rewards, _ = evaluate_policy(Controller.for_env(Repeat(), env), env, 20, return_episode_rewards=True, warn=False)
    assert rewards == [0.0] * 20


@pytest.mark.skipif(importlib.util.find_spec("foundation_policy") is None, reason="needs the extra [raptor]")
def test_raptor_teaches_as_it_flies():
    from sb3_quad.experts.raptor import Raptor

    n_steps, n = 50, 3
    model = DAgger(
        "MlpPolicy",
        QuadcopterVecEnv(n, seed=0, max_episode_steps=40),
        Raptor(),
        **{**SMALL, "n_steps": n_steps},
    ).learn(2 * n_steps * n)
    observations, labels = (part.view(2 * n_steps, n, -1).numpy() for part in model.dataset.pairs(th.arange(2 * n_steps * n)))
    alone, state = Raptor(), None
    for step, (observation, label) in enumerate(zip(observations, labels, strict=True)):
        actions, state = alone.predict(observation, state, np.full(n, step % 40 == 0))  # nobody is lost so early
        np.testing.assert_array_equal(label, np.clip(actions, -1.0, 1.0))


# --- What the policy remembers ------------------------------------------------------------------------------------------


def test_states_go_on_from_rollout_to_rollout_as_in_a_flight_step_by_step():
    model = build(learning_rate=0.0).learn(ROLLOUT * 3)
    observations, _, starts, hidden, cell = (part.view(3, N_ENVS, *part.shape[1:]).numpy() for part in everything(model))
    state = None
    for rollout in range(3):
        before = np.stack([hidden[rollout], cell[rollout]]).transpose(0, 2, 1, 3)
        if rollout == 0:
            assert not before.any()
        else:
            np.testing.assert_allclose(np.stack(state), before, atol=1e-6)
        for step in range(N_STEPS):
            _, state = model.predict(observations[rollout][:, step], state, starts[rollout][:, step], deterministic=True)
    assert starts[1:].any() and not starts[1, :, 0].all()


@pytest.mark.parametrize("padding", [0.0, 1e9])
def test_both_ways_through_time_are_the_policys_own_step_by_step(monkeypatch, padding):
    monkeypatch.setattr(recurrent, "PADDING", padding)
    policy = build().policy
    generator = th.Generator().manual_seed(0)
    observations = th.randn(5, 12, 1, generator=generator)
    starts = th.rand(5, 12, generator=generator) < 0.2
    states = tuple(th.randn(5, 1, 8, generator=generator) for _ in range(2))
    means = through_time(lambda *given: policy.get_distribution(*given)[0].mode(), observations, starts, states)
    now = tuple(part.transpose(0, 1) for part in states)
    for step in range(12):
        distribution, now = policy.get_distribution(observations[:, step], now, starts[:, step].float())
        th.testing.assert_close(means.view(5, 12, 1)[:, step], distribution.mode())


@pytest.mark.parametrize("padding", [0.0, 1e9])
def test_no_gradient_crosses_the_start_of_an_episode(monkeypatch, padding):
    monkeypatch.setattr(recurrent, "PADDING", padding)
    policy = build().policy
    observations = th.randn(3, 10, 1, generator=th.Generator().manual_seed(0)).requires_grad_()
    starts = th.zeros(3, 10, dtype=th.bool)
    starts[0, 4] = starts[1, 0] = True
    states = tuple(th.randn(3, 1, 8).requires_grad_() for _ in range(2))
    means = through_time(lambda *given: policy.get_distribution(*given)[0].mode(), observations, starts, states).view(3, 10)
    means[:, 7].sum().backward()
    felt = observations.grad[..., 0] != 0.0
    assert not felt[0, :4].any() and felt[0, 4:8].all() and felt[1:, :8].all() and not felt[:, 8:].any()
    for part in states:
        assert not part.grad[:2].any() and part.grad[2].any()


def test_values_are_those_of_a_flight_step_by_step_and_time_limits_are_bootstrapped():
    recorder = Recorder()
    model = build(learning_rate=0.0)
    model.learn(ROLLOUT, callback=recorder)
    buffer, policy = model.rollout_buffer, model.policy
    state = tuple(th.zeros(1, N_ENVS, 8) for _ in range(2))
    both = recurrent.RNNStates(state, state)
    n_timeouts = 0
    with th.no_grad():
        for step, (rewards, infos) in enumerate(recorder.rows):
            observation, starts = (th.as_tensor(part[step]) for part in (buffer.observations, buffer.episode_starts))
            _, values, _, both = policy.forward(observation, both, starts, deterministic=True)
            np.testing.assert_allclose(buffer.values[step], values.flatten(), atol=1e-6)
            for row in np.flatnonzero([info.get("TimeLimit.truncated", False) for info in infos]):
                vf = tuple(part[:, row : row + 1] for part in both.vf)
                last = th.as_tensor(infos[row]["terminal_observation"])[None]
                rewards[row] += model.gamma * policy.predict_values(last, vf, th.zeros(1)).item()
                n_timeouts += 1
            np.testing.assert_allclose(buffer.rewards[step], rewards, atol=1e-5)
        last = policy.predict_values(
            th.as_tensor(model._last_obs), both.vf, th.as_tensor(model._last_episode_starts).float()
        ).flatten()
    delta = buffer.rewards[-1] + model.gamma * last.numpy() * ~model._last_episode_starts - buffer.values[-1]
    np.testing.assert_allclose(buffer.advantages[-1], delta, atol=1e-5)
    assert n_timeouts > 0


class Recorder(BaseCallback):
    """Rewards and infos of every step."""

    def __init__(self):
        super().__init__()
        self.rows = []

    def _on_step(self):
        self.rows.append((self.locals["rewards"].copy(), self.locals["infos"]))
        return True


# --- Learning -----------------------------------------------------------------------------------------------------------


def test_it_learns_what_only_a_memory_can():
    settings = {"n_steps": N_STEPS, "n_epochs": 1, "gradient_steps": 40, "learning_rate": 1e-2, "seed": 0, "device": "cpu"}
    networks = {"net_arch": [16]}
    both = {DAgger: ("MlpPolicy", {}), RecurrentDAgger: ("MlpLstmPolicy", {"lstm_hidden_size": 16})}
    losses = {}
    for algorithm, (policy, further) in both.items():
        model = algorithm(policy, recall(16), Repeat(), batch_size=320, policy_kwargs=networks | further, **settings)
        model.learn(16 * N_STEPS * 12)
        losses[algorithm] = model.logger.name_to_value["train/bc_loss"]
    assert losses[DAgger] > 0.6  # of 1, the square of the sign that it cannot know, in all steps but the first
    assert losses[RecurrentDAgger] < 0.05


@pytest.mark.parametrize("further", [{}, {"enable_critic_lstm": False}, {"enable_critic_lstm": False, "shared_lstm": True}])
def test_the_critic_learns_the_returns_and_leaves_the_actor_alone(further):
    settings = {"policy_kwargs": NETWORKS | further, "gamma": 0.5, "learning_rate": 1e-2, "n_epochs": 10}

    def trained(vf_coef, n=1):
        return build(vf_coef=vf_coef, **settings).learn(ROLLOUT * n)

    with_critic, without = (dict(trained(c).policy.named_parameters()) for c in (0.5, 0.0))
    for name, parameter in with_critic.items():
        of_critic = name.startswith(("lstm_critic", "critic", "value_net", "mlp_extractor.value_net"))
        assert th.equal(parameter, without[name]) != of_critic, name
    first, last = (trained(0.5, n).logger.name_to_value["train/value_loss"] for n in (1, 8))
    assert last < 0.3 * first


@pytest.mark.parametrize("bc_loss", CLONING_LOSSES)
def test_gradients_reach_the_lstm_and_log_std_under_nll_alone(bc_loss):
    model = build(bc_loss=bc_loss)
    before = {name: parameter.detach().clone() for name, parameter in model.policy.named_parameters()}
    model.learn(ROLLOUT)
    changed = {name for name, parameter in model.policy.named_parameters() if not th.equal(parameter, before[name])}
    assert {name for name in before if name.startswith("lstm_actor")} <= changed
    assert ("log_std" in changed) == (bc_loss == "nll")


class OneState(RecurrentActorCriticPolicy):
    """A policy given as a class."""


def test_other_recurrent_policies_are_taken_as_classes():
    assert isinstance(build(policy=OneState).learn(ROLLOUT).policy, OneState)


@pytest.mark.parametrize(("capacity", "sizes"), [(0, [80, 80, 80]), (199, [80, 160, 180]), (1000, [80, 160, 240])])
def test_the_dataset_holds_whole_sequences_up_to_its_capacity(capacity, sizes):
    model = build(dataset_capacity=capacity)
    for size in sizes:
        model.learn(ROLLOUT, reset_num_timesteps=False)
        assert model.dataset.n_pairs == size
    newest = everything(model)[0][-N_ENVS:].transpose(0, 1).numpy()
    np.testing.assert_array_equal(newest, model.rollout_buffer.observations)


# --- Repeating, saving, resuming ----------------------------------------------------------------------------------------


def test_a_seed_decides_the_run():
    first, again, other = (parameters(build(seed=seed).learn(ROLLOUT * 3)) for seed in (3, 3, 4))
    assert th.equal(first, again)
    assert not th.equal(first, other)


def test_an_interrupted_run_goes_on_bit_for_bit_as_new_episodes(tmp_path):
    whole = build(dataset_capacity=199, bc_loss="nll", seed=None).learn(ROLLOUT * 3)
    whole.save(tmp_path / "model")
    whole.save_dataset(tmp_path / "dataset")
    whole.set_env(recall(seed=7))
    whole.learn(ROLLOUT * 3, reset_num_timesteps=False)
    resumed = RecurrentDAgger.load(tmp_path / "model", env=recall(seed=7), device="cpu", expert=Repeat())
    resumed.load_dataset(tmp_path / "dataset")
    resumed.learn(ROLLOUT * 3, reset_num_timesteps=False)
    assert th.equal(parameters(whole), parameters(resumed))


FLY = """
import json, sys
sys.modules["sb3_quad"] = None  # importing it, or unpickling anything of it, fails
import numpy as np
from sb3_contrib import RecurrentPPO
model, seen, state, actions = RecurrentPPO.load("model.zip", device="cpu"), np.load("observations.npy"), None, []
for step, observation in enumerate(seen):
    action, state = model.predict(observation, state, np.full(len(observation), step == 2), deterministic=True)
    actions.append(action.tolist())
assert not any(name.startswith("sb3_quad.") for name in sys.modules)
json.dump(actions, sys.stdout)
"""


def test_stock_recurrent_ppo_loads_the_zip_where_sb3_quad_cannot_be_imported(tmp_path):
    env = QuadcopterVecEnv(8, seed=0, max_episode_steps=20, last_action=True)
    settings = {**SMALL, "clip_range_vf": 0.2, "policy_kwargs": NETWORKS}
    model = RecurrentDAgger("MlpLstmPolicy", env, PIDExpert(), **settings).learn(8 * N_STEPS * 2)
    model.save(tmp_path / "model.zip")
    observations = np.random.default_rng(0).normal(size=(5, 3, 22)).astype(np.float32)
    np.save(tmp_path / "observations.npy", observations)
    command = [sys.executable, "-W", "error", "-c", FLY]
    result = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=False)
    assert result.returncode == 0, result.stderr
    loaded, path = load_model(tmp_path / "model.zip"), tmp_path / "model.zip"
    assert type(loaded) is RecurrentPPO and saved_algorithm(path) == "RecurrentDAgger"
    states = [None, None]
    for step, (observation, flown) in enumerate(zip(observations, json.loads(result.stdout), strict=True)):
        for k, ours in enumerate((model, loaded)):
            action, states[k] = ours.predict(observation, states[k], np.full(3, step == 2), deterministic=True)
            np.testing.assert_array_equal(np.float32(flown), action)


def test_a_flight_asks_it_with_its_state(tmp_path):
    model = RecurrentDAgger("MlpLstmPolicy", QuadcopterVecEnv(4, seed=0), PIDExpert(), **SMALL, policy_kwargs=NETWORKS)
    model.save(tmp_path / "model.zip")
    given = []
    predict = (loaded := load_model(tmp_path / "model.zip")).predict
    loaded.predict = lambda *arguments, **keywords: given.append(keywords.get("state")) or predict(*arguments, **keywords)
    fly(loaded, "target_tracking", 3, max_steps=4)
    assert given[0] is None and all(part.any() for state in given[1:] for part in state)


@pytest.mark.parametrize("expert", [None, "raptor"])
def test_a_run_that_was_interrupted_is_the_one_that_was_not(tmp_path, expert, monkeypatch):
    if expert == "raptor" and importlib.util.find_spec("foundation_policy") is None:
        pytest.skip("needs the extra [raptor]")
    settings = tmp_path / "small.yml"
    settings.write_text(
        "QuadTargetTracking-v0: {policy: MlpLstmPolicy, policy_kwargs: 'dict(lstm_hidden_size=8, net_arch=[8])', n_envs: 8,"
        " n_timesteps: 1600, n_steps: 50, batch_size: 200, n_epochs: 1, dataset_capacity: 1000,"
        " env_kwargs: {last_action: true, max_episode_steps: 70}}"
    )
    train = ["train", "--algo", "recurrent_dagger", "--conf-file", str(settings), "--eval-episodes", "0", "--no-progress"]
    train += ["--seed", "1", "-f", str(tmp_path)] + ([] if expert is None else ["--expert", expert])
    zips = [tmp_path / "recurrent_dagger" / f"QuadTargetTracking-v0_{k}" / "QuadTargetTracking-v0.zip" for k in (1, 2)]
    assert main(train) == 0
    after_two = RecurrentDAgger.train
    monkeypatch.setattr(RecurrentDAgger, "train", lambda self: after_two(self) or self.num_timesteps < 800 or stop())
    assert main(train) == 130
    monkeypatch.undo()
    assert main(["train", "--resume", str(zips[1].parent), "--no-progress"]) == 0
    whole, resumed = (RecurrentPPO.load(path, device="cpu") for path in zips)
    assert whole.num_timesteps == resumed.num_timesteps == 1600
    assert th.equal(parameters(whole), parameters(resumed))


def stop():
    import signal

    signal.raise_signal(signal.SIGINT)


def test_an_expert_whose_memory_no_file_holds_says_so():
    class Odd(Repeat):
        def predict(self, observation, state=None, episode_start=None, deterministic=True):
            return np.zeros((len(observation), 1)), {"steps": 1}

    model = build(expert=Odd()).learn(ROLLOUT)
    with pytest.raises(ExpertError, match="expert Odd: what it remembers was no tuple of arrays"):
        model.restore_memory(model.memory())


# --- Faults -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"policy": "MlpPolicy"}, r"unknown recurrent policy 'MlpPolicy': did you mean 'MlpLstmPolicy'"),
        ({"policy": DAgger.policy_aliases["MlpPolicy"]}, "policy ActorCriticPolicy: RecurrentDAgger needs"),
        ({"dataset_capacity": 10}, "dataset_capacity 10"),
        ({"n_steps": 0}, "n_steps 0"),
        ({"policy_kwargs": {"use_sde": True}}, "use_sde"),
        ({"bc_loss": "mae"}, "did you mean"),
    ],
)
def test_bad_arguments_are_named_in_one_line(arguments, message):
    with pytest.raises(ConfigError, match=message) as error:
        build(**arguments)
    assert "\n" not in str(error.value)


def test_a_missing_package_is_one_line_that_says_what_to_install(tmp_path, monkeypatch, capsys):
    path = tmp_path / "model.zip"
    build().save(path)
    monkeypatch.setitem(sys.modules, "sb3_contrib", None)
    monkeypatch.delitem(sys.modules, "sb3_quad.dagger.recurrent")
    with pytest.raises(MissingExtra, match=r"needs sb3_contrib .*pip install '.\[recurrent\]'"):
        load_model(path)
    assert main(["train", "--algo", "recurrent_dagger", "-f", str(tmp_path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "recurrent_dagger needs sb3_contrib" in line


@pytest.mark.parametrize("command", [["export", "--format", "c"], ["publish", "--name", "mine"]])
def test_what_cannot_be_handed_on_is_refused_in_one_line(tmp_path, monkeypatch, capsys, command):
    monkeypatch.chdir(tmp_path)
    env = QuadcopterVecEnv(4, seed=0)
    RecurrentDAgger("MlpLstmPolicy", env, PIDExpert(), **SMALL, policy_kwargs=NETWORKS).save("model.zip")
    assert main([command[0], "model.zip", *command[1:]]) == 2
    assert "its policy is RecurrentActorCriticPolicy" in capsys.readouterr().err.splitlines()[-1]
