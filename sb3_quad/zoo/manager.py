"""rl_zoo3's ``ExperimentManager`` with our settings files: experts, the batched environment, settings of evaluations.

What differs holds for our algorithms and for any algorithm on our environments; everything else is as it was.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import rl_zoo3.exp_manager
from rl_zoo3 import ALGOS
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecMonitor

from sb3_quad.base.errors import ConfigError, unknown
from sb3_quad.envs.registration import ENVIRONMENTS
from sb3_quad.envs.vec_env import QuadcopterVecEnv
from sb3_quad.experts.resolve import resolve_expert
from sb3_quad.settings.algorithms import constructor_parameters, takes_expert
from sb3_quad.settings.config import VEC_ENVS, config_names
from sb3_quad.settings.literals import parse_mapping, parse_number
from sb3_quad.settings.values import convert
from sb3_quad.training.handover import hand_over

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

SCHEDULES = ("learning_rate", "clip_range", "clip_range_vf", "delta_std")  # those that rl_zoo3 makes of lin_x
Settings = dict[str, Any]


class QuadExperimentManager(rl_zoo3.exp_manager.ExperimentManager):
    """Sets up trainings of ours in rl_zoo3.

    ==========================  ===================================================================================
    key or flag                 what becomes of it
    ==========================  ===================================================================================
    ``--conf-file``             also a file of this package by name; by default its ``<algo>.yml``
    ``expert``                  resolved as ``sb3-quad train`` does, for the vehicle of ``env_kwargs``
    ``vec_env``                 ``batch`` (default), ``dummy`` or ``subproc``; the flag ``--vec-env``, where given, over it
    ``--env-kwargs``            put over those of the file, key by key
    ``eval_env_kwargs``         put over ``env_kwargs`` in evaluations, ``--eval-env-kwargs`` over both
    ``eval_tasks``              left out: rl_zoo3 evaluates on one environment; a line says so
    ``learning_rate: lin_x``    SB3's own schedule, so that the zip loads where rl_zoo3 is not installed
    ``-i`` / --trained-agent    for our algorithms: policy and critic of any on-policy zip, with a new optimiser
    ==========================  ===================================================================================

    Its ``args.yml`` gives as ``env_kwargs`` what evaluations are flown with, which is what ``enjoy`` is to show.
    """

    config: str
    env_kwargs: Settings
    vec_env_class: Callable[..., VecEnv]

    def __init__(self, *arguments: Any, **keywords: Any) -> None:
        super().__init__(*arguments, **keywords)
        self._env_id: str = self.env_name.gym_id
        self._ours = self.algo in ("dagger", "ppo_bc") or self._env_id in ENVIRONMENTS
        self._batched = False
        self._evaluation: Settings = {}
        if self._ours:
            self.config = _find_config(self.config, self.algo)
        if self._env_id in ENVIRONMENTS:
            self.monitor_kwargs = {"info_keywords": ("is_success",)}  # for plot_train -y success

    def read_hyperparameters(self) -> tuple[Settings, Settings]:
        """The settings of the environment, to be processed and to be saved."""
        if not self._ours:
            return super().read_hyperparameters()  # type: ignore[no-any-return]
        given, self.env_kwargs = self.env_kwargs, {}
        settings, saved = super().read_hyperparameters()
        merged = {**parse_mapping(settings.get("env_kwargs"), f"{self.config}: env_kwargs"), **given}
        for each in (settings, saved):
            each["env_kwargs"] = merged
        return settings, saved

    def _preprocess_hyperparams(self, hyperparams: Settings) -> Any:
        if not self._ours:
            return super()._preprocess_hyperparams(hyperparams)
        self._choose_vec_env(hyperparams.pop("vec_env", None))
        evaluation = parse_mapping(hyperparams.pop("eval_env_kwargs", None), f"{self.config}: eval_env_kwargs")
        if hyperparams.pop("eval_tasks", None):
            print("eval_tasks: left out, rl_zoo3 evaluates on the environment's own task")
        algorithm = ALGOS[self.algo]
        expert = hyperparams.pop("expert", None)
        if takes_expert(algorithm):
            vehicle = hyperparams["env_kwargs"].get("vehicle", "itm")
            hyperparams["expert"] = resolve_expert(expert or "pid", vehicle)
        parameters = constructor_parameters(algorithm)
        for name in parameters.keys() & hyperparams.keys() - set(SCHEDULES):
            hyperparams[name] = convert(hyperparams[name], parameters[name], f"{self.config}: {name}")
        if isinstance(hyperparams.get("policy_kwargs"), dict):
            hyperparams["policy_kwargs"] = parse_mapping(hyperparams["policy_kwargs"], f"{self.config}: policy_kwargs")
        processed = super()._preprocess_hyperparams(hyperparams)
        self.eval_env_kwargs = {**self.env_kwargs, **evaluation, **(self._eval_env_kwargs_args or {})}
        if self._batched and processed[1] is not None:
            raise ConfigError("env_wrapper: the batched environment has no single environments to wrap; use vec_env dummy")
        return processed

    def _preprocess_schedules(self, hyperparams: Settings) -> Settings:
        if not self._ours:
            return super()._preprocess_schedules(hyperparams)  # type: ignore[no-any-return]
        for name in set(SCHEDULES) & hyperparams.keys():
            value = hyperparams[name]
            if isinstance(value, str) and value.startswith("lin_"):
                hyperparams[name] = LinearSchedule(float(value.removeprefix("lin_")), 0.0, 1.0)
            else:
                hyperparams[name] = parse_number(value)
        return hyperparams

    def _choose_vec_env(self, setting: str | None) -> None:
        flag = _flag("--vec-env")
        kind = flag or setting or ("batch" if self._env_id in ENVIRONMENTS else "dummy")
        if kind not in VEC_ENVS:
            raise ConfigError(f"{self.config}: {unknown('vec_env', kind, VEC_ENVS)}")
        if kind == "batch" and self._env_id not in ENVIRONMENTS:
            raise ConfigError(f"{self.config}: vec_env is batch, but {self._env_id} has no batched form; use dummy or subproc")
        self._batched = kind == "batch"
        if kind != "batch":
            self.vec_env_class = {"dummy": DummyVecEnv, "subproc": SubprocVecEnv}[kind]

    def create_envs(self, n_envs: int, eval_env: bool = False, no_log: bool = False) -> Any:
        """The environments of a training or an evaluation, with their wrappers."""
        if self._batched:
            kwargs = {"task": ENVIRONMENTS[self._env_id], **(self.eval_env_kwargs if eval_env else self.env_kwargs)}
            file = None if eval_env or no_log else Path(self.save_path) / "0"
            self.vec_env_class = partial(_batch, kwargs, file)
        return super().create_envs(n_envs, eval_env, no_log)

    def _load_pretrained_agent(self, hyperparams: Settings, env: VecEnv) -> BaseAlgorithm:
        if self.algo not in ("dagger", "ppo_bc"):
            return super()._load_pretrained_agent(hyperparams, env)  # type: ignore[no-any-return]
        given: Settings = {"tensorboard_log": self.tensorboard_log, "seed": self.seed, "verbose": self.verbose}
        model = ALGOS[self.algo](env=env, device=self.device, **given, **hyperparams)
        hand_over(self.trained_agent, model)
        return model  # type: ignore[no-any-return]

    def _save_config(self, saved_hyperparams: Settings) -> None:
        given = self.args.env_kwargs
        if self._ours:
            self.args.env_kwargs = self.eval_env_kwargs
        super()._save_config(saved_hyperparams)
        self.args.env_kwargs = given


def _find_config(given: str, algo: str) -> str:
    """The path of a settings file: one on disk, or one of this package.

    :param given: as in rl_zoo3: what ``--conf-file`` says, or the path of rl_zoo3's own file if it says nothing.
    """
    nothing_said = Path(given) == Path(rl_zoo3.exp_manager.__file__).parent / "hyperparams" / f"{algo}.yml"
    name = f"{algo}.yml" if nothing_said else given
    if name in config_names() and (nothing_said or not Path(name).is_file()):
        return str(resources.files("sb3_quad.zoo_configs").joinpath(name))
    return given


def _flag(name: str) -> str | None:
    """The value of a flag on the command line; argparse's defaults do not tell whether it was given."""
    arguments = sys.argv[1:]
    for i, argument in enumerate(arguments):
        flag, equals, value = argument.partition("=")
        if flag == name:
            return value if equals else next(iter(arguments[i + 1 :]), None)
    return None


def _batch(keywords: Settings, file: Path | None, makers: list[Callable[[], Any]]) -> VecEnv:
    """As many rows as SB3's ``make_vec_env`` would make environments.

    :param file: where episodes are written, ``.monitor.csv`` is added; None: nowhere.
    """
    return VecMonitor(QuadcopterVecEnv(len(makers), **keywords), None if file is None else str(file), ("is_success",))
