"""PPO with behavioural cloning: what it adds moves the right parameters, and switched off it is
PPO.
"""

import csv
import inspect

import numpy as np
import pytest
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.utils import LinearSchedule

from sb3_quad.algorithms.networks.losses import CLONING_LOSSES
from sb3_quad.algorithms.ppo_bc import PPOBC
from sb3_quad.base.errors import ConfigError, ExpertError, TrainingError
from sb3_quad.callbacks.best_model import BestModel

SMALL = {"n_steps": 64, "batch_size": 32, "n_epochs": 2, "seed": 3, "device": "cpu"}


def swing_back(observation):
    """A simple expert for Pendulum-v1: torque against the angular velocity."""
    return -0.5 * observation[:, 2:3]


def parameters(model):
    return th.cat([p.detach().flatten() for p in model.policy.parameters()])


def part(model, name):
    return {key: p.detach().clone() for key, p in model.policy.named_parameters() if name in key}


@pytest.mark.parametrize(
    ("env", "settings"),
    [
        ("Pendulum-v1", {}),
        ("Pendulum-v1", {"clip_range_vf": 0.2, "ent_coef": 0.01, "normalize_advantage": False}),
        (
            "Pendulum-v1",
            {"target_kl": 1e-3, "batch_size": 48},
        ),  # stops early; the last mini-batch is a smaller one
        ("Pendulum-v1", {"use_sde": True}),
        ("CartPole-v1", {"ent_coef": 0.01}),
    ],
)
@pytest.mark.filterwarnings("ignore:You have specified a mini-batch size")
def test_without_additions_it_is_ppo_bit_for_bit(monkeypatch, env, settings):
    """By our own loop: stock PPO's is out of reach while ours learns."""
    settings = {**SMALL, **settings}
    stock = PPO("MlpPolicy", env, **settings).learn(256)
    ours = PPOBC("MlpPolicy", env, bc_coef=0.0, max_clipped_value=False, **settings)
    monkeypatch.delattr(PPO, "train")
    ours.learn(256)
    assert th.equal(parameters(stock), parameters(ours))
    assert ours._n_updates == stock._n_updates
    for name, value in stock.logger.name_to_value.items():
        if name.startswith("train/"):
            assert ours.logger.name_to_value[name] == pytest.approx(value, rel=1e-5, abs=1e-6), name


@pytest.mark.parametrize(
    "settings", [{}, {"clip_range_vf": 0.2, "max_clipped_value": False}, {"target_kl": 1e-3}]
)
def test_with_a_vanishing_addition_it_is_ppo_to_rounding(settings):
    """The faster update computes what PPO's does: with a weight of 1e-12 on an addition, only
    rounding is left of it.
    """
    for_ppo = {key: value for key, value in settings.items() if key != "max_clipped_value"}
    stock = PPO("MlpPolicy", "Pendulum-v1", ent_coef=0.01, **for_ppo, **SMALL).learn(128)
    ours = PPOBC(
        "MlpPolicy", "Pendulum-v1", ent_coef=0.01, l2_coef=1e-12, bc_coef=0.0, **settings, **SMALL
    ).learn(128)
    start = PPO("MlpPolicy", "Pendulum-v1", ent_coef=0.01, **for_ppo, **SMALL)
    assert (parameters(stock) - parameters(start)).abs().max() > 1e-3
    th.testing.assert_close(parameters(ours), parameters(stock), rtol=1e-3, atol=1e-5)
    assert ours._n_updates == stock._n_updates


def test_labelling_alone_changes_nothing():
    """An expert whose weight is zero is not asked, and takes no random numbers from training."""
    stock = PPO("MlpPolicy", "Pendulum-v1", **SMALL).learn(256)
    ours = PPOBC("MlpPolicy", "Pendulum-v1", expert=swing_back, bc_coef=0.0, **SMALL).learn(256)
    assert th.equal(parameters(stock), parameters(ours))


def error(**settings):
    """Mean squared difference of actions from the expert's, after a short training."""
    model = PPOBC("MlpPolicy", "Pendulum-v1", learning_rate=3e-3, **settings, **SMALL).learn(512)
    observations = np.random.default_rng(0).normal(size=(256, 3)).astype(np.float32)
    return np.square(
        model.predict(observations, deterministic=True)[0]
        - np.clip(swing_back(observations), -2, 2)
    ).mean()


@pytest.fixture(scope="module")
def error_without_cloning():
    return error(bc_coef=0.0)


@pytest.mark.parametrize("bc_loss", CLONING_LOSSES)
def test_cloning_pulls_towards_the_expert(bc_loss, error_without_cloning):
    assert error(expert=swing_back, bc_coef=5.0, bc_loss=bc_loss) < 0.5 * error_without_cloning


def test_labels_belong_to_the_state_before_the_step():
    model = PPOBC("MlpPolicy", "Pendulum-v1", expert=swing_back, bc_coef=1.0, **SMALL)
    seen = []
    original = model.rollout_buffer.add

    def add(obs, *args, **kwargs):
        seen.append(
            (obs.copy(), model.rollout_buffer.expert_actions[model.rollout_buffer.pos].copy())
        )
        return original(obs, *args, **kwargs)

    model.rollout_buffer.add = add
    model.learn(64)
    assert len(seen) == 64
    for observation, label in seen:
        np.testing.assert_allclose(label, np.clip(swing_back(observation), -2, 2), rtol=1e-6)


def test_critic_warmup_moves_the_critic_only():
    model = PPOBC(
        "MlpPolicy", "Pendulum-v1", expert=swing_back, bc_coef=1.0, critic_warmup=1, **SMALL
    )
    before = {
        name: part(model, name) for name in ("policy_net", "action_net", "log_std", "value_net")
    }
    model.learn(64)
    for name in ("policy_net", "action_net", "log_std"):
        assert all(th.equal(old, part(model, name)[key]) for key, old in before[name].items()), name
    assert not all(
        th.equal(old, part(model, "value_net")[key]) for key, old in before["value_net"].items()
    )
    model.learn(64, reset_num_timesteps=False)
    assert not th.equal(before["log_std"]["log_std"], part(model, "log_std")["log_std"])


def test_evaluations_say_while_only_the_critic_has_learnt(tmp_path):
    model = PPOBC(
        "MlpPolicy", "Pendulum-v1", expert=swing_back, bc_coef=1.0, critic_warmup=2, **SMALL
    )
    before, told, unchanged = part(model, "log_std")["log_std"], [], []

    def report(line):
        told.append("critic warm-up: the policy does not learn yet" in line)
        unchanged.append(th.equal(before, part(model, "log_std")["log_std"]))

    files = tmp_path / "best_model.zip", tmp_path / "evaluations.npz"
    best = BestModel(make_vec_env("Pendulum-v1", 1), 64, 1, 0, *files, report=report)
    model.learn(256, callback=best)
    assert told == unchanged == [True, True, True, False]


def test_schedule_of_the_cloning_weight_follows_progress(tmp_path):
    model = PPOBC(
        "MlpPolicy",
        "Pendulum-v1",
        expert=swing_back,
        bc_coef=LinearSchedule(0.4, 0.0, 0.5),
        **SMALL,
    )
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(256)
    with open(tmp_path / "progress.csv", encoding="utf-8") as file:
        weights = [
            float(row["train/bc_coef"]) for row in csv.DictReader(file) if row["train/bc_coef"]
        ]
    assert (
        weights[0] == pytest.approx(0.2) and weights[-1] == 0.0
    )  # a quarter of the way, and the end


@pytest.mark.parametrize(("start", "weight"), [(0.0, 1.0), (1.0, 0.0)])
def test_a_rollout_is_labelled_exactly_if_its_update_clones(start, weight):
    """Also where a schedule changes between the rollout's begin and its end, when the update comes."""
    model = PPOBC(
        "MlpPolicy",
        "Pendulum-v1",
        expert=swing_back,
        bc_coef=lambda p: start if p > 0.75 else weight,
        **SMALL,
    )
    seen = []
    original = model.train

    def train():
        seen.append(bool(model.rollout_buffer.expert_actions.any()))
        original()
        assert seen[-1] == (model.logger.name_to_value["train/bc_coef"] > 0.0)

    model.train = train
    model.learn(4 * 64)
    assert seen == [weight > 0.0] * 4


def test_a_missing_expert_is_noticed_at_the_latest_when_it_is_to_be_cloned():
    model = PPOBC(
        "MlpPolicy", "Pendulum-v1", bc_coef=lambda progress: float(progress == 1.0 - 3 / 7), **SMALL
    )
    with pytest.raises(ExpertError, match="set_expert"):
        model.learn(64 * 7)
    assert model.num_timesteps == 64 * 2


def test_an_expert_is_asked_for_when_learning_starts(tmp_path):
    model = PPOBC("MlpPolicy", "Pendulum-v1", **SMALL)
    with pytest.raises(ExpertError, match="set_expert"):
        model.learn(64)
    model.set_expert(swing_back)
    model.learn(64)
    model.save(tmp_path / "model.zip")
    loaded = PPOBC.load(tmp_path / "model.zip", env=model.get_env(), expert=swing_back)
    loaded.learn(64, reset_num_timesteps=False)
    observations = np.zeros((1, 3), dtype=np.float32)
    np.testing.assert_array_equal(
        PPO.load(tmp_path / "model.zip").predict(observations, deterministic=True)[0],
        PPOBC.load(tmp_path / "model.zip").predict(observations, deterministic=True)[0],
    )


@pytest.mark.parametrize("l2_coef", [0.0, 1e-3])
@pytest.mark.parametrize("spoilt", ["advantages", "returns"])
def test_a_loss_that_is_not_finite_stops_training_and_keeps_the_parameters(l2_coef, spoilt):
    model = PPOBC("MlpPolicy", "Pendulum-v1", bc_coef=0.0, l2_coef=l2_coef, **SMALL)
    before = parameters(model)
    original = model.train

    def train():
        getattr(model.rollout_buffer, spoilt)[:] = np.nan
        original()

    model.train = train
    with pytest.raises(TrainingError, match="learning_rate"):
        model.learn(64)
    assert th.equal(before, parameters(model))


def test_a_policy_that_diverges_stops_training_whatever_computes_its_gradients():
    changes = {**SMALL, "policy_kwargs": {"activation_fn": th.nn.ELU}, "learning_rate": 1e30}
    with pytest.raises(TrainingError, match="not finite"):
        PPOBC("MlpPolicy", "Pendulum-v1", bc_coef=0.0, **changes).learn(640)


@pytest.mark.parametrize(
    "arguments",
    [
        {"bc_filter": "advantage"},
        {"expert": swing_back, "use_sde": True},
        {"rollout_buffer_class": RolloutBuffer},
        {"bc_coef": -1.0},
        {"critic_warmup": -5},
    ],
)
def test_bad_arguments_are_named(arguments):
    with pytest.raises(ConfigError, match=[*arguments][-1]):
        PPOBC("MlpPolicy", "Pendulum-v1", **arguments, **SMALL)


def test_state_dependent_exploration_clones_by_the_mean():
    PPOBC(
        "MlpPolicy", "Pendulum-v1", expert=swing_back, use_sde=True, bc_loss="mse", **SMALL
    ).learn(64)


def test_the_signature_is_ppos_and_what_is_added():
    stock, ours = (inspect.signature(algorithm).parameters for algorithm in (PPO, PPOBC))
    added = [
        "expert",
        "bc_coef",
        "bc_loss",
        "bc_filter",
        "l2_coef",
        "max_clipped_value",
        "critic_warmup",
        "shuffle",
    ]
    assert [*ours] == [
        *(name for name in stock if name != "_init_setup_model"),
        *added,
        "_init_setup_model",
    ]
    assert all(ours[name].default == stock[name].default for name in stock)


def test_in_order_mini_batches_follow_each_other_in_time():
    model = PPOBC(
        "MlpPolicy",
        make_vec_env("Pendulum-v1", n_envs=3),
        n_steps=4,
        batch_size=6,
        shuffle=False,
        bc_coef=0.0,
    )
    buffer = model.rollout_buffer
    for step in range(4):
        rewards = np.arange(3.0) + 10 * step
        buffer.add(
            np.zeros((3, 3)), np.zeros((3, 1)), rewards, np.zeros(3), th.zeros(3), th.zeros(3)
        )
    buffer.returns[:] = buffer.rewards
    seen = [
        critic.tensors(model.device)[1][:, 1].tolist() for _, critic in buffer.get(6, model.shuffle)
    ]
    assert seen == [[0, 1, 2, 10, 11, 12], [20, 21, 22, 30, 31, 32]]
