"""The settings of one training job, from rl-zoo's YAML: one file per algorithm, top keys environment ids.

====================  ============================================================================================
key                   meaning
====================  ============================================================================================
n_timesteps           transitions to train on, over all environments
n_envs                environments flown side by side (1)
vec_env               batch (default for this package's environments), dummy (default for others) or subproc
env_kwargs            keywords of the environment's constructor
eval_env_kwargs       put over them in the evaluation's environments
eval_tasks            further tasks to evaluate on, for the curves; the environment's own decides which model is best
eval_expert           whether evaluations fly the expert too, once, for ``eval/reward_against_expert`` (false)
policy                name of a policy, MlpPolicy by default
policy_kwargs         mapping, or a string such as "dict(net_arch=[64, 64], activation_fn=nn.Tanh)"
expert                pid, geometric, path/to/model.zip or package.module:factory, for algorithms that learn from one
callback              callbacks as package.module.Class, one or a list; with keywords as {package.module.Class: {…}}
env_wrapper           wrappers around each environment, likewise (dummy and subproc)
vec_env_wrapper       wrappers around the vectorised environment, likewise
anything else         a keyword of the algorithm's constructor; ``lin_1e-3`` falls linearly to 0 over the training
====================  ============================================================================================
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any

import gymnasium
import yaml

from sb3_quad.base.errors import ConfigError, unknown
from sb3_quad.envs.registration import ENVIRONMENTS
from sb3_quad.settings.algorithms import constructor_parameters, get_algorithm, takes_expert
from sb3_quad.settings.literals import parse_mapping
from sb3_quad.settings.values import convert, positive_whole, qualified_classes
from sb3_quad.simulation.tasks import TASKS
from sb3_quad.vehicles.vehicle import is_vehicle_file

VEC_ENVS = ("batch", "dummy", "subproc")
CONFIG_FOLDERS = ("geometric", "thesis")  # with further settings files, inside zoo_configs
_JOB_KEYS = (
    *("n_timesteps", "n_envs", "vec_env", "env_kwargs", "eval_env_kwargs", "eval_tasks", "eval_expert"),
    *("policy", "policy_kwargs", "expert", "callback", "env_wrapper", "vec_env_wrapper", "normalize"),
)
_ENV_KEYS = ("env_kwargs", "eval_env_kwargs")
# What env_kwargs may give to a quadcopter environment, batched or not.
QUADCOPTER_KEYWORDS = (
    *("task", "task_kwargs", "vehicle", "noise", "observation_mean", "observation_std", "max_episode_steps"),
)


@dataclass(frozen=True)
class TrainingConfig:
    """One job's settings, checked. ``settings`` holds them as given: plain values that YAML can hold."""

    algo: str
    env_id: str
    n_timesteps: int
    n_envs: int
    vec_env: str
    env_kwargs: dict[str, Any]
    eval_env_kwargs: dict[str, Any]
    eval_tasks: tuple[str, ...]
    eval_expert: bool
    policy: str
    policy_kwargs: dict[str, Any]
    expert: Any
    callback: list[tuple[str, dict[str, Any]]]
    env_wrapper: list[tuple[str, dict[str, Any]]]
    vec_env_wrapper: list[tuple[str, dict[str, Any]]]
    hyperparams: dict[str, Any]
    settings: dict[str, Any] = field(repr=False)

    @property
    def task(self) -> str | None:
        """The quadcopter task, None for an environment that is not this package's."""
        return ENVIRONMENTS.get(self.env_id)

    @property
    def flight_kwargs(self) -> dict[str, Any]:
        """What ``env_kwargs`` says of vehicle, noise and scaling: what an agent of this job must be flown with in any task."""
        return {key: self.env_kwargs[key] for key in ("vehicle", "noise", "observation_std") if key in self.env_kwargs}


def load_config(
    algo: str, env_id: str, conf_file: str | Path | None = None, overrides: dict[str, Any] | None = None
) -> TrainingConfig:
    """The settings of ``env_id`` in a YAML file, with ``overrides`` put over them (into them, for ``env_kwargs``).

    :param conf_file: path of a file, or the name of one that comes with the package such as ``thesis/dagger.yml``;
        None for ``<algo>.yml`` of the package.
    :raises ConfigError: an unknown algorithm, environment or key, an unreadable file, a value that does not fit.
    """
    get_algorithm(algo)
    check_environment(env_id)
    content, where = read_settings(conf_file if conf_file is not None else f"{algo}.yml")
    if not isinstance(content, dict):
        raise ConfigError(f"{where}: must hold environment ids with their settings")
    if env_id not in content:
        listed = [str(key) for key in content]
        raise ConfigError(f"{where}: {unknown('environment in this file', env_id, listed)}; give another with --conf-file")
    settings = content[env_id]
    if not isinstance(settings, dict):
        raise ConfigError(f"{where}: {env_id} must hold keys and values, such as 'n_envs: 8'")
    changes = dict(overrides or {})
    if "env_kwargs" in changes:
        base = parse_mapping(settings.get("env_kwargs"), f"{where}: env_kwargs")
        changes["env_kwargs"] = {**base, **parse_mapping(changes["env_kwargs"], "env_kwargs")}
    return build_config(algo, env_id, {**settings, **changes}, where, changes)


def build_config(
    algo: str, env_id: str, settings: dict[str, Any], where: str = "settings", changes: Collection[str] = ()
) -> TrainingConfig:
    """The checked settings of one job, from a plain mapping.

    :param where: what the messages call the source of the settings.
    :param changes: keys that come from the command line instead.
    :raises ConfigError: see :func:`load_config`.
    """
    algorithm = get_algorithm(algo)
    check_environment(env_id)
    settings = {key: with_vehicle_path(value) if key in _ENV_KEYS else value for key, value in settings.items()}
    parameters = constructor_parameters(algorithm)

    def at(key: str) -> str:
        return f"{'command line' if key in changes else where}: {key}"

    for key in settings:
        if key not in _JOB_KEYS and key not in parameters:
            source = at(key).removesuffix(f": {key}")
            raise ConfigError(f"{source}: {unknown(f'key of {algo}', key, [*_JOB_KEYS, *parameters])}")
    if settings.get("normalize"):
        raise ConfigError(f"{at('normalize')} is not supported: its statistics are not part of a model's zip; use false")
    if "n_timesteps" not in settings:
        raise ConfigError(f"{where}: n_timesteps is missing; give it there or with -n")
    learns = takes_expert(algorithm)
    if settings.get("expert") is not None and not learns:
        raise ConfigError(f"{at('expert')}: {algo} learns from no expert; leave it away")
    if not isinstance(settings.get("eval_expert", False), bool):
        raise ConfigError(f"{at('eval_expert')} is {settings['eval_expert']!r}, must be true or false")
    if settings.get("eval_expert") and not learns:
        raise ConfigError(f"{at('eval_expert')}: {algo} learns from no expert to compare with; leave it away")
    return TrainingConfig(
        algo=algo,
        env_id=env_id,
        n_timesteps=positive_whole(settings["n_timesteps"], at("n_timesteps")),
        n_envs=positive_whole(settings.get("n_envs", 1), at("n_envs")),
        vec_env=_vec_env(settings.get("vec_env"), env_id, at("vec_env")),
        env_kwargs=_env_kwargs(settings.get("env_kwargs"), env_id, at("env_kwargs")),
        eval_env_kwargs=_env_kwargs(settings.get("eval_env_kwargs"), env_id, at("eval_env_kwargs")),
        eval_tasks=_eval_tasks(settings.get("eval_tasks"), env_id, at("eval_tasks")),
        eval_expert=settings.get("eval_expert", False),
        policy=_known(settings.get("policy", "MlpPolicy"), algorithm.policy_aliases, at("policy")),
        policy_kwargs=parse_mapping(settings.get("policy_kwargs"), at("policy_kwargs")),
        expert=settings.get("expert") or ("pid" if learns else None),
        callback=qualified_classes(settings.get("callback"), at("callback")),
        env_wrapper=qualified_classes(settings.get("env_wrapper"), at("env_wrapper")),
        vec_env_wrapper=qualified_classes(settings.get("vec_env_wrapper"), at("vec_env_wrapper")),
        hyperparams={key: convert(value, parameters[key], at(key)) for key, value in settings.items() if key in parameters},
        settings=dict(settings),
    )


def with_vehicle_path(value: Any) -> Any:
    """``env_kwargs`` whose vehicle file, if they name one, can be found from any folder: runs are flown and resumed later."""
    vehicle = value.get("vehicle") if isinstance(value, dict) else None
    if not isinstance(vehicle, (str, Path)) or not is_vehicle_file(vehicle):
        return value
    return {**value, "vehicle": str(Path(vehicle).absolute())}


def check_environment(env_id: str) -> None:
    """:raises ConfigError: an environment that Gymnasium does not know; the message names the nearest."""
    if env_id in gymnasium.registry:
        return
    nearest = unknown("environment", env_id, gymnasium.registry).split(" (valid:")[0]
    raise ConfigError(f"{nearest} (of this package: {', '.join(ENVIRONMENTS)}; others: --gym-packages)")


def config_names() -> list[str]:
    """The YAML files that come with the package, as ``--conf-file`` takes them."""
    root = resources.files("sb3_quad.zoo_configs")
    folders = {"": root, **{f"{name}/": root.joinpath(name) for name in CONFIG_FOLDERS}}
    return [
        f"{prefix}{name}"
        for prefix, folder in folders.items()
        for name in sorted(entry.name for entry in folder.iterdir())
        if name.endswith(".yml")
    ]


def read_yaml(text: str, where: str, loader: type[yaml.SafeLoader] = yaml.SafeLoader) -> Any:
    """:raises ConfigError: text that is not YAML, in one line."""
    try:
        return yaml.load(text, Loader=loader)
    except yaml.YAMLError as error:
        raise ConfigError(f"{where}: not valid YAML ({' '.join(str(error).split())})") from None


def read_settings(conf_file: str | Path) -> tuple[Any, str]:
    """The content of a settings file on disk or in the package, and what to call it.

    :raises ConfigError: no such file, or one that cannot be read.
    """
    name = str(conf_file)
    path = Path(conf_file)
    if path.is_file():
        try:
            return read_yaml(path.read_text(encoding="utf-8"), name), name
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(f"{name}: cannot be read ({error})") from None
    if name not in config_names():
        raise ConfigError(f"{unknown('settings file', name, config_names())}, or the path of one")
    return read_yaml(resources.files("sb3_quad.zoo_configs").joinpath(name).read_text(encoding="utf-8"), name), name


def _known(value: Any, valid: Collection[str], where: str) -> str:
    if str(value) not in valid:
        source, _, key = where.rpartition(": ")
        raise ConfigError(f"{source}: {unknown(key, value, valid)}")
    return str(value)


def _vec_env(value: Any, env_id: str, where: str) -> str:
    kind = _known(value or ("batch" if env_id in ENVIRONMENTS else "dummy"), VEC_ENVS, where)
    if kind == "batch" and env_id not in ENVIRONMENTS:
        raise ConfigError(f"{where} is batch, but {env_id} has no batched form; use dummy or subproc")
    return kind


def _eval_tasks(value: Any, env_id: str, where: str) -> tuple[str, ...]:
    names = [] if value is None else value if isinstance(value, list) else [value]
    if names and env_id not in ENVIRONMENTS:
        raise ConfigError(f"{where}: {env_id} has no tasks; leave it away")
    return tuple(_known(name, TASKS, where) for name in names)


def _env_kwargs(value: Any, env_id: str, where: str) -> dict[str, Any]:
    kwargs = parse_mapping(value, where)
    for key in kwargs:
        if env_id in ENVIRONMENTS and key not in QUADCOPTER_KEYWORDS:
            raise ConfigError(f"{where}: {unknown(f'keyword of {env_id}', key, QUADCOPTER_KEYWORDS)}")
    return kwargs
