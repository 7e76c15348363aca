"""APG: it learns, its zips are stock, it resumes, and what it cannot differentiate is refused."""

import warnings

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import VecFrameStack, VecMonitor

from sb3_quad import APG, PPOBC, DAgger, QuadcopterVecEnv, fly
from sb3_quad.agents.zips import load_model, saved_algorithm
from sb3_quad.algorithms.apg import ACTION_CHANGE
from sb3_quad.algorithms.networks import network_of
from sb3_quad.base.errors import ConfigError, TrainingError
from sb3_quad.envs.flight_cost import flight_cost
from sb3_quad.envs.simulation.random import STEP
from sb3_quad.envs.simulation.tape import FlightTape

TASKS = {"state_recovery": 0.5, "target_tracking": 0.5}


def weights(model):
    return [tensor.clone() for tensor in model.policy.state_dict().values()]


def test_a_clone_becomes_faster_and_survives_more_recoveries():
    env = QuadcopterVecEnv(240, task=TASKS, seed=0)
    clone = DAgger("MlpPolicy", env, expert="geometric", seed=0).learn(240_000)
    env = QuadcopterVecEnv(256, task=TASKS, seed=1)
    agent = APG("MlpPolicy", env, initial_policy=clone, learning_rate=4e-3, seed=0)
    agent.learn(25 * 256 * 300)
    before, after = (fly(model, "target_tracking", 120, seed=3) for model in (clone, agent))
    assert after.survival.mean() > 0.95
    assert np.nanmedian(after.time_to[0.5]) < np.nanmedian(before.time_to[0.5]) - 0.1
    before, after = (fly(model, "state_recovery", 240, seed=4) for model in (clone, agent))
    assert after.survival.mean() > before.survival.mean()


def test_its_zip_loads_in_stock_ppo_and_says_how_it_flies(tmp_path):
    env = QuadcopterVecEnv(64, task="target_tracking", last_action=True, seed=0)
    agent = APG("MlpPolicy", env, n_steps=5, seed=0).learn(64 * 5)
    agent.save(tmp_path / "agent.zip")
    assert saved_algorithm(tmp_path / "agent.zip") == "APG"
    observations = env.reset()
    for loaded in (PPO.load(tmp_path / "agent.zip"), load_model(tmp_path / "agent.zip")):
        actions, _ = loaded.predict(observations, deterministic=True)
        np.testing.assert_array_equal(actions, agent.predict(observations, deterministic=True)[0])
    assert fly(loaded, n_episodes=2, last_action=True, max_episode_steps=5).n == 2


def test_the_critic_stays_and_the_environment_is_as_it_was():
    env = QuadcopterVecEnv(8, task="target_tracking", max_episode_steps=20, seed=0)
    agent = APG("MlpPolicy", env, n_steps=30, seed=0)
    critic = agent.policy.value_net.weight.clone()
    agent.learn(8 * 30)
    assert th.equal(agent.policy.value_net.weight, critic)
    env.reset()
    ended = [env.step(np.zeros((8, 4)))[2] for _ in range(20)]
    assert ended[-1].all()


def test_flights_that_carry_on_continue_where_they_were():
    env = QuadcopterVecEnv(8, task="target_tracking", seed=0)
    tape = env.record(5)
    tape.reset(continue_flights=False)
    for _ in range(5):
        tape.step(np.zeros((8, 4), np.float32))
    end = env.batch.state.copy()
    tape.reset(continue_flights=True)
    np.testing.assert_array_equal(env.batch.state, end)
    tape.reset(continue_flights=False)
    assert not np.array_equal(env.batch.state, end)


def test_flights_that_carry_on_end_at_their_time_limit():
    env = QuadcopterVecEnv(8, task="target_tracking", max_episode_steps=12, seed=0)
    tape = env.record(5)
    for steps_before in (0, 5, 10, 0):
        tape.reset(continue_flights=True)
        assert (env.batch.streams[STEP] == steps_before).all()
        for _ in range(5):
            tape.step(np.zeros((8, 4), np.float32))


def test_a_later_tape_carries_on_where_the_one_before_ended():
    """As in each further call of learn: all rows continue but those that were lost."""
    env = QuadcopterVecEnv(64, task="state_recovery", seed=0)
    first = env.record(190)
    first.reset()
    for _ in range(190):
        first.step(np.full((64, 4), -1.0, np.float32))
    end = env.batch.state.copy()
    snapshot = env.batch.snapshot()
    assert 0 < first.lost.sum() < 64
    for _ in range(2):
        env.record(5).reset(continue_flights=True)
        steps = np.where(first.lost, 0, 190)
        np.testing.assert_array_equal(env.batch.streams[STEP], steps)
        np.testing.assert_array_equal(env.batch.state[:, ~first.lost], end[:, ~first.lost])
        # In a process that resumes
        env = QuadcopterVecEnv(64, task="state_recovery", seed=1)
        env.batch.restore(snapshot)


def test_a_cost_of_ones_own_is_what_is_minimised():
    def level(flown):
        return 1.0 - flown.r33 + 0.01 * flight_cost(flown)

    def tilt(agent):
        env = QuadcopterVecEnv(64, task="target_tracking", seed=5)
        tape = env.record(60)
        observations = tape.reset()
        for _ in range(60):
            observations = tape.step(agent.predict(observations, deterministic=True)[0])
        x, y = np.moveaxis(tape.states[1:, 4:6], 1, 0)
        return float(np.mean(2.0 * (x**2 + y**2)))

    env = QuadcopterVecEnv(64, task="target_tracking", seed=0)
    agent = APG(
        "MlpPolicy",
        env,
        initial_policy="itm-recovery",
        n_steps=60,
        cost=level,
        seed=0,
        learning_rate=4e-3,
    )
    before = tilt(agent)
    agent.learn(30 * 64 * 60)
    assert tilt(agent) < 0.7 * before


@pytest.mark.parametrize("end_at_ground", [True, False])
def test_recordings_end_at_the_ground_unless_told_otherwise(end_at_ground):
    env = QuadcopterVecEnv(8, task="state_recovery", seed=0)
    agent = APG("MlpPolicy", env, n_steps=220, end_at_ground=end_at_ground, seed=0)
    agent.learn(8 * 220)
    tape = agent._tape
    assert isinstance(tape, FlightTape) and tape.lost.any()
    lost_later = tape.ends[tape.lost] > tape.lengths[tape.lost]
    assert lost_later.any() != end_at_ground


@pytest.mark.parametrize("n_envs", [8, 160])
def test_the_log_has_all_flights_of_an_update(n_envs):
    """Here only the first ones are lost, by a noise that makes the agent blind."""
    env = QuadcopterVecEnv(n_envs, task="target_tracking", seed=0)
    env.set_noise(np.where(np.arange(n_envs) < n_envs // 2, 5.0, 0.0))
    agent = APG("MlpPolicy", env, initial_policy="itm-recovery", n_steps=200, seed=0)
    agent.learn(n_envs * 200, log_interval=100)
    rewards, _, lost = agent._tape.episodes()
    assert 0 < lost.sum() < n_envs
    assert np.mean(agent.ep_success_buffer) == pytest.approx(1.0 - lost.mean())
    np.testing.assert_allclose([info["r"] for info in agent.ep_info_buffer], rewards)


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"policy_kwargs": {"optimizer_kwargs": {"weight_decay": 0.1}}}, "SOAP takes betas"),
        ({"policy_kwargs": {"net_arch": "64,64"}}, "net_arch '64,64': must be a list"),
        ({"policy": "MultiInputPolicy"}, "MultiInputPolicy: needs Dict observations"),
    ],
)
def test_arguments_that_do_not_fit_are_named(keywords, message):
    with pytest.raises(ConfigError, match=message) as raised:
        APG(**{"policy": "MlpPolicy", "env": QuadcopterVecEnv(2, seed=0), "n_steps": 5, **keywords})
    assert "\n" not in str(raised.value)


def test_a_file_of_vec_monitor_is_refused_since_it_would_stay_empty(tmp_path):
    env = VecMonitor(QuadcopterVecEnv(2, seed=0), str(tmp_path / "episodes"))
    with pytest.raises(ConfigError, match=r"VecMonitor: .* remove filename"):
        APG("MlpPolicy", env, n_steps=5).learn(10)


def test_what_cannot_be_differentiated_is_refused():
    env = QuadcopterVecEnv(2, seed=0)
    with pytest.raises(ConfigError, match="VecFrameStack: APG differentiates the environment"):
        APG("MlpPolicy", VecFrameStack(env, 2), n_steps=5).learn(10)
    APG("MlpPolicy", VecMonitor(env), n_steps=5).learn(10)
    with pytest.raises(ConfigError, match="has no record"):
        APG("MlpPolicy", "Pendulum-v1", n_steps=5).learn(5)
    fast = QuadcopterVecEnv(2, randomize={"motor_gain": [10.0, 10.0]}, seed=0)
    with pytest.raises(ConfigError, match="substeps 1: too few for motors"):
        APG("MlpPolicy", fast, n_steps=5, substeps=1).learn(10)
    taught = APG("MlpPolicy", env, n_steps=5)
    taught.set_expert("geometric")
    with pytest.raises(ConfigError, match="expert: APG asks none; give it to DAgger or PPOBC"):
        taught.learn(10)


def test_a_gradient_that_is_not_finite_leaves_the_weights_alone():
    env = QuadcopterVecEnv(4, seed=0)
    agent = APG("MlpPolicy", env, n_steps=5, cost=lambda flown: flown.distance * np.nan, seed=0)
    before = weights(agent)
    with pytest.raises(TrainingError, match="not finite"):
        agent.learn(20)
    assert all(th.equal(a, b) for a, b in zip(before, weights(agent), strict=True))


@pytest.mark.parametrize(
    "cost",
    [
        lambda flown: flight_cost(flown).mean(),
        lambda flown: flight_cost(flown)[1:],
        lambda flown: flight_cost(flown).detach(),
        lambda flown: flight_cost(flown).detach().numpy(),
    ],
)
def test_a_cost_of_another_shape_or_without_a_gradient_is_refused(cost):
    model = APG("MlpPolicy", QuadcopterVecEnv(2, seed=0), n_steps=5, cost=cost)
    with pytest.raises(ConfigError, match=r"cost: returned .* \(steps, n\) = \(5, 2\)"):
        model.learn(10)


@pytest.mark.parametrize("activation_fn", [th.nn.Tanh, th.nn.ELU])
def test_a_tape_may_reuse_its_array_and_gets_gradients_of_its_shape(activation_fn):
    """PyTorch computes the second policy."""
    policy = ActorCriticPolicy(
        spaces.Box(-np.inf, np.inf, (2, 1), np.float32),
        spaces.Box(-1.0, 1.0, (1,), np.float32),
        lambda _: 0.0,
        net_arch=[8],
        activation_fn=activation_fn,
    )
    flown = np.random.default_rng(0).normal(size=(3, 5, 2, 1)).astype(np.float32)
    results = []
    for reused in (False, True):
        array = flown[0].copy()
        recorded = network_of(policy).recorded(3, 5)
        for step in range(3):
            if not reused:
                array = array.copy()
            array[:] = flown[step]
            recorded.forward(step, array)
        policy.zero_grad()
        results.append([recorded.backward(step, np.ones((5, 1))) for step in (2, 1, 0)])
    np.testing.assert_array_equal(*results)
    assert np.shape(results) == (2, 3, 5, 2, 1)


def test_its_zip_leaves_other_algorithms_their_own_critic(tmp_path):
    env = QuadcopterVecEnv(4, seed=0)
    APG("MlpPolicy", env, n_steps=5, seed=0).save(tmp_path / "agent.zip")
    for loader in (PPO, PPOBC, DAgger, APG):
        loaded = loader.load(tmp_path / "agent.zip", env=env, device="cpu")
        new = loader("MlpPolicy", env)
        for name in ("gamma", "gae_lambda", "ent_coef", "vf_coef"):
            assert getattr(loaded, name) == getattr(new, name), name


def test_an_own_cost_must_be_given_again(tmp_path):
    env = QuadcopterVecEnv(2, seed=0)

    def cost(flown):
        return 2.0 * flight_cost(flown)

    APG("MlpPolicy", env, n_steps=5, cost=cost).learn(10).save(tmp_path / "agent")
    with pytest.raises(ConfigError, match="a cost of your own, which no zip holds"):
        APG.load(tmp_path / "agent", env=env).learn(10)
    APG.load(tmp_path / "agent", env=env, cost=cost).learn(10)
    APG.load(tmp_path / "agent", env=env, own_cost=False).learn(10)
    # A zip that was saved before the training says so, too.
    APG("MlpPolicy", env, n_steps=5, cost=cost).save(tmp_path / "new")
    APG.load(tmp_path / "agent", env=env, own_cost=False).save(tmp_path / "default")
    APG.load(tmp_path / "default", env=env, cost=cost).save(tmp_path / "changed")
    for name in ("new", "changed"):
        with pytest.raises(ConfigError, match="a cost of your own, which no zip holds"):
            APG.load(tmp_path / name, env=env).learn(10)
    APG.load(tmp_path / "default", env=env).learn(10)


def effort(flown):
    return flight_cost(flown) + flown.actions.square().sum(dim=-1)


def tracking(**keywords):
    """Return an agent whose updates change nothing unless it has a learning rate, and its
    environment.
    """
    env = QuadcopterVecEnv(16, task="target_tracking", max_episode_steps=100, seed=0)
    settings = {"initial_policy": "itm-recovery", "cost": effort, "learning_rate": 0.0}
    return APG("MlpPolicy", env, n_steps=20, seed=0, **(settings | keywords)), env


class At(BaseCallback):
    """Calls a function before one of the updates."""

    def __init__(self, update, function):
        super().__init__()
        self._update = update
        self._function = function

    def _on_rollout_start(self):
        self._update -= 1
        if self._update == -1:
            self._function(self.model)

    def _on_step(self):
        return True


def spoil(model):
    """Let the rotors hardly turn."""
    model.policy.action_net.bias.data -= 2.0


UPDATE = 16 * 20


def test_weights_that_fly_far_worse_are_replaced_by_the_best_at_half_the_rate():
    agent, _ = tracking()
    before = weights(agent)
    with pytest.warns(UserWarning, match=r"APG after 1,920 .* far above .* rate is halved"):
        agent.learn(7 * UPDATE, callback=At(5, spoil))
    assert all(th.equal(a, b) for a, b in zip(before, weights(agent), strict=True))
    assert agent.logger.name_to_value["train/n_undone"] == 1


def test_a_step_that_moves_the_actions_too_far_is_undone():
    agent, _ = tracking(learning_rate=1.0)
    before = weights(agent)
    with pytest.warns(UserWarning, match="a step changed the mean actions by"):
        agent.learn(UPDATE)
    assert all(th.equal(a, b) for a, b in zip(before, weights(agent), strict=True))
    # The rate falls until steps are short enough.
    with pytest.warns(UserWarning, match="the best weights are back"):
        agent.learn(20 * UPDATE)
    assert agent.logger.name_to_value["train/action_change"] < ACTION_CHANGE


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_task_that_becomes_harder_keeps_its_rate(sign):
    """Costs may be negative."""
    offset = [0.0]
    agent, _ = tracking(cost=lambda flown: sign * flight_cost(flown) + offset[0])
    with pytest.warns(UserWarning, match="far above"):
        agent.learn(12 * UPDATE, callback=At(5, lambda _: offset.append(offset.pop() + 10.0)))
    assert agent._n_undone == 0


@pytest.mark.parametrize("continue_flights", [False, True])
def test_an_ordinary_training_is_as_without_the_guard(monkeypatch, continue_flights):
    """With windows that begin in the hover, and now and then at other starts."""

    def train():
        settings = {"learning_rate": 1e-3, "cost": None, "continue_flights": continue_flights}
        agent, _ = tracking(**settings)
        return weights(agent.learn(8 * UPDATE))

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        guarded = train()
    monkeypatch.setattr(APG, "_cost_rise", lambda self, cost: 0.0)
    monkeypatch.setattr(APG, "_action_change", lambda self: 0.0)
    assert all(th.equal(a, b) for a, b in zip(guarded, train(), strict=True))


def test_the_best_weights_are_there_after_resuming(tmp_path):
    def go_on(agent):
        with pytest.warns(UserWarning, match="the best weights are back"):
            agent.learn(4 * UPDATE, callback=At(1, spoil), reset_num_timesteps=False)
        return [*weights(agent), th.tensor([agent._n_undone, agent._least_cost])]

    agent, env = tracking(learning_rate=1e-3)
    agent.learn(6 * UPDATE)
    agent.save(tmp_path / "agent")
    snapshot = env.batch.snapshot()
    whole = go_on(agent)

    _, env = tracking()
    resumed = APG.load(tmp_path / "agent", env=env, force_reset=False, cost=effort)
    env.batch.restore(snapshot)
    assert all(th.equal(a, b) for a, b in zip(whole, go_on(resumed), strict=True))
