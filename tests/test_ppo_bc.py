"""PPO with behavioural cloning: what it adds moves the right parameters, and switched off it is
PPO.
"""

import copy
import csv
import inspect
import math
from typing import get_args

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium.wrappers import TransformObservation
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecFrameStack, VecMonitor, VecNormalize

from sb3_quad import PPOBC, DAgger, load_pretrained
from sb3_quad.agents.agent_settings import agent_settings
from sb3_quad.algorithms.losses import CloningLoss
from sb3_quad.base.errors import ConfigError, ExpertError, TrainingError
from sb3_quad.callbacks.best_model import BestModel
from sb3_quad.envs import QuadcopterVecEnv
from sb3_quad.envs.simulation.settings import KEY
from sb3_quad.envs.vehicles.vehicle import load_vehicle

STOCK = {
    name: parameter.default
    for name, parameter in inspect.signature(PPO).parameters.items()
    if parameter.default is not inspect.Parameter.empty
}
# PPO's own values where the recommended defaults of PPOBC differ
PLAIN = {name: STOCK[name] for name in ("learning_rate", "gamma", "gae_lambda", "ent_coef")} | {
    "policy_kwargs": {"log_std_init": 0.0},
    "bc_loss": "nll",
    "bc_filter": "none",
    "critic_warmup": 0,
}
SIZES = {"n_steps": 64, "batch_size": 32, "n_epochs": 2, "seed": 3, "device": "cpu"}
SMALL = {**PLAIN, **SIZES}


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
        ("UnitPendulum-v0", {}),
        ("UnitPendulum-v0", {"ent_coef": 0.01, "normalize_advantage": False}),
        (
            "UnitPendulum-v0",
            {"target_kl": 1e-3, "batch_size": 48},
        ),  # stops early; the last mini-batch is a smaller one
        ("UnitPendulum-v0", {"use_sde": True}),
        ("CartPole-v1", {"ent_coef": 0.01}),
    ],
)
@pytest.mark.filterwarnings("ignore:You have specified a mini-batch size")
def test_without_additions_it_is_ppo_bit_for_bit(monkeypatch, env, settings):
    """By our own loop: stock PPO's is out of reach while ours learns."""
    settings = {**SIZES, **settings}
    stock = PPO("MlpPolicy", env, **settings).learn(256)
    ours = PPOBC("MlpPolicy", env, bc_coef=0.0, **{**PLAIN, **settings})
    monkeypatch.delattr(PPO, "train")
    ours.learn(256)
    assert th.equal(parameters(stock), parameters(ours))
    assert ours._n_updates == stock._n_updates
    for name, value in stock.logger.name_to_value.items():
        if name.startswith("train/"):
            assert ours.logger.name_to_value[name] == pytest.approx(value, rel=1e-5, abs=1e-6), name


@pytest.mark.parametrize("settings", [{}, {"target_kl": 1e-3}])
def test_with_a_vanishing_addition_it_is_ppo_to_rounding(settings):
    """The faster update computes what PPO's does: with a weight of 1e-12 on an addition, only
    rounding is left of it.
    """
    stock = PPO("MlpPolicy", "UnitPendulum-v0", ent_coef=0.01, **settings, **SIZES).learn(128)
    ours = PPOBC(
        "MlpPolicy",
        "UnitPendulum-v0",
        l2_coef=1e-12,
        bc_coef=0.0,
        **settings,
        **{**SMALL, "ent_coef": 0.01},
    ).learn(128)
    start = PPO("MlpPolicy", "UnitPendulum-v0", ent_coef=0.01, **settings, **SIZES)
    assert (parameters(stock) - parameters(start)).abs().max() > 1e-3
    th.testing.assert_close(parameters(ours), parameters(stock), rtol=1e-3, atol=1e-5)
    assert ours._n_updates == stock._n_updates


def error(**settings):
    """Mean squared difference of actions from the expert's, after a short training."""
    changes = {**SMALL, "learning_rate": 3e-3, **settings}
    model = PPOBC("MlpPolicy", "UnitPendulum-v0", **changes).learn(512)
    observations = np.random.default_rng(0).normal(size=(256, 3)).astype(np.float32)
    return np.square(
        model.predict(observations, deterministic=True)[0]
        - np.clip(swing_back(observations), -1, 1)
    ).mean()


@pytest.fixture(scope="module")
def error_without_cloning():
    return error(bc_coef=0.0)


@pytest.mark.parametrize("bc_loss", get_args(CloningLoss))
def test_cloning_pulls_towards_the_expert(bc_loss, error_without_cloning):
    assert error(expert=swing_back, bc_coef=5.0, bc_loss=bc_loss) < 0.5 * error_without_cloning


class Swing:
    """:func:`swing_back` for the true state of the pendulums, (angle, angular velocity)."""

    def actions(self, state):
        return -0.5 * state[:, 1:2]


def test_a_callback_that_calls_the_policy_leaves_the_labels_alone():
    class Calls(BaseCallback):
        def _on_step(self):
            observations = th.from_numpy(self.locals["new_obs"])
            with th.no_grad():
                self.model.policy(observations)
                self.model.policy(observations, deterministic=True)
            return True

        def _on_rollout_end(self):
            self._on_step()

    env = make_vec_env("UnitPendulum-v0", 2, seed=0)
    env.true_state = lambda: np.array([pendulum.unwrapped.state for pendulum in env.envs])
    model = PPOBC("MlpPolicy", env, expert=Swing(), bc_coef=1.0, **SMALL)
    seen = []
    model.train = lambda: seen.append(model.rollout_buffer)
    model.learn(128, callback=Calls())
    expected = np.clip(swing_back(seen[0].observations.reshape(-1, 3)), -1, 1)
    np.testing.assert_allclose(seen[0].expert_actions.reshape(-1, 1), expected, atol=1e-6)


def test_a_callback_may_copy_and_save_the_policy(tmp_path):
    copies = []

    class Keeps(BaseCallback):
        def _on_step(self):
            if not copies:
                copies.append(copy.deepcopy(self.model.policy))
                th.save(self.model.policy, tmp_path / "policy.pt")
            return True

    env = make_vec_env("UnitPendulum-v0", 2, seed=0)
    observation = env.reset()
    model = PPOBC("MlpPolicy", env, expert=swing_back, bc_coef=1.0, **SMALL)
    before, _ = model.predict(observation, deterministic=True)
    model.learn(128, callback=Keeps())
    saved = th.load(tmp_path / "policy.pt", weights_only=False)
    for policy in (*copies, saved):
        assert policy.forward.__self__ is policy
        np.testing.assert_array_equal(policy.predict(observation, deterministic=True)[0], before)
    after, _ = model.predict(observation, deterministic=True)
    assert not np.array_equal(after, before)


def test_schedules_may_give_any_number_and_stand_where_there_are_some():
    rate = {
        "learning_rate": lambda left: np.float32(1e-3) * left,
        "clip_range": lambda left: th.tensor(0.2),
    }
    PPOBC("MlpPolicy", "UnitPendulum-v0", bc_coef=0.0, **{**SMALL, **rate}).learn(64)
    with pytest.raises(ConfigError, match="l2_coef"):
        PPOBC("MlpPolicy", "UnitPendulum-v0", l2_coef=LinearSchedule(1.0, 0.0, 1.0), **SMALL)


def test_the_cloning_weight_is_not_negative_where_the_last_rollout_ends_late():
    model = PPOBC("MlpPolicy", "UnitPendulum-v0", expert=swing_back, bc_coef=lambda p: p, **SMALL)
    model.learn(100)
    assert model.rollout_buffer.bc_coef == 0.0


class Raised(BaseFeaturesExtractor):
    """A features extractor without parameters, which no state dict shows."""

    def __init__(self, space):
        super().__init__(space, 3)

    def forward(self, observations):
        return 2.0 * observations + 1.0


@pytest.mark.parametrize(("teacher", "algorithm"), [(PPO, PPOBC), (PPO, DAgger)])
def test_an_initial_policy_hands_on_how_its_networks_compute(teacher, algorithm):
    settings = {"net_arch": [8], "features_extractor_class": Raised}
    agent = teacher("MlpPolicy", "UnitPendulum-v0", policy_kwargs=settings, seed=0, device="cpu")
    model = algorithm("MlpPolicy", "UnitPendulum-v0", initial_policy=agent, seed=1, device="cpu")
    observations = np.random.default_rng(0).normal(size=(64, 3)).astype(np.float32)
    np.testing.assert_array_equal(
        model.predict(observations, deterministic=True)[0],
        agent.predict(observations, deterministic=True)[0],
    )
    other = {"features_extractor_class": FlattenExtractor}
    with pytest.raises(ConfigError, match="its weights give other actions here"):
        algorithm("MlpPolicy", "UnitPendulum-v0", initial_policy=agent, policy_kwargs=other)


def test_weight_decay_leaves_the_deviation_of_state_dependent_exploration_alone():
    once = {"batch_size": 64, "n_epochs": 1, "learning_rate": 1e-12, "max_grad_norm": math.inf}
    changes = {**SMALL, **once, "policy_kwargs": {"log_std_init": -1.0}, "use_sde": True}
    gradients = []
    for l2_coef in (0.0, 5.0):
        model = PPOBC("MlpPolicy", "UnitPendulum-v0", l2_coef=l2_coef, bc_coef=0.0, **changes)
        gradients.append(model.learn(64).policy.log_std.grad.clone())
    th.testing.assert_close(*gradients)


def test_critic_warmup_moves_the_critic_only():
    changes = {**SMALL, "critic_warmup": 1}
    model = PPOBC("MlpPolicy", "UnitPendulum-v0", expert=swing_back, bc_coef=1.0, **changes)
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
    changes = {**SMALL, "critic_warmup": 2}
    model = PPOBC("MlpPolicy", "UnitPendulum-v0", expert=swing_back, bc_coef=1.0, **changes)
    before = part(model, "log_std")["log_std"]
    reported, unchanged = [], []

    def report(line):
        reported.append("critic warm-up: the policy does not learn yet" in line)
        unchanged.append(th.equal(before, part(model, "log_std")["log_std"]))

    files = tmp_path / "best_model.zip", tmp_path / "evaluations.npz"
    best = BestModel(make_vec_env("UnitPendulum-v0", 1), 64, 1, 0, *files, report=report)
    model.learn(256, callback=best)
    assert reported == unchanged == [True, True, True, False]


def test_schedule_of_the_cloning_weight_follows_progress(tmp_path):
    model = PPOBC(
        "MlpPolicy",
        "UnitPendulum-v0",
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
    """Also where a schedule changes between the rollout's beginning and its end."""
    model = PPOBC(
        "MlpPolicy",
        "UnitPendulum-v0",
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
        "MlpPolicy",
        "UnitPendulum-v0",
        bc_coef=lambda progress: float(progress == 1.0 - 3 / 7),
        **SMALL,
    )
    with pytest.raises(ExpertError, match="set_expert"):
        model.learn(64 * 7)
    assert model.num_timesteps == 64 * 2


def test_an_expert_is_asked_for_when_learning_starts(tmp_path):
    model = PPOBC("MlpPolicy", "UnitPendulum-v0", **SMALL)
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
    model = PPOBC("MlpPolicy", "UnitPendulum-v0", bc_coef=0.0, l2_coef=l2_coef, **SMALL)
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
    changes = {
        **SMALL,
        "policy_kwargs": {"activation_fn": th.nn.ELU},
        "learning_rate": lambda _: 1e30,
    }
    with pytest.raises(TrainingError, match="not finite"):
        PPOBC("MlpPolicy", "UnitPendulum-v0", bc_coef=0.0, **changes).learn(640)


def test_state_dependent_exploration_has_no_likelihood_to_clone_by():
    with pytest.raises(ConfigError, match="use_sde"):
        PPOBC("MlpPolicy", "UnitPendulum-v0", expert=swing_back, use_sde=True, **SMALL)


def test_state_dependent_exploration_clones_by_the_mean():
    """The cloning term adds the gradient of the mean action's error, and none of the deviations."""
    one_step = {**SIZES, "batch_size": 64, "n_epochs": 1}
    changes = {**PLAIN, **one_step, "bc_loss": "mse", "learning_rate": 1e-12}
    by_mean, by_deviation = [], []
    for bc_coef in (1e-9, 5.0):
        model = PPOBC(
            "MlpPolicy",
            "UnitPendulum-v0",
            expert=swing_back,
            bc_coef=bc_coef,
            use_sde=True,
            max_grad_norm=float("inf"),
            **changes,
        ).learn(64)
        by_mean.append(model.policy.action_net.bias.grad.clone())
        by_deviation.append(model.policy.log_std.grad.clone())
    data = next(model.rollout_buffer.get())
    with th.no_grad():
        mean = model.policy.get_distribution(data.observations).mode()
    expected = 5.0 * 2.0 * (mean - data.expert_actions).mean(dim=0)
    assert expected.abs() > 0.05
    th.testing.assert_close(by_mean[1] - by_mean[0], expected, rtol=1e-3, atol=1e-4)
    th.testing.assert_close(*by_deviation)


def test_the_signature_is_ppos_and_what_is_added_after_it_by_keyword():
    ours = inspect.signature(PPOBC).parameters
    added = [
        "expert",
        "initial_policy",
        "bc_coef",
        "bc_loss",
        "bc_filter",
        "l2_coef",
        "critic_warmup",
        "shuffle",
        "check_expert",
    ]
    theirs = ("_init_setup_model", "rollout_buffer_class", "rollout_buffer_kwargs")
    stock = [name for name in inspect.signature(PPO).parameters if name not in theirs]
    assert [*ours] == [*stock, *added, "_init_setup_model"]
    assert {ours[name].kind for name in added} == {inspect.Parameter.KEYWORD_ONLY}
    recommended = {
        "learning_rate",
        "n_steps",
        "batch_size",
        "n_epochs",
        "gamma",
        "gae_lambda",
        "ent_coef",
    }
    assert {
        name for name in STOCK if name in ours and ours[name].default != STOCK[name]
    } == recommended


@pytest.mark.parametrize(
    ("n_envs", "n_steps", "batch_size"), [(480, 125, 3750), (1, 125, 125), (8, 125, 67), (3, 7, 21)]
)
def test_by_default_a_rollout_is_16_mini_batches_or_fewer_of_64_rows(n_envs, n_steps, batch_size):
    env = QuadcopterVecEnv(n_envs)
    assert PPOBC("MlpPolicy", env, n_steps=n_steps, expert="pid").batch_size == batch_size


@pytest.mark.parametrize(
    ("algorithm", "given"),
    [(PPOBC, {"expert": swing_back}), (DAgger, {"expert": swing_back})],
)
def test_learn_takes_sb3s_arguments_by_position(algorithm, given, tmp_path):
    model = algorithm("MlpPolicy", "UnitPendulum-v0", tensorboard_log=str(tmp_path), **given)
    seen = []

    def callback(local, _):
        seen.append(local.get("log_interval"))
        return len(seen) < 3

    assert model.learn(200, callback, 4, "run", True, False) is model
    assert len(seen) == 3 and [path.name for path in tmp_path.iterdir()] == ["run_1"]
    theirs, ours = (inspect.signature(each.learn).parameters for each in (PPO, algorithm))
    assert [*theirs] == [*ours]
    for name, parameter in theirs.items():
        assert ours[name].kind == parameter.kind
        expected = algorithm.__name__ if name == "tb_log_name" else parameter.default
        assert ours[name].default == expected


@pytest.mark.parametrize("kind", ["model", "zip", "name"])
def test_an_initial_policy_is_a_model_a_zip_or_a_name(kind, tmp_path):
    env = QuadcopterVecEnv(2)
    if kind == "name":
        source = "itm-imitation"
        policy = load_pretrained(source).policy
    else:
        arguments = {"net_arch": [24, 12], "activation_fn": th.nn.ReLU, "log_std_init": -1.5}
        teacher = DAgger("MlpPolicy", env, expert="pid", policy_kwargs=arguments)
        teacher.save(tmp_path / "teacher.zip")
        source = teacher if kind == "model" else tmp_path / "teacher.zip"
        policy = teacher.policy
    model = PPOBC("MlpPolicy", env, expert="pid", initial_policy=source, seed=7)
    theirs, ours = policy.state_dict(), model.policy.state_dict()
    assert theirs.keys() == ours.keys() and type(model.policy.mlp_extractor.policy_net[1]) is type(
        policy.mlp_extractor.policy_net[1]
    )
    for name, tensor in theirs.items():
        assert th.equal(tensor, ours[name])
    explores = {"log_std_init": -0.5}
    again = PPOBC("MlpPolicy", env, initial_policy=source, policy_kwargs=explores, expert="pid")
    assert again.policy.log_std.tolist() == [-0.5] * 4
    if kind == "model":
        with pytest.raises(ConfigError, match="policy_kwargs must be the same"):
            PPOBC("MlpPolicy", env, initial_policy=source, policy_kwargs={"net_arch": [8]})


def test_an_initial_policy_of_no_use_is_refused():
    source = PPO("MlpPolicy", "UnitPendulum-v0")
    with pytest.raises(ConfigError, match="must be a model, the path of a zip, or a name"):
        PPOBC("MlpPolicy", "UnitPendulum-v0", initial_policy=source.policy)
    th.nn.init.constant_(source.policy.action_net.bias, math.nan)
    with pytest.raises(
        ConfigError, match="the policy of PPO: holds parameters that are not finite"
    ):
        PPOBC("MlpPolicy", "UnitPendulum-v0", initial_policy=source)


def test_a_cloning_weight_needs_an_expert_and_actions_of_a_box():
    model = PPOBC("MlpPolicy", "UnitPendulum-v0", bc_coef=0)
    with pytest.raises(ExpertError, match=r"PPOBC\(\.\.\., expert='geometric'\), .* bc_coef=0"):
        model.set_bc_coef(0.1)
    assert not model.will_clone()
    with pytest.raises(ConfigError, match="Box action space only"):
        PPOBC("MlpPolicy", "CartPole-v1", expert=swing_back)


def test_an_initial_policy_that_observed_something_else_is_warned_of(capsys):
    def make(algorithm, initial=None, **observed):
        env = QuadcopterVecEnv(2, **observed)
        return algorithm(
            "MlpPolicy", env, expert="pid", initial_policy=initial, policy_kwargs={"net_arch": [8]}
        )

    observed = {"history": [0, 1], "preview": [0, 5], "position_integral": {"gain": 0.5}}
    teacher = make(DAgger, **observed)
    make(PPOBC, teacher, **observed)
    # Training may do without the integral, and whoever adds one or a preview does so on purpose.
    make(PPOBC, teacher, **observed | {"position_integral": None})
    make(PPOBC, make(DAgger), preview=[0, 5], position_integral={})
    assert "warning" not in capsys.readouterr().err
    other = {"history": [0, 4], "preview": [0, 9], "position_integral": {"gain": 1.0}}
    make(PPOBC, teacher, **other, observation_std=[2.0] * 18)
    warning = capsys.readouterr().err
    assert warning.count("\n") == 1
    for difference in ("history [0, 1], here [0, 4];", "preview [0, 5], here [0, 9];"):
        assert difference in warning
    assert "'gain': 0.5" in warning and "observation_std)" in warning


def flights_of(model):
    return getattr(model, KEY, None)


def test_zips_say_how_their_agent_flies_where_wrappers_leave_the_flight_alone(tmp_path):
    own = {"vehicle": "crazyflie", "noise": 0.1, "observation_mean": [0.5] * 18}
    env = VecMonitor(QuadcopterVecEnv(2, "state_recovery", max_episode_steps=50, **own))
    model = PPOBC("MlpPolicy", env, expert="pid")
    model.save(tmp_path / "model.zip")
    settings, source = agent_settings(tmp_path / "model.zip")
    assert source == tmp_path / "model.zip" and settings.vehicle == load_vehicle("crazyflie")
    assert (settings.noise, settings.observation_mean) == (0.1, [0.5] * 18)
    assert (settings.task, settings.max_episode_steps) == ("state_recovery", 50)

    model.set_env(QuadcopterVecEnv(2, vehicle="hummingbird"))
    assert flights_of(model)["vehicle"]["name"] == load_vehicle("hummingbird").name
    single = make_vec_env("QuadTargetTracking-v0", 2, env_kwargs={"vehicle": "crazyflie"})
    assert flights_of(DAgger("MlpPolicy", single))["vehicle"]["name"] == settings.vehicle.name

    plain = QuadcopterVecEnv(2)
    assert flights_of(PPOBC("MlpPolicy", plain))["observation_mean"] is None
    for stacked in (VecFrameStack(plain, 2), VecNormalize(VecFrameStack(plain, 2))):
        assert flights_of(PPOBC("MlpPolicy", stacked)) is None
    normalised = PPOBC("MlpPolicy", VecNormalize(plain))
    assert flights_of(normalised) is not None and normalised.vec_normalize is normalised.env
    assert flights_of(PPOBC("MlpPolicy", "UnitPendulum-v0")) is None

    def turned():
        box = gym.spaces.Box(-np.inf, np.inf, (18,), np.float32)
        return TransformObservation(gym.make("QuadTargetTracking-v0"), lambda x: -x, box)

    assert flights_of(PPOBC("MlpPolicy", make_vec_env(turned, 1))) is None
    normalised.set_env(VecNormalize(make_vec_env(turned, 2)))
    assert flights_of(normalised) is None


def test_a_callback_finds_the_rollout_buffer_that_sb3_has(tmp_path):
    model = PPOBC("MlpPolicy", "UnitPendulum-v0", expert=swing_back, bc_coef=1.0, **SMALL)
    rows = []

    class Look(BaseCallback):
        def _on_step(self):
            return True

        def _on_rollout_end(self):
            for data in self.model.rollout_buffer.get(48):
                values, log_prob, _ = self.model.policy.evaluate_actions(
                    data.observations, data.actions
                )
                th.testing.assert_close(values.flatten(), data.old_values)
                th.testing.assert_close(log_prob, data.old_log_prob, rtol=1e-4, atol=1e-5)
                expected = np.clip(swing_back(data.observations.numpy()), -1, 1)
                np.testing.assert_allclose(data.expert_actions, expected, rtol=1e-6)
                assert data.advantages.shape == data.returns.shape == (len(values),)
                rows.append(len(values))

    model.learn(64, callback=Look())
    assert rows == [48, 16]


def test_in_order_mini_batches_follow_each_other_in_time():
    model = PPOBC(
        "MlpPolicy",
        make_vec_env("UnitPendulum-v0", n_envs=3),
        n_steps=4,
        batch_size=6,
        shuffle=False,
        bc_coef=0.0,
        critic_warmup=0,
    )
    buffer = model.rollout_buffer
    for step in range(4):
        rewards = np.arange(3.0) + 10 * step
        buffer.add(
            np.zeros((3, 3)), np.zeros((3, 1)), rewards, np.zeros(3), th.zeros(3), th.zeros(3)
        )
    buffer.returns[:] = buffer.rewards
    batches = [*buffer.minibatches(6, model.shuffle)]
    seen = [buffer.samples(rows).returns.tolist() for rows in batches]
    compiled = [buffer.batches(rows)[1].tensors(model.device)[1][:, 1].tolist() for rows in batches]
    assert seen == compiled == [[0, 1, 2, 10, 11, 12], [20, 21, 22, 30, 31, 32]]
