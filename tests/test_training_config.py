"""Settings: what rl-zoo's YAML may hold arrives as the algorithm's arguments; everything else is
one clear error.
"""

import inspect
from pathlib import Path
from typing import Annotated, Any, Literal, Optional

import pytest
import torch.nn as nn
import yaml
from hypothesis import example, given
from hypothesis import strategies as st
from pydantic import Field
from stable_baselines3 import A2C, DDPG, DQN, PPO, SAC, TD3
from stable_baselines3.common.buffers import DictRolloutBuffer, ReplayBuffer, RolloutBuffer
from stable_baselines3.common.utils import LinearSchedule

from sb3_quad.agents.resolve import DEFAULT_EXPERT
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.literals import parse_mapping, parse_number, parse_value
from sb3_quad.cli.commands.train import DEFAULT_PIPELINE, THESIS
from sb3_quad.envs.registration import ENVIRONMENTS
from sb3_quad.envs.simulation.tasks import TASKS
from sb3_quad.envs.simulation.vehicle_distribution import DISTRIBUTIONS
from sb3_quad.envs.vec_env import QuadcopterVecEnv
from sb3_quad.envs.vehicles.vehicle import VEHICLES
from sb3_quad.training.algorithms import (
    ALGORITHMS,
    constructor_parameters,
    convert,
    get_algorithm,
)
from sb3_quad.training.config import (
    SETTINGS,
    TrainingJob,
    build_config,
    check_environment,
    describe,
    load_config,
)
from sb3_quad.training.pipeline import load_pipeline
from sb3_quad.training.trainer import build_model

ENV = "QuadTargetTracking-v0"
MINIMAL = {"n_timesteps": 1000}


def build(algo="dagger", env_id=ENV, **settings):
    return build_config(algo, env_id, {**MINIMAL, **settings})


@given(st.floats(min_value=1e-9, max_value=1.0))
def test_linear_schedules_are_sb3s_own(start):
    schedule = build(learning_rate=f"lin_{start:e}").hyperparams["learning_rate"]
    assert type(schedule).__module__ == "stable_baselines3.common.utils"
    assert schedule(1.0) == float(f"{start:e}")
    assert schedule(0.5) == pytest.approx(start / 2, rel=1e-5)
    assert schedule(0.0) == 0.0


@pytest.mark.parametrize(
    "given_kwargs",
    [
        "dict(net_arch=[64, 64], activation_fn=nn.Tanh)",
        {"net_arch": [64, 64], "activation_fn": "nn.Tanh"},
        {"net_arch": [64, 64], "activation_fn": "torch.nn.Tanh"},
        "{'net_arch': [64, 64], 'activation_fn': th.nn.Tanh}",
    ],
)
def test_policy_kwargs_in_every_spelling(given_kwargs):
    assert build(policy_kwargs=given_kwargs).policy_kwargs == {
        "net_arch": [64, 64],
        "activation_fn": nn.Tanh,
    }


@pytest.mark.parametrize(
    "text",
    [
        "__import__('os').system('true')",
        "dict(a=os.environ)",
        "dict(**{'a': 1})",
        "dict(",
        "nn.Tanh",
        "3",
        "(" * 5000,
    ],
)
def test_nothing_is_evaluated(text):
    with pytest.raises(ConfigError, match="policy_kwargs"):
        parse_mapping(text, "policy_kwargs")


@given(st.floats(allow_nan=False, allow_infinity=False, min_value=1e-12, max_value=1e12))
def test_numbers_may_be_strings(number):
    text = f"{number:e}"
    assert parse_number(text) == parse_value(text) == float(text)
    assert parse_number(number) == number


@given(st.text(max_size=30))
@example("0_")
def test_any_text_on_the_command_line_is_a_value(text):
    value = parse_value(text)
    assert value is None or isinstance(value, (bool, int, float, str, list, tuple, dict))


class Broken(PPO):
    """Its constructor has a bug."""

    def __init__(self, policy, env, seed, device, verbose, tensorboard_log, bug="", n_steps=1):
        eval(bug)


def test_the_bugs_of_a_constructor_are_no_bad_settings(monkeypatch):
    monkeypatch.setitem(ALGORITHMS, "Broken", "test_training_config:Broken")

    def make(algo, **settings):
        return build_model(TrainingJob(config=build(algo, **settings)), QuadcopterVecEnv(2))

    for bug, kind in (
        ("len(1)", TypeError),
        ("{}[0]", KeyError),
        ("exec('raise RuntimeError')", RuntimeError),
    ):
        with pytest.raises(kind) as raised:
            make("Broken", bug=bug)
        assert type(raised.value) is kind
    with pytest.raises(ConfigError, match="bug"):
        make("Broken", bugg="")


@pytest.mark.parametrize("algo", ["dagger", "ppo"])
@pytest.mark.parametrize("n_timesteps", [1000, 6_000_000])
def test_a_budget_of_less_than_a_rollout_shortens_it_and_the_line_says_what_is_trained(
    algo, n_timesteps
):
    config, shipped = (
        load_config(algo, ENV, None, {"n_timesteps": n_timesteps}),
        load_config(algo, ENV),
    )
    rollout = config.rollout
    assert rollout < n_timesteps + config.n_envs and config.keyword("batch_size") <= rollout
    longest = shipped.rollout
    assert rollout == longest if n_timesteps >= longest else rollout >= n_timesteps
    trained = -(-n_timesteps // rollout) * rollout
    line = describe(TrainingJob(config=config))
    assert f": {trained:,} timesteps" in line
    assert (f"({n_timesteps:,} were asked for)" in line) == (trained != n_timesteps)


def test_unknown_names_come_with_the_nearest():
    with pytest.raises(ConfigError, match="dagger"):
        load_config("dager", ENV)
    with pytest.raises(ConfigError, match="QuadStateRecovery-v0"):
        check_environment("QuadStateRecovry-v0")
    with pytest.raises(ConfigError, match=r"thesis/dagger.yml"):
        load_config("dagger", ENV, "thesis/dager.yml")


def test_whole_numbers_may_be_written_as_powers():
    config = build(n_timesteps="1e6", n_envs=4.0, n_steps="2_000")
    assert (config.n_timesteps, config.n_envs, config.hyperparams["n_steps"]) == (
        1_000_000,
        4,
        2000,
    )
    assert isinstance(config.hyperparams["n_steps"], int)


def test_overrides_go_over_the_file_and_into_env_kwargs(tmp_path):
    path = tmp_path / "mine.yml"
    path.write_text(
        yaml.safe_dump(
            {
                ENV: {
                    "n_timesteps": 10_000,
                    "gamma": 0.9,
                    "env_kwargs": {"noise": 0.1, "vehicle": "itm"},
                }
            }
        )
    )
    config = load_config("ppo", ENV, path, {"gamma": 0.8, "env_kwargs": {"noise": 0}})
    assert config.hyperparams == {"gamma": 0.8}
    assert config.env_kwargs == {"noise": 0, "vehicle": "itm"}
    with pytest.raises(ConfigError, match="command line: n_envs"):
        load_config("ppo", ENV, path, {"n_envs": 0})


def test_files_of_environments_have_absolute_paths(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("own.yaml").write_text(VEHICLES.text("crazyflie")[0])
    Path("ranges.yaml").write_text(DISTRIBUTIONS.text("raptor")[0])
    files = {
        "vehicle": ["itm", "own.yaml"],
        "rotor_layout": "own.yaml",
        "vehicles": {"distribution": "ranges.yaml", "mass": 1.0},
        "reference": "curve.csv",
    }
    curve = {"reference": {"curve": "file", "file": "curve", "heading": "path"}}
    config = build(env_kwargs=files, eval_env_kwargs=curve)
    assert config.env_kwargs == {
        "vehicle": ["itm", str(tmp_path / "own.yaml")],
        "rotor_layout": str(tmp_path / "own.yaml"),
        "vehicles": {"distribution": str(tmp_path / "ranges.yaml"), "mass": 1.0},
        "reference": str(tmp_path / "curve.csv"),
    }
    assert config.eval_env_kwargs["reference"]["file"] == str(tmp_path / "curve")
    monkeypatch.chdir("/")
    assert build_config("dagger", ENV, config.settings) == config
    names = {"rotor_layout": "itm", "vehicles": "raptor", "reference": "circle"}
    assert build(env_kwargs=names).env_kwargs == names


def test_files_that_settings_name_are_found_from_any_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    config = build(
        expert="teacher.zip", demonstrations="flown.npz", env_kwargs="dict(vehicle='v.yaml')"
    )
    assert config.expert == str(tmp_path / "teacher.zip")
    assert config.hyperparams["demonstrations"] == str(tmp_path / "flown.npz")
    assert config.env_kwargs == {"vehicle": str(tmp_path / "v.yaml")}
    for name in ("pid", "itm-robust", "module:factory"):
        assert build(expert=name).expert == name
    # Nobody knows what the keywords of others mean.
    others = {"vehicle": "car/blue", "reference": "v1.5"}
    assert build("ppo", "Pendulum-v1", env_kwargs=others).env_kwargs == others


def test_settings_can_be_written_and_read_again():
    config = load_config(
        "dagger",
        ENV,
        None,
        {"policy_kwargs": parse_value("dict(net_arch=(8, 8), activation_fn=nn.ReLU)")},
    )
    again = build_config("dagger", ENV, yaml.safe_load(yaml.safe_dump(config.settings)))
    assert again.policy_kwargs["activation_fn"] is nn.ReLU
    assert repr(sorted(again.hyperparams.items())) == repr(sorted(config.hyperparams.items()))


@pytest.mark.parametrize(
    "algorithm", [A2C, DDPG, DQN, PPO, SAC, TD3, *map(get_algorithm, ALGORITHMS)]
)
def test_the_types_of_every_algorithm_are_resolved(algorithm):
    parameters = constructor_parameters(algorithm)
    assert not [name for name, parameter in parameters.items() if parameter.annotation is Any]
    given = {
        name: parameter
        for name, parameter in parameters.items()
        if parameter.default is not parameter.empty
    }
    assert {name: convert(each.default, each, name) for name, each in given.items()} == {
        name: each.default for name, each in given.items()
    }


def test_the_types_are_resolved_whichever_algorithm_is_asked_first():
    """A name that SB3 leaves as a string is resolved once for the process; here nobody has done so
    yet.
    """

    class Own(PPO):
        def __init__(
            self,
            policy: str,
            env: Optional["VecEnv"],  # noqa: F821
            learning_rate: float = 0.1,
        ) -> None:
            raise NotImplementedError

    assert constructor_parameters(Own)["learning_rate"].annotation is float


@pytest.mark.parametrize(
    ("kind", "value", "expected"),
    [
        (int | None, "4.0", 4),
        (float | None, None, None),
        (bool, "False", False),
        (str | float, "auto", "auto"),
        (int | tuple[int, str], [1, "episode"], (1, "episode")),
        (dict[str, Any] | None, "dict(a=1)", {"a": 1}),
        (type[RolloutBuffer] | None, DictRolloutBuffer, DictRolloutBuffer),
        (type[RolloutBuffer] | None, "package.Buffer", "package.Buffer"),  # rl_zoo3 imports it
    ],
)
def test_a_value_becomes_what_its_type_says(kind, value, expected):
    found = convert(
        value, inspect.Parameter("x", inspect.Parameter.KEYWORD_ONLY, annotation=kind), "x"
    )
    assert found == expected and type(found) is type(expected)


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        (type[RolloutBuffer], ReplayBuffer),
        (Literal["a", "b"], "c"),
        (float, "inf"),
        (Any, float("nan")),
        (Annotated[float, Field(ge=0, le=1)] | LinearSchedule, 2),
        (Annotated[float, Field(ge=0, le=1)] | LinearSchedule, "lin_2"),
        (Annotated[float, Field(ge=0, le=1)], "lin_1"),
    ],
)
def test_a_value_of_another_type_or_out_of_range_is_refused(kind, value):
    with pytest.raises(ConfigError, match=r"^x"):
        convert(value, inspect.Parameter("x", inspect.Parameter.KEYWORD_ONLY, annotation=kind), "x")


PIPELINES = "two_stage.yml", "imitation.yml", "robust/crazyflie.yml", "rates.yml", THESIS


@pytest.mark.parametrize(
    "name", [name for name in SETTINGS.names() if not name.endswith(PIPELINES)]
)
def test_packaged_files_hold_good_settings(name):
    algo = name.rpartition("/")[2].removesuffix(".yml")
    algo = {"reference": "ppo_bc", "following": "apg"}.get(algo, algo)
    assert {*ENVIRONMENTS} <= SETTINGS.read(name)[0].keys()
    for env_id in ENVIRONMENTS:
        config = load_config(algo, env_id, name)
        assert config.env_id == env_id and config.settings


def test_the_thesiss_expert_is_the_default_and_others_are_asked_for_by_file():
    for algo in ("dagger", "ppo_bc"):
        # config.yml names the default expert.
        assert build(algo).settings["expert"] == load_config(algo, ENV).expert == DEFAULT_EXPERT
        assert load_config(algo, ENV, f"thesis/{algo}.yml").expert == "pid"
        assert load_config(algo, ENV, f"nominal/{algo}.yml").expert == "geometric"
        # In random worlds.
        assert load_config(algo, ENV, f"robust/{algo}.yml").expert == "privileged_geometric"
    experts = {
        DEFAULT_PIPELINE: "privileged_geometric",
        "nominal/two_stage.yml": "geometric",
        THESIS: "pid",
    }
    for file, expert in experts.items():
        for stage in load_pipeline(file).stages:
            # APG learns from none.
            config = stage.job({}).config
            assert config.expert == (None if config.algo == "apg" else expert)


SHARED = {
    "n_steps": 1500,
    "gamma": 0.998,
    "gae_lambda": 0.95,
    "vf_coef": 0.5,
    "l2_coef": 1e-4,
    "max_grad_norm": 0.5,
    "clip_range_vf": 0.2,
    "shuffle": False,
    "bc_loss": "nll",
}
SECOND = {
    **SHARED,
    "batch_size": 120_000,
    "n_epochs": 6,
    "learning_rate": 7.5e-4,
    "clip_range": 0.2,
    "ent_coef": 1e-4,
    "bc_filter": "none",
    "critic_warmup": 0,
}
PRINTED = {
    "IL-agent": {
        **SHARED,
        "batch_size": 45_000,
        "n_epochs": 12,
        "learning_rate": 5e-5,
        "ent_coef": 5e-4,
        "beta": 0.5,
        "beta_final": 0.3,
        "beta_decay": 0.001,
        "gradient_steps": None,
        "dataset_capacity": 0,
    },
    "RL-agent": {**SECOND, "bc_coef": 0.005},
    "PPO only": {**SECOND, "bc_coef": 0.0},
}
ROLLOUTS = {"IL-agent": 550, "RL-agent": 2450, "PPO only": 3000}  # 4.2.3


def test_the_printed_recipe_holds_every_value_of_tables_a3_and_a4():
    pipeline = load_pipeline("thesis/two_stage.yml")
    configs = {
        each.name: load_config(each.algo, each.env, each.conf_file) for each in pipeline.stages
    }
    configs["PPO only"] = load_config("ppo_bc", "QuadStateRecovery-v0", "thesis/reference.yml")
    for name, config in configs.items():
        assert PRINTED[name].items() <= config.hyperparams.items(), name
        assert config.n_timesteps == ROLLOUTS[name] * config.n_envs * 1500
        assert config.n_envs == 240 and config.policy_kwargs["net_arch"] == [64, 64]
        assert config.policy_kwargs["activation_fn"] is nn.Tanh
    assert configs["RL-agent"].expert == "pid"
    # The deviation of stage one, and SB3's
    assert "log_std_init" not in configs["RL-agent"].policy_kwargs
    assert configs["PPO only"].policy_kwargs["log_std_init"] == 0.0
    reward = TASKS["state_recovery"]
    assert (reward.position_cost, reward.tilt_cost, reward.body_rates_cost) == (
        0.003,
        0.002,
        0.0005,
    )
    assert (reward.collision_cost, reward.out_of_range_cost) == (15.0, 15.0)
