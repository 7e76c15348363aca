"""The settings of one training job, and the job itself.

Settings come from rl-zoo's YAML: one file per algorithm, whose top keys are environment ids.
:class:`TrainingConfig` lists the keys of a job. Any other key is a keyword of the algorithm's
constructor. There, ``lin_1e-3`` falls linearly to 0 over the training; a learning rate falls to 1/n
of its value, which it reaches in the last of n updates.
"""

from collections.abc import Collection
from pathlib import Path
from typing import Annotated, Any, Literal

import gymnasium
from pydantic import (
    BeforeValidator,
    Field,
    PositiveInt,
    model_validator,
)
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_quad.agents.agent_settings import agent_settings, settings_of_model, unlike_trained
from sb3_quad.agents.pretrained import agent_path, pretrained_names
from sb3_quad.agents.resolve import DEFAULT_EXPERT, resolve_expert
from sb3_quad.agents.zips import load_model
from sb3_quad.algorithms.chain import chain_of
from sb3_quad.algorithms.labelling import refuse_other_action
from sb3_quad.base.errors import ConfigError, did_you_mean, named, refuse_unknown, unknown
from sb3_quad.base.literals import parse_mapping
from sb3_quad.base.process import print_once
from sb3_quad.base.types import StrDict, StrMapping, StrPath
from sb3_quad.base.validate import Frozen, check, validate
from sb3_quad.base.yaml_files import YamlFolder
from sb3_quad.envs.registration import ENVIRONMENTS
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.envs.simulation.tasks import TASK_NAMES
from sb3_quad.envs.vehicles.layout import Turn, find_turn
from sb3_quad.envs.vehicles.vehicle import VEHICLES, first_vehicle
from sb3_quad.training.algorithms import (
    as_list,
    constructor_parameters,
    convert,
    get_algorithm,
    qualified_classes,
    takes_expert,
)
from sb3_quad.training.options import JobOptions, Number

_FOLDERS = ("any_quadcopter", "nominal", "robust", "thesis")
SETTINGS = YamlFolder("settings file", "sb3_quad.zoo_configs", ".yml", folders=_FOLDERS)
"""The settings files that come with the package, as ``--conf-file`` takes them."""
VecEnvKind = Literal["batch", "dummy", "subproc"]
NORMALIZE = "stable_baselines3.common.vec_env.VecNormalize"

Whole = Annotated[Number, Field(ge=1, lt=2**63)]
Keywords = Annotated[
    StrDict, BeforeValidator(lambda value, info: parse_mapping(value, info.field_name))
]
Classes = Annotated[
    list[tuple[str, StrDict]],
    BeforeValidator(lambda value, info: qualified_classes(value, info.field_name)),
]
# Units of the layers of all networks, or of each by name; the last form is from older versions of
# SB3.
Layers = list[PositiveInt]
NetArch = Layers | dict[str, Layers] | list[dict[str, Layers]] | None


class TrainingConfig(Frozen):
    """The checked settings of one job. ``settings`` has them as given, in plain YAML values.

    Classes are given as ``package.module.Class``, one or a list; with keywords as
    ``{package.module.Class: {…}}``.
    """

    algo: str
    env_id: str
    n_timesteps: Whole
    """timesteps to train on, over all environments; -n on the command line"""
    n_envs: Whole = 1
    """number of parallel environments"""
    vec_env: VecEnvKind
    """batch by default for this package's environments, dummy for others"""
    env_kwargs: Keywords = {}
    """keywords of the environment's constructor"""
    eval_env_kwargs: Keywords = {}
    """override env_kwargs in the evaluation's environments"""
    eval_tasks: Annotated[list[str], BeforeValidator(as_list)] = []
    """more tasks to evaluate on; the job's own task decides which model is best"""
    best_by: Literal["reward", "success", "survival"] = "reward"
    """what decides which model is best; a rate comes before the reward"""
    policy: str = "MlpPolicy"
    policy_kwargs: Keywords = {}
    """mapping, or a string such as 'dict(net_arch=[64, 64])'"""
    expert: Any = None
    """pid, geometric, path/to/model.zip or package.module:factory, to learn from"""
    callback: Classes = []
    """callbacks of the training"""
    env_wrapper: Classes = []
    """wrappers around each environment, only for dummy and subproc"""
    vec_env_wrapper: Classes = []
    """wrappers around the vectorised environment"""
    normalize: bool | Keywords = False
    """true, or keywords of SB3's VecNormalize, which then is the outermost wrapper"""
    hyperparams: StrDict
    """keywords of the algorithm's constructor, converted"""
    settings: StrDict = Field(repr=False)

    @property
    def task(self) -> str | None:
        """The quadcopter task; None for an environment of another package."""
        return ENVIRONMENTS.get(self.env_id)

    @property
    def algorithm(self) -> type[BaseAlgorithm]:
        """The class of the algorithm."""
        return get_algorithm(self.algo)

    @property
    def flight_settings(self) -> FlightSettings:
        """The flight settings of an agent of this job, in an environment of this package."""
        return FlightSettings().with_changes(**{"task": self.task, **self.env_kwargs})

    def make_expert(self) -> Any:
        """Return the expert, or the default one, for the vehicle of the environments.

        :raises SB3QuadError: see :func:`~sb3_quad.agents.resolve.resolve_expert`.
        """
        return resolve_expert(
            DEFAULT_EXPERT if self.expert is None else self.expert,
            self.env_kwargs.get("vehicle", "itm"),
            layout=self.task and self.flight_settings.rotor_layout,
            action=self.env_kwargs.get("action", "thrusts"),
        )

    def keyword(self, name: str) -> Any:
        """Return the value that the algorithm's constructor gets for ``name``, or its default."""
        if name in self.hyperparams:
            return self.hyperparams[name]
        return constructor_parameters(self.algorithm)[name].default

    @property
    def vec_env_wrappers(self) -> list[tuple[str, StrDict]]:
        """The wrappers around the vectorised environment, including that of ``normalize``."""
        if not self.normalize:
            return self.vec_env_wrapper
        # As in rl_zoo3.
        keywords = {"gamma": self.keyword("gamma")}
        if self.normalize is not True:
            keywords |= self.normalize
        return [*self.vec_env_wrapper, (NORMALIZE, keywords)]

    @property
    def rollout_steps(self) -> int:
        """Control steps of each environment between two updates."""
        return int(self.keyword("n_steps"))

    @property
    def rollout(self) -> int:
        """Timesteps between two updates, over all environments."""
        return self.rollout_steps * self.n_envs

    def shorter_rollout(self) -> dict[str, int]:
        """Return the settings that shorten a rollout to a smaller budget.

        SB3 would fly the whole rollout. Empty if the budget is large enough.
        """
        n_steps = -(-self.n_timesteps // self.n_envs)
        if n_steps >= self.rollout_steps:
            return {}
        if "batch_size" not in constructor_parameters(self.algorithm):
            return {"n_steps": n_steps}
        rollout = n_steps * self.n_envs
        # PPOBC chooses its batch size unless it is given one.
        batch_size = min(self.keyword("batch_size") or rollout, rollout)
        return {"n_steps": n_steps, "batch_size": batch_size}

    @model_validator(mode="after")
    def _environments_fit(self) -> "TrainingConfig":
        if self.task:
            refuse_unknown(
                f"keyword of {self.env_id}",
                [*self.env_kwargs, *self.eval_env_kwargs],
                FlightSettings.model_fields,
            )
            # Evaluations use both, so each of the two must fit.
            self.flight_settings.with_changes(**self.eval_env_kwargs)
            refuse_unknown("eval_tasks", self.eval_tasks, TASK_NAMES)
        elif self.eval_tasks:
            raise ConfigError(f"{self.env_id} has no tasks; remove eval_tasks")
        elif self.vec_env == "batch":
            raise ConfigError(
                f"vec_env is batch, but {self.env_id} has no batched form; use dummy or subproc"
            )
        return self

    @model_validator(mode="after")
    def _algorithm_fits(self) -> "TrainingConfig":
        aliases = self.algorithm.policy_aliases
        refuse_unknown("policy", [self.policy], aliases)
        # The policy's constructor takes these, not the algorithm's.
        policy = aliases[self.policy]
        refuse_unknown(
            f"keyword of {policy.__name__}", self.policy_kwargs, constructor_parameters(policy)
        )
        check(NetArch, self.policy_kwargs.get("net_arch"), "policy_kwargs: net_arch")
        check(PositiveInt, self.rollout_steps, "n_steps")
        if self.expert and not takes_expert(self.algorithm):
            raise ConfigError(f"expert: {self.algo} does not learn from an expert; remove expert")
        return self


# Keys of a settings file that hold keywords of environments.
ENV_KEYS = {"env_kwargs", "eval_env_kwargs"}
# Keywords of environments that may be the path of a file, or contain one.
FILE_KEYS = {"vehicle", "rotor_layout", "vehicles", "reference", "wrench", "wind"}
# Keys of a settings file that are not the algorithm's.
JOB_KEYS = TrainingConfig.model_fields.keys() - {"algo", "env_id", "hyperparams", "settings"}


class TrainingJob(JobOptions):
    """One job of the trainer: settings and options."""

    config: TrainingConfig
    """the settings"""
    agent: Any = Field(default=None, exclude=True, repr=False)
    """the agent that initial_policy names, if it has been loaded"""

    def for_evaluation(self, **changes: Any) -> TrainingConfig:
        """Return the settings with the environments of evaluations.

        :param changes: changes to the keywords of the environments.
        """
        config = self.config
        return config.model_copy(
            update={"env_kwargs": {**config.env_kwargs, **config.eval_env_kwargs, **changes}}
        )

    @property
    def flight_settings(self) -> FlightSettings:
        """The flight settings of evaluations, in an environment of this package."""
        return self.for_evaluation().flight_settings

    def arguments(self) -> StrDict:
        """Return the content of args.yml: everything except the settings, and how evaluations fly.

        The settings are in config.yml.
        """
        return {
            "algo": self.config.algo,
            "env": self.config.env_id,
            "env_kwargs": self.for_evaluation().env_kwargs,
            **self.model_dump(exclude={"config"}),
        }


def describe(job: TrainingJob) -> str:
    """Return one line about the training to come, in whole rollouts as SB3 trains."""
    config = job.config
    # SB3 completes the last rollout.
    timesteps = -(-config.n_timesteps // config.rollout) * config.rollout
    line = f"{config.algo} on {config.env_id}: {timesteps:,} timesteps"
    if timesteps != config.n_timesteps:
        line += f" ({config.n_timesteps:,} were asked for)"
    line += f", {config.n_envs} environments ({config.vec_env}), seed {job.seed}"
    for word, source in (("expert", config.expert), ("from", job.initial_policy)):
        if source:
            line += f", {word} {source}"
    return line


def load_config(
    algo: str,
    env_id: str,
    conf_file: StrPath | None = None,
    overrides: StrDict | None = None,
    agent: BaseAlgorithm | None = None,
) -> TrainingConfig:
    """Read the settings of ``env_id`` from a YAML file and apply ``overrides`` to them.

    They are merged as by :func:`merged`. If ``n_timesteps`` is less than a rollout, ``n_steps`` is
    reduced to it and ``batch_size`` to at most that.

    :param conf_file: path of a file, or the name of one that comes with the package such as
        ``thesis/dagger.yml``; None for ``<algo>.yml`` of the package.
    :param agent: the agent to start from, whose observation and networks take precedence over those
        of the file, see :func:`as_agent`.
    :raises ConfigError: an unknown algorithm, environment or key, an unreadable file, a value that
        does not fit.
    """
    # A misspelt name would otherwise be reported as a missing file.
    get_algorithm(algo)
    check_environment(env_id)
    # A user's file with the name of the default is not meant.
    content, where = SETTINGS.read(conf_file or SETTINGS.packaged(f"{algo}.yml"))
    with named(where):
        kind = "environment in this file"
        refuse_unknown(kind, [env_id], content, "; give another with --conf-file")
    settings = content[env_id]
    if not isinstance(settings, dict):
        raise ConfigError(f"{where}: {env_id} must hold keys and values, such as 'n_envs: 8'")
    changes = overrides or {}
    config = build_config(algo, env_id, merged(settings, changes, where), where, changes)
    more: StrDict = {**config.shorter_rollout()}
    if agent is not None:
        more |= as_agent(agent, config, changes)
    if more:
        config = build_config(algo, env_id, {**config.settings, **more}, where, changes)
    return config


def merged(settings: StrMapping, changes: StrMapping, where: str) -> StrDict:
    """Return ``settings`` with ``changes`` applied; keywords of environments are merged key by key.

    :param where: what the messages call the source of the settings.
    """
    result = {**settings, **changes}
    for key in ENV_KEYS & changes.keys():
        result[key] = {
            **parse_mapping(settings.get(key), f"{where}: {key}"),
            **parse_mapping(changes[key], key),
        }
    return result


def build_config(
    algo: str,
    env_id: str,
    settings: StrDict,
    where: str = "settings",
    changes: Collection[str] = (),
) -> TrainingConfig:
    """Check the settings of one job, given as a plain mapping.

    :param where: what the messages call the source of the settings.
    :param changes: keys that come from the command line.
    :raises ConfigError: see :func:`load_config`.
    """
    algorithm = get_algorithm(algo)
    parameters = constructor_parameters(algorithm)
    check_environment(env_id)
    settings = with_absolute_paths(env_id, settings)
    # The default is written out, so that config.yml names the expert. Demonstrations from a file
    # need none.
    needs_expert = takes_expert(algorithm) and not settings.get("demonstrations")
    if needs_expert and settings.get("expert") is None:
        settings["expert"] = DEFAULT_EXPERT

    def source(key: str) -> str:
        return "command line" if key in changes else where

    fields: StrDict = {"vec_env": "batch" if env_id in ENVIRONMENTS else "dummy"}
    hyperparams = {}
    for key, value in settings.items():
        if key in parameters:
            hyperparams[key] = convert(value, parameters[key], f"{source(key)}: {key}")
        elif key not in JOB_KEYS:
            message = unknown(f"key of {algo}", key, [*JOB_KEYS, *parameters])
            raise ConfigError(f"{source(key)}: {message}")
        elif value is not None:
            fields[key] = value
    fields |= {"algo": algo, "env_id": env_id, "hyperparams": hyperparams, "settings": settings}
    return validate(TrainingConfig, fields, source)


def with_absolute_paths(env_id: str, settings: StrDict) -> StrDict:
    """Return the settings with absolute paths of the files that they name.

    A run may be flown and resumed later, from another folder. The meaning of keywords of other
    packages' environments is unknown.
    """
    settings = dict(settings)
    if env_id in ENVIRONMENTS:
        for key in ENV_KEYS & settings.keys():
            settings[key] = {
                name: _absolute(name, value) if name in FILE_KEYS else value
                for name, value in parse_mapping(settings[key], key).items()
            }
    if isinstance(settings.get("demonstrations"), str):
        settings["demonstrations"] = str(Path(settings["demonstrations"]).absolute())
    expert = str(settings.get("expert"))
    # A zip or a run folder, and not the name of an agent of the package.
    if expert not in pretrained_names() and agent_path(expert).endswith(".zip"):
        settings["expert"] = str(Path(expert).absolute())
    return settings


def _absolute(name: str, value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _absolute(key, entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_absolute(name, entry) for entry in value]
    # A file is never a name, even without a suffix.
    if isinstance(value, (str, Path)) and (name == "file" or VEHICLES.is_path(value)):
        return str(Path(value).absolute())
    return value


def check_environment(env_id: str) -> None:
    """Check that Gymnasium knows an environment.

    :raises ConfigError: it does not; the message names the nearest.
    """
    if env_id not in gymnasium.registry:
        raise ConfigError(
            f"unknown environment {env_id!r}: {did_you_mean(env_id, gymnasium.registry)}"
            f"(of this package: {', '.join(ENVIRONMENTS)}; others: --gym-packages)"
        )


def load_agent(source: str) -> BaseAlgorithm:
    """Load the agent to start from.

    :param source: a zip, a run folder or the name of an agent of the package.
    :raises ConfigError: there is none, or it cannot be read.
    """
    path = agent_path(source)
    agent = load_model(path)
    if settings_of_model(agent) is None and not chain_of(agent):
        # The settings of a run of rl_zoo3 lie next to its zip.
        settings, file = agent_settings(path)
        if file is not None:
            settings.write_into(agent)
    return agent


def as_agent(agent: BaseAlgorithm, config: TrainingConfig, changes: StrMapping) -> StrDict:
    """Return the settings that an agent brings to ``config``: its observation and its networks.

    ``changes``, which ``config`` has, take precedence. Evaluations fly with the agent's position
    integral, if it has one; training flies without it. An agent that does not say how it flies
    brings nothing.

    :raises ConfigError: settings that do not fit; rotors in other places.
    """
    own = settings_of_model(agent)
    if own is None or not config.task:
        return {}
    # A new vehicle may be what the user wants, so this is only a warning.
    vehicle = first_vehicle(config.flight_settings.vehicle)
    notice = unlike_trained("-i", own, vehicle)
    if notice:
        print_once(f"warning: {notice}; --env-kwargs vehicle:… gives another one")
    refuse_other_action("-i", agent, config.env_kwargs.get("action", own.action))
    observed = own.observed
    # The agent knows one order of the rotors.
    if find_turn(vehicle, own.layout) != Turn():
        observed["rotor_layout"] = own.layout.model_dump(mode="json")
    integral = observed.pop("position_integral")
    adopted: StrDict = {
        "env_kwargs": {**config.env_kwargs, **observed, **changes.get("env_kwargs", {})},
        "eval_env_kwargs": {"position_integral": integral, **config.eval_env_kwargs},
    }
    if "policy_kwargs" not in changes:
        policy: Any = agent.policy
        adopted["policy_kwargs"] = {
            **config.policy_kwargs,
            "net_arch": policy.net_arch,
            # As config.yml names it.
            "activation_fn": f"nn.{policy.activation_fn.__name__}",
        }
    return adopted
