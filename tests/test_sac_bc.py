"""SAC with an expert: what each addition does, and switched off it is SAC."""

import inspect

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from gymnasium.wrappers import TransformObservation
from stable_baselines3 import PPO, SAC, TD3, HerReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecNormalize

from sb3_quad import SACBC, PIDExpert
from sb3_quad.agents.transfer import clone_policy, transfer_policy
from sb3_quad.algorithms import transfer
from sb3_quad.base.errors import ConfigError, ExpertError, TrainingError
from sb3_quad.envs import QuadcopterVecEnv

SMALL = {
    "policy_kwargs": {"net_arch": [16]},
    "batch_size": 32,
    "buffer_size": 2000,
    "seed": 3,
    "device": "cpu",
}


def swing_up(observation):
    """A simple expert for Pendulum-v1: pumps energy in, then holds."""
    cosine, sine, rate = observation.T
    hold = -10.0 * np.arctan2(sine, cosine) - 2.0 * rate
    missing = 15.0 * (1.0 - cosine) - 0.5 * rate**2  # of the energy at rest on top
    return np.where(cosine > 0.9, hold, 2.0 * np.sign(rate * missing))[:, None].clip(-2.0, 2.0)


def parameters(module):
    return th.cat([p.detach().flatten() for p in module.parameters()])


def pendulum(n_envs=4, **settings):
    given = {
        **SMALL,
        "learning_starts": 0,
        "train_freq": 4,
        "gradient_steps": 2,
        "expert": swing_up,
        **settings,
    }
    return SACBC("MlpPolicy", make_vec_env("Pendulum-v1", n_envs, seed=0), **given)


@pytest.mark.parametrize(
    "settings",
    [{}, {"use_sde": True}, {"ent_coef": 0.1, "n_steps": 3}, {"target_update_interval": 2}],
)
def test_without_additions_it_is_sac_bit_for_bit(monkeypatch, settings):
    stock = SAC("MlpPolicy", "Pendulum-v1", **SMALL, **settings).learn(160)
    ours = SACBC("MlpPolicy", "Pendulum-v1", **SMALL, **settings)
    monkeypatch.delattr(SAC, "train")
    ours.learn(160)
    assert (
        th.equal(parameters(stock.policy), parameters(ours.policy))
        and ours._n_updates == stock._n_updates > 50
    )
    for name, value in stock.logger.name_to_value.items():
        if name.startswith("train/"):
            assert ours.logger.name_to_value[name] == pytest.approx(value), name


def test_labels_go_with_n_step_returns():
    data = pendulum(bc_coef=0.5, n_steps=3).learn(400).replay_buffer.sample(300)
    np.testing.assert_allclose(
        2.0 * data.actions[:, 1:].numpy(), swing_up(data.observations.numpy()), atol=1e-5
    )
    assert (data.discounts.numpy() < 0.99).any()


def test_dict_observations_are_cloned_as_sac_takes_them():
    def make():
        observed = spaces.Dict(pole=spaces.Box(-1.0, 1.0, (2,)), rate=spaces.Box(-8.0, 8.0, (1,)))
        return TransformObservation(
            gym.make("Pendulum-v1"), lambda o: {"pole": o[:2], "rate": o[2:]}, observed
        )

    def expert(observation):
        return swing_up(np.hstack([observation["pole"], observation["rate"]]))

    given = {**SMALL, "learning_starts": 0, "expert": expert, "bc_coef": 0.5}
    model = SACBC("MultiInputPolicy", make_vec_env(make, 4, seed=0), **given).learn(400)
    data = model.replay_buffer.sample(300)
    parts = {name: values.numpy() for name, values in data.observations.items()}
    np.testing.assert_allclose(2.0 * data.actions[:, 1:].numpy(), expert(parts), atol=1e-5)
    assert model.logger.name_to_value["train/bc_loss"] > 0.0
    with pytest.raises(ConfigError, match=r"n_steps 3: .*Dict"):
        SACBC("MultiInputPolicy", make_vec_env(make, 4), n_steps=3)


def test_an_agent_of_other_networks_cannot_be_imitated_from_dict_observations():
    observed = spaces.Dict(all=spaces.Box(-8.0, 8.0, (3,)))

    def make():
        return TransformObservation(gym.make("Pendulum-v1"), lambda o: {"all": o}, observed)

    agent = PPO("MultiInputPolicy", make_vec_env(make, 1), device="cpu")
    with pytest.raises(ConfigError, match="FlattenObservation") as raised:
        SACBC("MultiInputPolicy", make_vec_env(make, 1), initial_policy=agent, **SMALL)
    assert "\n" not in str(raised.value)


def test_an_agent_is_imitated_by_the_present_statistics(monkeypatch):
    monkeypatch.setattr(transfer, "CLONE_ROWS", 400)
    monkeypatch.setattr(transfer, "CLONE_STEPS", 20)
    env = VecNormalize(make_vec_env("Pendulum-v1", 4, seed=0))
    model = SACBC("MlpPolicy", env, **SMALL)
    flown = []
    learnt_from = []
    step = env.venv.step_wait
    predict = model.policy._predict

    def step_wait():
        flown.append(env.get_original_obs())
        return step()

    def spy(observations, deterministic=False):
        learnt_from.append(observations.numpy())
        return predict(observations, deterministic)

    monkeypatch.setattr(env.venv, "step_wait", step_wait)
    monkeypatch.setattr(model.policy, "_predict", spy)
    clone_policy(PPO("MlpPolicy", "Pendulum-v1", device="cpu"), model)
    rows = {row.tobytes() for row in env.normalize_obs(np.concatenate(flown))}
    assert all(row.tobytes() in rows for row in learnt_from[-1])


def test_a_weight_that_comes_after_the_model_was_built_without_one_is_refused():
    model = SACBC("MlpPolicy", "Pendulum-v1", expert=swing_up, **SMALL)
    model.bc_coef = LinearSchedule(5.0, 1.0, 1.0)
    with pytest.raises(ConfigError, match=r"bc_coef .*built without cloning"):
        model.learn(150)


def test_the_weight_is_not_negative_where_the_last_flight_ends_late():
    model = SACBC(
        "MlpPolicy",
        make_vec_env("Pendulum-v1", 4, seed=0),
        expert=swing_up,
        bc_coef=lambda progress: progress,
        **SMALL,
    ).learn(150)
    assert model.num_timesteps > 150
    assert model.logger.name_to_value["train/bc_coef"] == 0.0


def test_normalised_critics_are_not_handed_on_to_plain_ones():
    agent = SACBC("MlpPolicy", "Pendulum-v1", critic_layer_norm=True, **SMALL)
    SACBC("MlpPolicy", "Pendulum-v1", critic_layer_norm=True, initial_policy=agent, **SMALL)
    with pytest.raises(ConfigError, match="give critic_layer_norm=True"):
        SACBC("MlpPolicy", "Pendulum-v1", initial_policy=agent, **SMALL)


def test_labels_lie_beside_the_actions_of_the_same_state():
    """Sampling takes as many global random numbers as SB3's buffer does, and no others."""
    buffer = pendulum(bc_coef=0.5).learn(1200).replay_buffer  # the episodes end after 800
    np.random.seed(0)  # noqa: NPY002 - SB3 samples from it
    data = buffer.sample(500)
    after = np.random.random()  # noqa: NPY002
    actions, labels = data.actions.split(1, dim=1)
    np.testing.assert_allclose(2.0 * labels.numpy(), swing_up(data.observations.numpy()), atol=1e-5)
    assert actions.shape == labels.shape == (500, 1)
    assert (actions != labels).any()
    np.random.seed(0)  # noqa: NPY002
    np.random.randint(0, buffer.pos, size=500)  # noqa: NPY002
    np.random.randint(0, high=4, size=500)  # noqa: NPY002
    assert np.random.random() == after  # noqa: NPY002


def test_cloning_moves_the_actor_towards_the_expert_and_leaves_the_critic_alone():
    def trained(bc_coef):
        model = pendulum(bc_coef=1e-9, gradient_steps=0, learning_rate=3e-3, ent_coef=0.01).learn(
            400
        )
        model.bc_coef = lambda progress: bc_coef
        th.manual_seed(0)
        np.random.seed(0)  # noqa: NPY002 - SB3 samples from it
        model.train(1, 64)
        critic = parameters(model.critic).clone()
        model.train(150, 64)
        observations = th.as_tensor(model.replay_buffer.observations.reshape(-1, 3))
        with th.no_grad():
            error = 2.0 * model.actor(observations, deterministic=True).numpy() - swing_up(
                observations.numpy()
            )
        return critic, np.sqrt(np.mean(error**2))

    (critic, without), (same, cloned) = trained(1e-9), trained(100.0)
    assert th.equal(critic, same) and cloned < 0.7 * without


@pytest.mark.parametrize("normalised", [False, True])
def test_normalised_critics_see_no_scale_of_a_layer_and_stock_sac_loads_the_zip(
    tmp_path, normalised
):
    model = SACBC("MlpPolicy", "Pendulum-v1", critic_layer_norm=normalised, **SMALL).learn(150)
    model.save(tmp_path / "model.zip")
    observations, actions = th.rand(50, 3), th.rand(50, 1)
    values = model.critic(observations, actions)[0]
    again = SACBC.load(tmp_path / "model.zip", device="cpu")
    assert th.equal(again.critic(observations, actions)[0], values)
    assert th.equal(
        again.critic_target(observations, actions)[0], model.critic_target(observations, actions)[0]
    )
    stock = SAC.load(tmp_path / "model.zip", device="cpu")
    assert th.equal(
        stock.actor(observations, deterministic=True), model.actor(observations, deterministic=True)
    )
    assert th.equal(stock.critic(observations, actions)[0], values) is not normalised
    with th.no_grad():
        for parameter in model.critic.q_networks[0][0].parameters():
            parameter *= 10.0
    assert (
        th.allclose(model.critic(observations, actions)[0], values, rtol=1e-2, atol=1e-2)
        is normalised
    )


@pytest.mark.parametrize("prefers", [True, False])
def test_the_q_filter_clones_where_the_critic_prefers_the_expert(prefers):
    model = pendulum(bc_coef=0.5, bc_filter="q")
    labels = th.tensor([[0.5], [-0.5]])
    model.critic.forward = lambda observations, actions: (actions if prefers else -actions,) * 2
    loss, share = model._bc_loss(
        th.zeros(2, 3), th.zeros(2, 1), labels
    )  # of the two, one is greater than the mean
    assert share == 0.5 and loss == pytest.approx(0.125)
    model.bc_filter = "none"
    assert model._bc_loss(th.zeros(2, 3), th.zeros(2, 1), labels)[1] == 1.0


def test_a_loss_that_is_not_finite_ends_the_training_and_other_arguments_are_sacs():
    theirs, ours = (inspect.signature(algorithm).parameters for algorithm in (SAC, SACBC))
    assert all(ours[name].default == theirs[name].default for name in theirs)
    stock = [name for name in theirs if name != "_init_setup_model"]
    added = [*ours][len(stock) :]
    assert [*ours][: len(stock)] == stock and added[:2] == ["expert", "initial_policy"]
    assert {ours[name].kind for name in added} == {inspect.Parameter.KEYWORD_ONLY}
    model = pendulum(bc_coef=0.5).learn(16)
    model.replay_buffer.rewards[:] = np.nan
    with pytest.raises(TrainingError, match="lower learning_rate"):
        model.train(1, 32)


def test_while_the_critic_warms_up_the_actor_stands_still():
    model = pendulum(critic_warmup=20, bc_coef=0.5)
    actor, critic = parameters(model.actor).clone(), parameters(model.critic).clone()
    model.learn(160)
    assert model._n_updates == 20
    assert th.equal(actor, parameters(model.actor)) and not th.equal(
        critic, parameters(model.critic)
    )
    model.learn(16, reset_num_timesteps=False)
    assert not th.equal(actor, parameters(model.actor))


def test_a_loaded_agent_is_the_same_and_needs_its_expert_to_go_on(tmp_path):
    """A run that goes on with its buffers: tests/test_value_based.py."""
    straight = pendulum(bc_coef=0.5).learn(320)
    straight.save(tmp_path / "agent.zip")
    loaded = SACBC.load(
        tmp_path / "agent.zip", device="cpu", expert=swing_up, env=straight.get_env()
    )
    assert (
        th.equal(parameters(straight.policy), parameters(loaded.policy))
        and loaded.expert is swing_up
    )
    with pytest.raises(ExpertError, match="set_expert"):
        SACBC.load(tmp_path / "agent.zip", device="cpu", env=straight.get_env()).learn(8)


@pytest.mark.parametrize(("saved", "present"), [(0.0, 0.5), (0.5, 0.0)])
def test_a_buffer_with_other_actions_is_refused_when_it_is_loaded(tmp_path, saved, present):
    path = tmp_path / "buffer.pkl"
    pendulum(bc_coef=saved).learn(40).save_replay_buffer(path)
    model = pendulum(bc_coef=present).learn(40)
    buffer = model.replay_buffer
    with pytest.raises(ConfigError, match=r"buffer\.pkl: has . numbers for each action") as raised:
        model.load_replay_buffer(path)
    assert "\n" not in str(raised.value) and model.replay_buffer is buffer
    model.learn(40, reset_num_timesteps=False)
    same = pendulum(bc_coef=saved)
    same.load_replay_buffer(path)
    same.learn(40, reset_num_timesteps=False)


def test_the_batch_gives_the_buffer_what_sb3_wants_of_ends():
    """A time limit is no end of the values; the state before it is the last of the same flight."""
    env = QuadcopterVecEnv(4, "target_tracking", seed=0, max_episode_steps=6)
    buffer = (
        SACBC("MlpPolicy", env, expert=PIDExpert(), bc_coef=0.5, **{**SMALL, "learning_starts": 0})
        .learn(48)
        .replay_buffer
    )
    flown = slice(0, 12)
    assert (
        buffer.dones[flown, 0].nonzero()[0].tolist() == [5, 11]
        and (buffer.dones == buffer.timeouts).all()
    )
    assert (buffer.sample(64).dones == 0).all()
    same = np.isclose(buffer.next_observations[:11], buffer.observations[1:12]).all(axis=(1, 2))
    assert same.tolist() == [True] * 5 + [False] + [True] * 5


@pytest.mark.parametrize(
    ("settings", "error", "message"),
    [
        ({"bc_loss": "nll"}, ConfigError, "bc_loss"),
        ({"bc_coef": 0.5, "expert": None}, ExpertError, "needs an expert"),
        ({"bc_coef": 0.5, "replay_buffer_class": HerReplayBuffer}, ConfigError, "has no room"),
    ],
)
def test_bad_input_is_said_in_one_line(settings, error, message):
    with pytest.raises(error, match=message) as raised:
        pendulum(**settings).learn(8)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("algorithm", [SACBC, TD3])
def test_an_actor_takes_over_what_an_on_policy_zip_flies(tmp_path, monkeypatch, algorithm):
    for name, value in {"CLONE_STEPS": 500, "CLONE_BATCH": 128, "CLONE_ROWS": 4000}.items():
        monkeypatch.setattr(transfer, name, value)
    env = make_vec_env("Pendulum-v1", 8, seed=0)
    teacher = PPO("MlpPolicy", env, seed=0, device="cpu")
    with th.no_grad():
        teacher.policy.action_net.weight *= 200.0  # SB3 begins near zero
    teacher.save(tmp_path / "ppo.zip")
    model = algorithm("MlpPolicy", env, **{**SMALL, "policy_kwargs": {"net_arch": [64, 64]}})
    seen = env.reset()
    taught, before = (each.predict(seen, deterministic=True)[0] for each in (teacher, model))
    transfer_policy(tmp_path / "ppo.zip", model)
    after = model.predict(seen, deterministic=True)[0]
    assert np.abs(after - taught).max() < 0.2 * np.abs(before - taught).max()
    model.save(tmp_path / "own.zip")
    again = algorithm(
        "MlpPolicy", env, **{**SMALL, "policy_kwargs": {"net_arch": [64, 64]}, "seed": 4}
    )
    transfer_policy(
        tmp_path / "own.zip", again
    )  # of its own kind: the same weights, the critic's too
    assert th.equal(parameters(again.policy), parameters(model.policy))
    if algorithm is SACBC:
        started = SACBC("MlpPolicy", env, initial_policy=model, buffer_size=2000, seed=5)
        assert th.equal(parameters(started.policy), parameters(model.policy))


@pytest.mark.slow
def test_it_learns_pendulum_from_its_expert_in_seconds():
    settings = {"bc_coef": 5.0, "learning_rate": 3e-3, "batch_size": 128}
    settings |= {
        "gradient_steps": 16,
        "train_freq": 8,
        "policy_kwargs": {"net_arch": [64, 64]},
        "ent_coef": 0.01,
    }
    # By how the CPU rounds, one of the seeds may end where it only saturates.
    agents = [pendulum(8, seed=seed, **settings).learn(8000) for seed in (1, 2, 3)]
    *rewards, new = (
        evaluate_policy(model, make_vec_env("Pendulum-v1", 16, seed=1), 16)[0]
        for model in [*agents, pendulum()]
    )
    assert np.median(rewards) > -300 and new < -900  # the expert has about -150
