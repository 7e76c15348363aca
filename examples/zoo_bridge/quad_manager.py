"""rl_zoo3's ``ExperimentManager`` for our settings files.

It adds experts, the batched environment and settings of evaluations, for our algorithms and for any
algorithm on our environments. For everything else it is rl_zoo3's own.
"""

import argparse
import warnings
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any, get_args

import rl_zoo3.exp_manager
from rl_zoo3 import ALGOS
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecMonitor

from sb3_quad.agents.resolve import DEFAULT_EXPERT, resolve_expert
from sb3_quad.agents.transfer import transfer_policy
from sb3_quad.base.errors import ConfigError, unknown
from sb3_quad.base.literals import parse_mapping
from sb3_quad.envs.registration import ENVIRONMENTS
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.envs.vec_env import QuadcopterVecEnv
from sb3_quad.training.algorithms import constructor_parameters, convert, takes_expert
from sb3_quad.training.config import SETTINGS, VecEnvKind

Settings = dict[str, Any]
VEC_ENVS = get_args(VecEnvKind)


class QuadExperimentManager(rl_zoo3.exp_manager.ExperimentManager):
    """Set up our trainings in rl_zoo3.

    =========================  =================================================================
    key or flag                effect
    =========================  =================================================================
    ``--conf-file``            may name a file of this package; by default its ``<algo>.yml``
    ``expert``                 resolved as in ``sb3-quad train``, for the vehicle of
                               ``env_kwargs``
    ``vec_env``                ``batch`` (default), ``dummy`` or ``subproc``; the flag
                               ``--vec-env`` comes first
    ``--env-kwargs``           come before those of the file, key by key
    ``eval_env_kwargs``        come before ``env_kwargs`` in evaluations, and
                               ``--eval-env-kwargs`` before both
    ``eval_tasks``             ignored, with a line that says so: rl_zoo3 evaluates on one
                               environment
    ``learning_rate: lin_x``   SB3's own schedule, so that the zip loads without rl_zoo3
    ``-i``, --trained-agent    for our algorithms: policy and critic of any on-policy zip, with
                               a new optimiser
    ``-optimize``, --trial-id  for our algorithms: refused; ``sb3-quad tune`` searches, and
                               writes settings for ``-conf``
    =========================  =================================================================

    In ``args.yml``, ``env_kwargs`` are those of the evaluations, which ``enjoy`` shows.
    """

    config: str
    env_kwargs: Settings
    vec_env_class: Callable[..., VecEnv]

    def __init__(self, *arguments: Any, **keywords: Any) -> None:
        super().__init__(*arguments, **keywords)
        self._env_id: str = self.env_name.gym_id
        self._own_algorithm = takes_expert(ALGOS[self.algo])
        self._ours = self._own_algorithm or self._env_id in ENVIRONMENTS
        self._batched = False
        if self._ours:
            self.config = _find_config(self.config, self.algo)
        if self._own_algorithm and (self.optimize_hyperparameters or self.trial_id):
            raise ConfigError(
                f"{self.algo}: search for its hyperparameters with sb3-quad tune --algo {self.algo}"
            )
        if self._env_id in ENVIRONMENTS:
            self.monitor_kwargs = {"info_keywords": ("is_success",)}  # for plot_train -y success

    def read_hyperparameters(self) -> Any:
        """Read the settings, once to be processed and once to be saved."""
        if not self._ours:
            return super().read_hyperparameters()
        # rl_zoo3 would replace the file's env_kwargs by the flags; merge them instead.
        given = self.env_kwargs
        self.env_kwargs = {}
        settings, saved = super().read_hyperparameters()
        from_file = parse_mapping(settings.get("env_kwargs"), f"{self.config}: env_kwargs")
        settings["env_kwargs"] = {**from_file, **given}
        saved["env_kwargs"] = {**from_file, **given}
        return settings, saved

    def _preprocess_hyperparams(self, hyperparams: Settings) -> Any:
        if not self._ours:
            return super()._preprocess_hyperparams(hyperparams)
        self._choose_vec_env(hyperparams.pop("vec_env", None))
        evaluation = parse_mapping(
            hyperparams.pop("eval_env_kwargs", None), f"{self.config}: eval_env_kwargs"
        )
        if hyperparams.pop("eval_tasks", None):
            print("eval_tasks: ignored, rl_zoo3 evaluates on the environment's own task")
        expert = hyperparams.pop("expert", None)
        if self._own_algorithm:
            vehicle = hyperparams["env_kwargs"].get("vehicle", "itm")
            hyperparams["expert"] = resolve_expert(expert or DEFAULT_EXPERT, vehicle)
        for name, parameter in constructor_parameters(ALGOS[self.algo]).items():
            if name in hyperparams:
                hyperparams[name] = convert(hyperparams[name], parameter, f"{self.config}: {name}")
        if isinstance(hyperparams.get("policy_kwargs"), dict):
            hyperparams["policy_kwargs"] = parse_mapping(
                hyperparams["policy_kwargs"], f"{self.config}: policy_kwargs"
            )
        processed = super()._preprocess_hyperparams(hyperparams)
        self.eval_env_kwargs = {
            **self.env_kwargs,
            **evaluation,
            **(self._eval_env_kwargs_args or {}),
        }
        if self._batched and processed[1] is not None:
            raise ConfigError(
                "env_wrapper: the batched environment has no single environments to wrap; "
                "use vec_env dummy"
            )
        return processed

    def _preprocess_schedules(self, hyperparams: Settings) -> Settings:
        # _preprocess_hyperparams has made our schedules already.
        if self._ours:
            return hyperparams
        return super()._preprocess_schedules(hyperparams)

    def _choose_vec_env(self, setting: str | None) -> None:
        parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
        parser.add_argument("--vec-env")
        # rl_zoo3's own default hides whether the flag was given, so read the command line again.
        flags, _ = parser.parse_known_args()
        default = "batch" if self._env_id in ENVIRONMENTS else "dummy"
        kind = flags.vec_env or setting or default
        if kind not in VEC_ENVS:
            raise ConfigError(f"{self.config}: {unknown('vec_env', kind, VEC_ENVS)}")
        if kind == "batch" and self._env_id not in ENVIRONMENTS:
            raise ConfigError(
                f"{self.config}: vec_env is batch, but {self._env_id} has no batched form; "
                "use dummy or subproc"
            )
        self._batched = kind == "batch"
        if kind != "batch":
            self.vec_env_class = {"dummy": DummyVecEnv, "subproc": SubprocVecEnv}[kind]

    def create_envs(self, n_envs: int, eval_env: bool = False, no_log: bool = False) -> Any:
        """Make the environments of a training or an evaluation, with their wrappers."""
        if self._batched:
            kwargs = self.eval_env_kwargs if eval_env else self.env_kwargs
            kwargs = {"task": ENVIRONMENTS[self._env_id], **kwargs}
            file = None
            if not eval_env and not no_log:
                file = str(Path(self.save_path) / "0")  # VecMonitor appends .monitor.csv

            def make(makers: list[Callable[[], Any]]) -> VecEnv:
                """Make a row for each environment that SB3's ``make_vec_env`` would make."""
                env = QuadcopterVecEnv(len(makers), staggered=not eval_env, **kwargs)
                with warnings.catch_warnings():
                    warnings.filterwarnings(
                        "ignore", "The environment is already wrapped with a `Monitor`"
                    )
                    return VecMonitor(env, file, ("is_success",))

            self.vec_env_class = make
        return super().create_envs(n_envs, eval_env, no_log)

    def _load_pretrained_agent(self, hyperparams: Settings, env: VecEnv) -> Any:
        if not self._own_algorithm:
            return super()._load_pretrained_agent(hyperparams, env)
        given = {
            name: getattr(self, name) for name in ("tensorboard_log", "seed", "verbose", "device")
        }
        model = ALGOS[self.algo](env=env, **given, **hyperparams)
        transfer_policy(self.trained_agent, model)
        return model

    def learn(self, model: Any) -> None:
        """Train; the zips record the flight settings of the evaluations."""
        if self._env_id in ENVIRONMENTS:
            flown = {"task": ENVIRONMENTS[self._env_id], **self.eval_env_kwargs}
            FlightSettings().with_changes(**flown).write_into(model)
        super().learn(model)

    def _save_config(self, saved_hyperparams: Settings) -> None:
        if self._ours:
            self.args.env_kwargs = self.eval_env_kwargs
        super()._save_config(saved_hyperparams)


def _find_config(given: str, algo: str) -> str:
    """Return the path of a settings file, on disk or of this package.

    :param given: value of ``--conf-file``, or the path of rl_zoo3's own file without that flag.
    """
    zoo_file = Path(rl_zoo3.exp_manager.__file__).parent / "hyperparams" / f"{algo}.yml"
    is_default = Path(given) == zoo_file
    name = f"{algo}.yml" if is_default else given
    if name in SETTINGS.names() and (is_default or not Path(name).is_file()):
        return str(resources.files("sb3_quad.zoo_configs").joinpath(name))
    return given
