"""The settings of one training job, from rl-zoo's YAML: one file per algorithm, top keys environment ids.

====================  ============================================================================================
key                   meaning
====================  ============================================================================================
n_timesteps           transitions to train on, over all environments
n_envs                environments flown side by side (1)
vec_env               batch (default for this package's environments), dummy (default for others) or subproc
env_kwargs            keywords of the environment's constructor
policy                name of a policy, MlpPolicy by default
policy_kwargs         mapping, or a string such as "dict(net_arch=[64, 64], activation_fn=nn.Tanh)"
expert                pid, path/to/model.zip or package.module:factory, for algorithms that learn from one
callback              callbacks as package.module.Class, one or a list; with keywords as {package.module.Class: {…}}
env_wrapper           wrappers around each environment, likewise (dummy and subproc)
vec_env_wrapper       wrappers around the vectorised environment, likewise
anything else         a keyword of the algorithm's constructor; ``lin_1e-3`` falls linearly to 0 over the training
====================  ============================================================================================
"""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any

import gymnasium
import yaml

from sb3_quad.envs.registration import ENVIRONMENTS
from sb3_quad.errors import ConfigError, unknown
from sb3_quad.training.algorithms import constructor_parameters, get_algorithm, takes_expert
from sb3_quad.training.literals import parse_mapping, parse_number
from sb3_quad.training.values import convert, positive_whole, qualified_classes

VEC_ENVS = ("batch", "dummy", "subproc")
_JOB_KEYS = (
    *("n_timesteps", "n_envs", "vec_env", "env_kwargs", "policy", "policy_kwargs", "expert"),
    *("callback", "env_wrapper", "vec_env_wrapper", "normalize"),
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


def load_config(
    algo: str, env_id: str, conf_file: str | Path | None = None, overrides: dict[str, Any] | None = None
) -> TrainingConfig:
    """The settings of ``env_id`` in a YAML file, with ``overrides`` put over them.

    :param conf_file: path of a file, or the name of one that comes with the package such as ``thesis/dagger.yml``;
        None for ``<algo>.yml`` of the package.
    :raises ConfigError: an unknown algorithm, environment or key, an unreadable file, a value that does not fit.
    """
    get_algorithm(algo)
    check_environment(env_id)
    content, where = _read(conf_file if conf_file is not None else f"{algo}.yml")
    if not isinstance(content, dict):
        raise ConfigError(f"{where}: must hold environment ids with their settings")
    if env_id not in content:
        listed = [str(key) for key in content]
        raise ConfigError(f"{where}: {unknown('environment in this file', env_id, listed)}; give another with --conf-file")
    settings = content[env_id]
    if not isinstance(settings, dict):
        raise ConfigError(f"{where}: {env_id} must hold keys and values, such as 'n_envs: 8'")
    return build_config(algo, env_id, {**settings, **(overrides or {})}, where)


def build_config(algo: str, env_id: str, settings: dict[str, Any], where: str = "settings") -> TrainingConfig:
    """The checked settings of one job, from a plain mapping.

    :param where: what the messages call the source of the settings.
    :raises ConfigError: see :func:`load_config`.
    """
    algorithm = get_algorithm(algo)
    check_environment(env_id)
    parameters = constructor_parameters(algorithm)
    for key in settings:
        if key not in _JOB_KEYS and key not in parameters:
            raise ConfigError(f"{where}: {unknown(f'key of {algo}', key, [*_JOB_KEYS, *parameters])}")
    if settings.get("normalize"):
        raise ConfigError(f"{where}: normalize is not supported, its statistics are not part of a model's zip; use false")
    if "n_timesteps" not in settings:
        raise ConfigError(f"{where}: n_timesteps is missing; give it there or with -n")
    policy = str(settings.get("policy", "MlpPolicy"))
    if policy not in algorithm.policy_aliases:
        raise ConfigError(f"{where}: {unknown('policy', policy, algorithm.policy_aliases)}")
    expert = settings.get("expert")
    if expert is not None and not takes_expert(algorithm):
        raise ConfigError(f"{where}: {algo} learns from no expert; leave expert away")
    vec_env = str(settings.get("vec_env", "batch" if env_id in ENVIRONMENTS else "dummy"))
    if vec_env not in VEC_ENVS:
        raise ConfigError(f"{where}: {unknown('vec_env', vec_env, VEC_ENVS)}")
    if vec_env == "batch" and env_id not in ENVIRONMENTS:
        raise ConfigError(f"{where}: {env_id} has no batched form; use vec_env dummy or subproc")
    return TrainingConfig(
        algo=algo,
        env_id=env_id,
        n_timesteps=positive_whole(settings["n_timesteps"], f"{where}: n_timesteps"),
        n_envs=positive_whole(settings.get("n_envs", 1), f"{where}: n_envs"),
        vec_env=vec_env,
        env_kwargs=_env_kwargs(settings.get("env_kwargs"), env_id, f"{where}: env_kwargs"),
        policy=policy,
        policy_kwargs=parse_mapping(settings.get("policy_kwargs"), f"{where}: policy_kwargs"),
        expert="pid" if expert is None and takes_expert(algorithm) else expert,
        callback=qualified_classes(settings.get("callback"), f"{where}: callback"),
        env_wrapper=qualified_classes(settings.get("env_wrapper"), f"{where}: env_wrapper"),
        vec_env_wrapper=qualified_classes(settings.get("vec_env_wrapper"), f"{where}: vec_env_wrapper"),
        hyperparams={
            key: convert(value, parameters[key], f"{where}: {key}") for key, value in settings.items() if key in parameters
        },
        settings=dict(settings),
    )


def check_environment(env_id: str) -> None:
    """:raises ConfigError: an environment that Gymnasium does not know; the message names the nearest."""
    if env_id in gymnasium.registry:
        return
    nearest = unknown("environment", env_id, gymnasium.registry).split(" (valid:")[0]
    raise ConfigError(f"{nearest} (of this package: {', '.join(ENVIRONMENTS)}; others: --gym-packages)")


def config_names() -> list[str]:
    """The YAML files that come with the package, as ``--conf-file`` takes them."""
    root = resources.files("sb3_quad.zoo_configs")
    names = [entry.name for entry in root.iterdir() if entry.name.endswith(".yml")]
    thesis = root.joinpath("thesis")
    return sorted(names) + sorted(f"thesis/{entry.name}" for entry in thesis.iterdir() if entry.name.endswith(".yml"))


def read_yaml(text: str, where: str) -> Any:
    """:raises ConfigError: text that is not YAML, in one line."""
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ConfigError(f"{where}: not valid YAML ({' '.join(str(error).split())})") from None


def _read(conf_file: str | Path) -> tuple[Any, str]:
    """The content of a settings file on disk or in the package, and what to call it."""
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


def _env_kwargs(value: Any, env_id: str, where: str) -> dict[str, Any]:
    kwargs = {key: parse_number(entry) for key, entry in parse_mapping(value, where).items()}
    if env_id in ENVIRONMENTS:
        from sb3_quad.training.environments import quadcopter_keywords

        for key in kwargs:
            if key not in quadcopter_keywords():
                raise ConfigError(f"{where}: {unknown(f'keyword of {env_id}', key, quadcopter_keywords())}")
    return kwargs
