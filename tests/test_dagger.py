"""DAgger: who flies, what is labelled, what is learnt, and what survives an interruption."""

from typing import Any, get_args

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnvWrapper

from sb3_quad.algorithms.dagger import DAgger
from sb3_quad.algorithms.losses import (
    CloningLoss,
    cloning_errors,
    gaussian_entropy,
    gaussian_nll,
    max_clipped_value_loss,
)
from sb3_quad.algorithms.networks import Network
from sb3_quad.base.errors import ConfigError, ExpertError, TrainingError

SMALL = {
    "n_steps": 32,
    "batch_size": 64,
    "n_epochs": 2,
    "gradient_steps": None,
    "learning_rate": 1e-3,
    "seed": 3,
    "device": "cpu",
}
N_ENVS = 2
ROLLOUT = 32 * N_ENVS


def turn_back(observation):
    """A smooth expert for Pendulum-v1, from observations (n, 3) to torques (n, 1)."""
    return np.clip(-observation[:, 1:2] - 0.3 * observation[:, 2:3], -1.0, 1.0)


def pendulum(n_envs=N_ENVS, seed=1):
    return make_vec_env("UnitPendulum-v0", n_envs, seed=seed)


def build(env=None, expert=turn_back, **kwargs):
    return DAgger("MlpPolicy", env or pendulum(), expert=expert, **{**SMALL, **kwargs})


def parameters(model):
    return th.cat([p.detach().flatten() for p in model.policy.parameters()])


def actor_and_critic(model):
    named = dict(model.policy.named_parameters())
    critic = [p for name, p in named.items() if "value" in name]
    actor = [p for name, p in named.items() if "value" not in name]
    return th.cat([p.detach().flatten() for p in actor]), th.cat(
        [p.detach().flatten() for p in critic]
    )


class Recorder(BaseCallback):
    """Keeps, per step, what ``keys`` of the algorithm's local variables held; and what the last
    rollout logged.
    """

    def __init__(self, *keys):
        super().__init__()
        self.keys, self.rows, self.logged = keys, [], {}

    def _on_rollout_end(self):
        self.logged = dict(self.logger.name_to_value)

    def _on_step(self):
        self.rows.append([np.copy(self.locals[key]) for key in self.keys])
        return True


# --- Learning
# ------------------------------------------------------------------------------------------


def test_the_agent_becomes_the_expert():
    model = build(n_epochs=20, learning_rate=1e-2).learn(ROLLOUT * 12)
    observations, labels = map(th.from_numpy, model.dataset.pairs.values())
    error = np.square(Network(model.policy).means(observations.numpy()) - labels.numpy()).mean()
    assert error < 0.02 * float(labels.square().mean())


@pytest.mark.parametrize("bc_loss", get_args(CloningLoss))
def test_an_sb3_model_teaches(bc_loss):
    teacher = PPO("MlpPolicy", "UnitPendulum-v0", seed=5, device="cpu")
    model = build(expert=teacher, bc_loss=bc_loss).learn(ROLLOUT)
    observations, labels = map(th.from_numpy, model.dataset.pairs.values())
    np.testing.assert_allclose(
        labels, teacher.predict(observations.numpy(), deterministic=True)[0], atol=1e-5
    )


def test_how_errors_count():
    """Zero where the actions agree, convex, as steep as promised: linear far out, and with a
    squared part steeper still.
    """
    error = th.linspace(-2.0, 2.0, 801, dtype=th.float64)
    loss = cloning_errors(
        "huber_mse", error[:, None].repeat(1, 3), th.zeros(3), th.zeros(801, 3, dtype=th.float64)
    )
    assert loss.argmin() == 400 and loss.min() < 1e-12
    th.testing.assert_close(loss, loss.flip(0))
    slope = loss.diff() / error.diff()
    assert (slope.diff() > -1e-9).all()
    assert slope[-1] == pytest.approx(1.0 + 6.0 * 1.9975)


def test_without_a_value_term_only_the_actor_moves():
    model = build(vf_coef=0.0)
    actor, critic = actor_and_critic(model)
    model.learn(ROLLOUT)
    new_actor, new_critic = actor_and_critic(model)
    assert th.equal(critic, new_critic)
    assert not th.equal(actor, new_actor)


def test_the_critic_does_not_disturb_the_actor():
    """Their gradients are clipped separately: a large value loss leaves what the actor learns as it
    is.
    """
    actors = [
        actor_and_critic(build(vf_coef=c, max_grad_norm=0.1).learn(ROLLOUT))[0]
        for c in (0.0, 100.0)
    ]
    assert th.equal(*actors)


def test_the_deviation_stops_at_its_floor():
    model = build(
        bc_loss="nll", policy_kwargs={"log_std_init": -2.98}, learning_rate=1e-2, n_epochs=20
    ).learn(ROLLOUT * 4)
    assert model.policy.log_std.min().item() == pytest.approx(-3.0)


# --- Loss terms
# ------------------------------------------------------------------------------------------


def test_likelihood_and_entropy_are_those_of_the_policy():
    policy = build().policy
    observations, actions = th.randn(20, 3), th.randn(20, 1)
    _, log_prob, entropy = policy.evaluate_actions(observations, actions)
    mean = policy.get_distribution(observations).mode()
    th.testing.assert_close(-gaussian_nll(mean, policy.log_std, actions), log_prob)
    th.testing.assert_close(gaussian_entropy(policy.log_std).expand(20), entropy)


def test_the_clipped_value_loss_is_the_larger_one():
    values, old, returns = th.randn(100), th.randn(100), th.randn(100)
    plain = (values - returns).square().mean()
    assert max_clipped_value_loss(values, old, returns, 1e9) == pytest.approx(plain.item())
    assert max_clipped_value_loss(values, old, returns, 0.1) > plain


# --- Who flies
# ------------------------------------------------------------------------------------------


def flown(beta, **kwargs):
    """One rollout of 32 environments: the share flown by the expert per step and environment, (32,
    32).
    """
    recorder = Recorder("actions")
    model = build(pendulum(32), beta=beta, beta_final=beta, **kwargs).learn(
        32 * 32, callback=recorder
    )
    labels = model.dataset.pairs["actions"].reshape(32, 32, 1)
    return recorder.logged, (np.array([row[0] for row in recorder.rows]) == labels)[..., 0]


def test_the_expert_flies_with_probability_beta():
    assert flown(1.0)[1].all()
    assert not flown(0.0)[1].any()
    logged, by_expert = flown(0.5)
    assert by_expert.mean() == pytest.approx(0.5, abs=0.08)  # five standard deviations
    assert logged["rollout/expert_fraction"] == by_expert.mean()
    assert logged["dagger/beta"] == 0.5
    for axis in (0, 1):  # independently per step and environment
        assert by_expert.mean(axis=axis).std() == pytest.approx(
            0.5 / np.sqrt(32), rel=0.5
        )  # 0 or 0.5 if shared


def test_beta_falls_with_every_rollout_and_survives_a_save(tmp_path):
    model = build(beta=0.5, beta_decay=0.1, beta_final=0.25)
    seen = []
    for _ in range(4):
        seen.append(model.current_beta)
        model.learn(ROLLOUT, reset_num_timesteps=False)
    np.testing.assert_allclose(seen, [0.5, 0.4, 0.3, 0.25])
    model._n_rollouts = 2
    model.save(tmp_path / "model")
    assert DAgger.load(tmp_path / "model").current_beta == pytest.approx(0.3)
    assert model.learn(ROLLOUT).current_beta == pytest.approx(
        0.4
    )  # a new count of time begins β anew


# --- What is stored
# ------------------------------------------------------------------------------------------


def test_labels_belong_to_the_state_before_the_step():
    model = build().learn(ROLLOUT * 2)
    observations, labels = map(th.from_numpy, model.dataset.pairs.values())
    np.testing.assert_allclose(labels, turn_back(observations.numpy()), atol=1e-6)
    np.testing.assert_array_equal(
        observations[-ROLLOUT:].view(32, N_ENVS, 3), model.rollout_buffer.observations
    )


def test_time_limits_are_bootstrapped():
    """As in SB3: the reward of a truncated step gains γ V(terminal observation)."""
    recorder = Recorder("rewards", "infos", "dones")
    model = build(n_steps=201)
    model._setup_learn(402)
    model.set_expert(turn_back)
    recorder.init_callback(model)
    assert model.collect_rollouts(model.env, recorder, model.rollout_buffer, 201)
    rewards = np.array([row[0] for row in recorder.rows], dtype=np.float32)
    assert recorder.rows[199][2].all()
    terminal = np.stack([info["terminal_observation"] for info in recorder.rows[199][1]])
    with th.no_grad():
        rewards[199] += (
            model.gamma * model.policy.predict_values(th.from_numpy(terminal)).numpy().flatten()
        )
    np.testing.assert_allclose(model.rollout_buffer.rewards, rewards, rtol=1e-5)
    np.testing.assert_array_equal(model.rollout_buffer.episode_starts[[0, 200]], 1.0)
    with th.no_grad():
        values = model.policy.predict_values(
            th.from_numpy(model.rollout_buffer.observations[7])
        ).flatten()
    np.testing.assert_allclose(model.rollout_buffer.values[7], values, rtol=1e-5)


@pytest.mark.parametrize(
    ("capacity", "sizes"), [(0, [64, 64, 64]), (150, [64, 128, 150]), (1000, [64, 128, 192])]
)
def test_the_dataset_grows_to_its_capacity(capacity, sizes):
    model = build(dataset_capacity=capacity)
    for size in sizes:
        recorder = Recorder()
        model.learn(ROLLOUT, recorder, reset_num_timesteps=False)
        assert len(model.dataset) == size == recorder.logged["dagger/dataset_size"]


# --- Repeating and resuming
# ------------------------------------------------------------------------------------------


def test_an_interrupted_run_goes_on_bit_for_bit(tmp_path):
    settings = {
        "beta_decay": 0.05,
        "dataset_capacity": 150,
        "bc_loss": "nll",
        "clip_range_vf": 0.2,
        "seed": None,
    }
    whole = build(**settings).learn(ROLLOUT * 3)
    whole.save(tmp_path / "model")
    whole.dataset.save(tmp_path / "dataset.npz")
    whole.set_env(
        pendulum(seed=7)
    )  # episodes begin anew after an interruption, so they do here too
    whole.learn(ROLLOUT * 3, reset_num_timesteps=False)

    resumed = DAgger.load(tmp_path / "model", env=pendulum(seed=7), device="cpu", expert=turn_back)
    resumed.dataset.load(tmp_path / "dataset.npz")
    assert resumed.current_beta == pytest.approx(0.35)
    resumed.learn(ROLLOUT * 3, reset_num_timesteps=False)
    assert resumed.num_timesteps == whole.num_timesteps == ROLLOUT * 6
    assert th.equal(parameters(whole), parameters(resumed))


# --- The life of an SB3 algorithm
# -------------------------------------------------------------------------------------


def test_a_loaded_model_predicts_without_environment_or_expert(tmp_path):
    model = build(policy_kwargs={"net_arch": [16]}).learn(ROLLOUT)
    model.save(tmp_path / "model")
    observation = pendulum().reset()
    loaded = DAgger.load(tmp_path / "model")
    np.testing.assert_array_equal(
        loaded.predict(observation, deterministic=True)[0],
        model.predict(observation, deterministic=True)[0],
    )
    with pytest.raises(ExpertError, match="set_expert"):
        DAgger.load(tmp_path / "model", env=pendulum()).learn(ROLLOUT)


def test_an_expert_can_be_taken_away():
    model = build(beta=0.0).learn(ROLLOUT)
    model.set_expert(None)
    model.learn(ROLLOUT)
    assert len(model.dataset) == ROLLOUT


# --- Faults
# ------------------------------------------------------------------------------------------


class BadRewards(VecEnvWrapper):
    """Pendulum whose rewards turn NaN after some steps."""

    n_good = ROLLOUT

    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        observation, rewards, dones, infos = self.venv.step_wait()
        self.n_good -= self.num_envs
        return observation, rewards if self.n_good >= 0 else rewards * np.nan, dones, infos


def test_a_loss_that_is_not_finite_stops_training_and_spares_the_parameters():
    good = build().learn(ROLLOUT)
    model = build(BadRewards(pendulum()))
    with pytest.raises(TrainingError, match="lower learning_rate"):
        model.learn(ROLLOUT * 4)
    assert th.equal(parameters(good), parameters(model))


class Nothing(gym.Env):
    """An environment of the given spaces, in which nothing happens."""

    def __init__(self, observation_space, action_space):
        self.observation_space, self.action_space = observation_space, action_space


def test_dict_observations_and_discrete_actions_are_refused():
    env = Nothing(spaces.Dict(a=spaces.Box(-1, 1, (2,))), spaces.Box(-1, 1, (1,)))
    with pytest.raises(ConfigError, match="Dict"):
        DAgger("MultiInputPolicy", env)
    with pytest.raises(AssertionError, match=r"Discrete\(2\)"):  # SB3's own
        DAgger("MlpPolicy", "CartPole-v1")


def recorded(path, n_episodes=48):
    """Write the expert's flights of a pendulum, 50 steps each, into a file."""
    env = pendulum(n_episodes)
    observation = env.reset()
    observations, actions = [], []
    for _ in range(50):
        observations.append(observation)
        actions.append(turn_back(observation))
        observation, *_ = env.step(actions[-1])
    np.savez(path, obs=np.concatenate(observations), acts=np.concatenate(actions))


def test_flights_of_a_file_are_cloned_without_an_expert(tmp_path):
    recorded(tmp_path / "flights.npz")
    model = build(expert=None, beta=0, demonstrations=tmp_path / "flights.npz", gradient_steps=64)
    env = pendulum(16, seed=9)
    seen = env.reset()
    untrained = np.abs(model.predict(seen, deterministic=True)[0] - turn_back(seen)).mean()
    model.learn(20 * ROLLOUT)
    errors = np.abs(model.predict(seen, deterministic=True)[0] - turn_back(seen))
    assert errors.mean() < 0.2 * untrained
    # The agent's own flights have no labels, and do not become pairs.
    assert len(model.dataset) == 48 * 50
    assert model.beta_final == 0.0


def test_without_an_expert_beta_0_is_to_be_said(tmp_path):
    recorded(tmp_path / "flights.npz", 2)
    model = build(expert=None, demonstrations=tmp_path / "flights.npz")
    with pytest.raises(ExpertError, match="with beta=0, DAgger can clone the flights"):
        model.learn(ROLLOUT)
    model.set_beta(0.0)
    model.learn(ROLLOUT)
    model.dataset.clear()
    with pytest.raises(ExpertError, match="no expert"):
        model.learn(ROLLOUT)


def test_flights_of_a_file_are_held_beside_new_labels_of_an_expert(tmp_path):
    recorded(tmp_path / "flights.npz", 2)
    model = build(demonstrations=tmp_path / "flights.npz").learn(ROLLOUT)
    assert len(model.dataset) == 100 + ROLLOUT


def test_an_expert_that_is_to_fly_but_missing_is_noticed(tmp_path):
    class Later(BaseCallback):
        def _on_step(self):
            return True

        def _on_rollout_end(self):
            model: Any = self.model
            model.set_beta(0.5)

    recorded(tmp_path / "flights.npz", 2)
    model = build(expert=None, beta=0, demonstrations=tmp_path / "flights.npz")
    with pytest.raises(ExpertError, match=r"beta 0\.5: no expert"):
        model.learn(2 * ROLLOUT, callback=Later())


def test_demonstrations_that_the_first_labels_would_replace_are_refused(tmp_path):
    recorded(tmp_path / "flights.npz", 1)
    given = {"demonstrations": tmp_path / "flights.npz", "dataset_capacity": 0}
    with pytest.raises(ConfigError, match="dataset_capacity=0"):
        build(**given)
    build(expert=None, beta=0, **given)


def test_flights_of_another_range_of_actions_are_refused(tmp_path):
    np.savez(tmp_path / "rpm.npz", obs=np.zeros((3, 3)), acts=np.full((3, 1), 1500.0))
    with pytest.raises(ConfigError, match=r"rpm\.npz: .*actions from 1500 to 1500"):
        build(expert=None, beta=0, demonstrations=tmp_path / "rpm.npz")


class Ladder(gym.Env):
    """Observes a Python int, as a Discrete space allows."""

    observation_space = spaces.Discrete(5)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.rung = self.steps = 0
        return self.rung, {}

    def step(self, action):
        self.steps += 1
        self.rung = min(self.rung + int(action[0] > 0.0), 4)
        return self.rung, 0.0, False, self.steps == 4, {}


def test_an_observation_may_be_a_python_int_where_a_time_limit_ends_an_episode():
    def climb(observation):
        return np.ones((len(observation), 1))

    model = DAgger("MlpPolicy", Ladder(), expert=climb, n_steps=16, batch_size=8, seed=0)
    assert model.learn(32).num_timesteps == 32
