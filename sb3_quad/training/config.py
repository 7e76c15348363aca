"""The settings of one training job, from rl-zoo's YAML: one file per algorithm, top keys
environment ids.

:class:`TrainingConfig` lists the keys of a job; any other key is a keyword of the algorithm's
constructor, where ``lin_1e-3`` falls linearly to 0 over the training; a learning rate to its n-th
part, in the last of n updates.
"""

from collections.abc import Collection
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

import gymnasium
from pydantic import (
    BeforeValidator,
    Field,
    NonNegativeFloat,
    PositiveInt,
    ValidationInfo,
    field_validator,
    model_validator,
)

from sb3_quad.algorithms.common import LIMITS
from sb3_quad.base.errors import ConfigError, did_you_mean, unknown
from sb3_quad.base.literals import parse_mapping, parse_number
from sb3_quad.base.validate import Frozen, validate
from sb3_quad.base.yaml_files import YamlFolder
from sb3_quad.controllers.resolve import DEFAULT_EXPERT
from sb3_quad.envs.registration import ENVIRONMENTS
from sb3_quad.simulation.settings import FlightSettings
from sb3_quad.simulation.tasks import TASK_NAMES
from sb3_quad.training.algorithms import (
    constructor_parameters,
    get_algorithm,
    is_off_policy,
    takes_expert,
)
from sb3_quad.training.values import BASES, as_list, check, convert, import_class, qualified_classes
from sb3_quad.vehicles.vehicle import VEHICLES

_FOLDERS = "any_quadcopter", "nominal", "robust", "thesis", "value_based"
SETTINGS = YamlFolder("settings file", "sb3_quad.zoo_configs", ".yml", folders=_FOLDERS)
"""The settings files that come with the package, as ``--conf-file`` takes them."""
VecEnvKind: TypeAlias = Literal["batch", "dummy", "subproc"]
MAX_SINGLE = 1000  # environments of dummy and subproc; PyBullet allows about as many in a process


def _one_of(valid: Collection[str], value: Any, info: ValidationInfo) -> str:
    if str(value) not in valid:
        raise ConfigError(unknown(str(info.field_name), value, valid))
    return str(value)


Whole: TypeAlias = Annotated[
    int,
    Field(lt=2**63),
    BeforeValidator(lambda value, info: check(PositiveInt, parse_number(value), info.field_name)),
]
Keywords: TypeAlias = Annotated[
    dict[str, Any], BeforeValidator(lambda value, info: parse_mapping(value, info.field_name))
]
Classes: TypeAlias = Annotated[
    list[tuple[str, dict[str, Any]]],
    BeforeValidator(lambda value, info: qualified_classes(value, info.field_name)),
]
Tasks: TypeAlias = Annotated[tuple[str, ...], BeforeValidator(as_list)]


class TrainingConfig(Frozen):
    """One job's settings, checked. ``settings`` holds them as given: plain values that YAML can
    hold.

    Classes are given as ``package.module.Class``, one or a list; with keywords as
    ``{package.module.Class: {…}}``.
    """

    algo: str
    env_id: str
    n_timesteps: Whole = Field(description="timesteps to train on, over all environments")
    n_envs: Whole = Field(default=1, description="environments flown side by side")
    vec_env: VecEnvKind = Field(
        description="batch by default for this package's environments, dummy for others"
    )
    env_kwargs: Keywords = Field(
        default={}, description="keywords of the environment's constructor"
    )
    eval_env_kwargs: Keywords = Field(
        default={}, description="put over env_kwargs in the evaluation's environments"
    )
    eval_tasks: Tasks = Field(
        default=(),
        description="further tasks to evaluate on; the own one decides which model is best",
    )
    best_by: Literal["success", "survival"] = Field(
        default="success", description="which share makes a model the best"
    )
    policy: str = "MlpPolicy"
    policy_kwargs: Keywords = Field(
        default={}, description="mapping, or a string such as 'dict(net_arch=[64, 64])'"
    )
    expert: Any = Field(
        default=None,
        description="pid, geometric, path/to/model.zip or package.module:factory, to learn from",
    )
    callback: Classes = Field(default=[], description="callbacks of the training")
    env_wrapper: Classes = Field(
        default=[], description="wrappers around each environment, of dummy and subproc"
    )
    vec_env_wrapper: Classes = Field(
        default=[], description="wrappers around the vectorised environment"
    )
    normalize: Literal[False] | None = Field(
        default=None, description="its statistics would not be part of a model's zip"
    )
    noise_type: Literal["normal", "ornstein-uhlenbeck"] | None = Field(
        default=None, description="of an off-policy algorithm"
    )
    noise_std: NonNegativeFloat = Field(
        default=0.1, description="deviation of that noise, of actions within -1 and 1"
    )
    hyperparams: dict[str, Any] = Field(
        description="keywords of the algorithm's constructor, converted"
    )
    settings: dict[str, Any] = Field(repr=False)

    @property
    def task(self) -> str | None:
        """The quadcopter task, None for an environment that is not this package's."""
        return ENVIRONMENTS.get(self.env_id)

    @property
    def flight_settings(self) -> FlightSettings:
        """How an agent of this job flies, of an environment of this package."""
        return FlightSettings().with_changes(**{"task": self.task, **self.env_kwargs})

    def keyword(self, name: str) -> Any:
        """What the algorithm's constructor is given as ``name``, or its default."""
        return self.hyperparams.get(
            name, constructor_parameters(get_algorithm(self.algo))[name].default
        )

    @property
    def is_off_policy(self) -> bool:
        """Whether it learns from a replay buffer."""
        return is_off_policy(get_algorithm(self.algo))

    @property
    def rollout_steps(self) -> int:
        """Control steps of each environment between two updates; 1 where ``train_freq`` counts
        episodes.
        """
        if not self.is_off_policy:
            return int(self.keyword("n_steps"))
        freq = self.keyword("train_freq")
        number, unit = freq if isinstance(freq, (tuple, list)) else (freq, "step")
        return int(number) if unit == "step" else 1

    def shorter_rollout(self) -> dict[str, int]:
        """The settings that fit a rollout to a budget of less than one, which SB3 would fly whole;
        none otherwise.
        """
        n_steps = -(-self.n_timesteps // self.n_envs)
        if n_steps >= self.rollout_steps:
            return {}
        if self.is_off_policy:
            return {"train_freq": n_steps}
        return {
            "n_steps": n_steps,
            "batch_size": min(self.keyword("batch_size"), n_steps * self.n_envs),
        }

    @field_validator("policy", mode="before")
    @classmethod
    def _known_policy(cls, value: Any, info: ValidationInfo) -> str:
        return _one_of(get_algorithm(info.data["algo"]).policy_aliases, value, info)

    @field_validator("policy_kwargs")
    @classmethod
    def _some_units(cls, value: dict[str, Any]) -> dict[str, Any]:
        parts = value.get("net_arch")
        lists = (
            parts.values()
            if isinstance(parts, dict)
            else [parts]
            if isinstance(parts, list)
            else []
        )
        if any(
            isinstance(units, int) and units < 1
            for part in lists
            if isinstance(part, list)
            for units in part
        ):
            raise ConfigError(f"net_arch {parts}: every layer has at least 1 unit")
        return value

    @field_validator("env_kwargs", "eval_env_kwargs")
    @classmethod
    def _known_keywords(cls, value: dict[str, Any], info: ValidationInfo) -> dict[str, Any]:
        env_id = info.data["env_id"]
        if env_id in ENVIRONMENTS:
            for key in value:
                if key not in FlightSettings.model_fields:
                    raise ConfigError(
                        unknown(f"keyword of {env_id}", key, FlightSettings.model_fields)
                    )
            FlightSettings().with_changes(
                **{"task": ENVIRONMENTS[env_id], **info.data.get("env_kwargs", {}), **value}
            )
        return value

    @field_validator(*BASES)
    @classmethod
    def _known_classes(
        cls, value: list[tuple[str, dict[str, Any]]], info: ValidationInfo
    ) -> list[tuple[str, dict[str, Any]]]:
        for path, _ in value:
            import_class(path, str(info.field_name))
        return value

    @field_validator("eval_tasks")
    @classmethod
    def _known_tasks(cls, value: tuple[str, ...], info: ValidationInfo) -> tuple[str, ...]:
        if value and info.data["env_id"] not in ENVIRONMENTS:
            raise ConfigError(f"{info.data['env_id']} has no tasks; leave it out")
        return tuple(_one_of(TASK_NAMES, name, info) for name in value)

    @model_validator(mode="after")
    def _consistent(self) -> "TrainingConfig":
        if self.vec_env != "batch" and self.n_envs > MAX_SINGLE:
            raise ConfigError(
                f"n_envs: {self.n_envs} of vec_env {self.vec_env}, at most {MAX_SINGLE} are made"
            )
        if self.vec_env == "batch" and self.task is None:
            raise ConfigError(
                f"vec_env is batch, but {self.env_id} has no batched form; use dummy or subproc"
            )
        if self.is_off_policy and self.n_envs > 1 and "episode" in str(self.keyword("train_freq")):
            raise ConfigError(
                f"train_freq {self.keyword('train_freq')}: counts episodes, which needs n_envs 1; give steps"
            )
        if self.noise_type is not None and not self.is_off_policy:
            raise ConfigError(f"noise_type: {self.algo} samples its actions; leave it out")
        if self.expert and not takes_expert(get_algorithm(self.algo)):
            raise ConfigError(f"expert: {self.algo} learns from no expert; leave it out")
        return self


JOB_KEYS = tuple(
    name
    for name in TrainingConfig.model_fields
    if name not in ("algo", "env_id", "hyperparams", "settings")
)


def load_config(
    algo: str,
    env_id: str,
    conf_file: str | Path | None = None,
    overrides: dict[str, Any] | None = None,
) -> TrainingConfig:
    """The settings of ``env_id`` in a YAML file, with ``overrides`` put over them (into them, for
    ``env_kwargs``).

    Where ``n_timesteps`` is less than a rollout, ``n_steps`` is shortened to it, and ``batch_size``
    to no more than that; of an off-policy algorithm ``train_freq``.

    :param conf_file: path of a file, or the name of one that comes with the package such as
        ``thesis/dagger.yml``; None for ``<algo>.yml`` of the package.
    :raises ConfigError: an unknown algorithm, environment or key, an unreadable file, a value that
        does not fit.
    """
    get_algorithm(algo)
    check_environment(env_id)
    content, where = SETTINGS.read(conf_file if conf_file is not None else f"{algo}.yml")
    if env_id not in content:
        listed = [str(key) for key in content]
        raise ConfigError(
            f"{where}: {unknown('environment in this file', env_id, listed)}; give another with --conf-file"
        )
    settings = content[env_id]
    if not isinstance(settings, dict):
        raise ConfigError(f"{where}: {env_id} must hold keys and values, such as 'n_envs: 8'")
    changes = dict(overrides or {})
    if "env_kwargs" in changes:
        base = parse_mapping(settings.get("env_kwargs"), f"{where}: env_kwargs")
        changes["env_kwargs"] = {**base, **parse_mapping(changes["env_kwargs"], "env_kwargs")}
    config = build_config(algo, env_id, {**settings, **changes}, where, changes)
    shorter = config.shorter_rollout()
    return (
        build_config(algo, env_id, {**config.settings, **shorter}, where, changes)
        if shorter
        else config
    )


def build_config(
    algo: str,
    env_id: str,
    settings: dict[str, Any],
    where: str = "settings",
    changes: Collection[str] = (),
) -> TrainingConfig:
    """The checked settings of one job, from a plain mapping.

    :param where: what the messages call the source of the settings.
    :param changes: keys that come from the command line instead.
    :raises ConfigError: see :func:`load_config`.
    """
    parameters = constructor_parameters(get_algorithm(algo))
    check_environment(env_id)
    settings = {
        key: with_vehicle_path(value) if key.endswith("env_kwargs") else value
        for key, value in settings.items()
    }
    if takes_expert(get_algorithm(algo)) and settings.get("expert") is None:
        settings["expert"] = DEFAULT_EXPERT  # so that config.yml names it

    def source(key: str) -> str:
        return "command line" if key in changes else where

    for key in settings:
        if key not in JOB_KEYS and key not in parameters:
            raise ConfigError(
                f"{source(key)}: {unknown(f'key of {algo}', key, [*JOB_KEYS, *parameters])}"
            )
    if settings.get("n_timesteps") is None:
        raise ConfigError(f"{where}: n_timesteps is missing; give it there or with -n")
    hyperparams = {
        key: convert(value, parameters[key], f"{source(key)}: {key}", *LIMITS.get(key, ()))
        for key, value in settings.items()
        if key in parameters
    }
    fields: dict[str, Any] = {"vec_env": "batch" if env_id in ENVIRONMENTS else "dummy"}
    fields |= {
        key: value for key, value in settings.items() if key in JOB_KEYS and value is not None
    }
    fields |= {"algo": algo, "env_id": env_id, "hyperparams": hyperparams, "settings": settings}
    return validate(TrainingConfig, fields, source)


def with_vehicle_path(value: Any) -> Any:
    """``env_kwargs`` whose vehicle file, if they name one, can be found from any folder: runs are
    flown and resumed later.
    """
    vehicle = value.get("vehicle") if isinstance(value, dict) else None
    if isinstance(vehicle, (list, tuple)):
        return {
            **value,
            "vehicle": [with_vehicle_path({"vehicle": each})["vehicle"] for each in vehicle],
        }
    if not isinstance(vehicle, (str, Path)) or not VEHICLES.is_path(vehicle):
        return value
    return {**value, "vehicle": str(Path(vehicle).absolute())}


def check_environment(env_id: str) -> None:
    """:raises ConfigError: an environment that Gymnasium does not know; the message names the
    nearest.
    """
    if env_id in gymnasium.registry:
        return
    hint = did_you_mean(env_id, gymnasium.registry)
    raise ConfigError(
        f"unknown environment {env_id!r}: {hint}(of this package: {', '.join(ENVIRONMENTS)}; others: --gym-packages)"
    )
