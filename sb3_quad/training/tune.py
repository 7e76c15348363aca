"""The search for hyperparameters by Optuna: what a trial trains, and how it is judged.

A search space's YAML file maps names of settings, dotted for entries of ``policy_kwargs``, to lists
of values, or to arguments of Optuna's ``suggest_float``, such as ``{low: 1e-4, high: 1e-2, log:
true}``. A whole ``low`` makes it ``suggest_int``. Of ``lin_x`` in the settings, the x varies.
"""

import copy
import math
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import optuna
import yaml
from optuna.storages import JournalStorage, RDBStorage, RetryHeartbeatStaleTrialCallback
from optuna.storages.journal import JournalFileBackend

from sb3_quad.base.errors import ConfigError, raised_as, refuse_unknown
from sb3_quad.base.files import write_text
from sb3_quad.base.literals import parse_number, parse_value, put_key
from sb3_quad.base.types import StrDict, StrPath
from sb3_quad.base.yaml_files import YamlFolder
from sb3_quad.training.algorithms import constructor_parameters
from sb3_quad.training.config import TrainingConfig, TrainingJob, build_config
from sb3_quad.training.trainer import train

SPACES = YamlFolder("search space", "sb3_quad.zoo_configs.search_spaces", ".yml")
LINEAR = "lin_"
VARIED = ("n_envs", "expert", "policy_kwargs")  # settings that are not the algorithm's arguments
HEARTBEAT = 60  # s
# User attributes: of a study, what all its trials share; of a trial, all its settings
SHARED = "shared"
SETTINGS = "settings"
optuna.logging.set_verbosity(optuna.logging.WARNING)
# Heartbeats are experimental in Optuna.
warnings.filterwarnings("ignore", category=optuna.exceptions.ExperimentalWarning)
# SB3 warns of each batch size that does not divide the rollout, which a search often tries.
warnings.filterwarnings("ignore", message="You have specified a mini-batch size")


@dataclass
class Objective:
    """Trains a trial of a study, and returns the value of its last evaluation.

    All trials have the same seed, and the same episodes of evaluation.

    :param job: the job of every trial, except for the varied settings.
    :param space: the values of each varied setting.
    :param n_evaluations: evaluations of each trial, the last one at its end.
    """

    job: TrainingJob
    space: StrDict
    n_evaluations: int

    def __call__(self, trial: optuna.Trial) -> float:
        """Train. The value is NaN, which fails the trial, if a signal ended the training.

        :raises optuna.TrialPruned: the study's pruner ended the training.
        """
        base = self.job.config
        settings = self.settings(trial)
        config = build_config(base.algo, base.env_id, settings, f"trial {trial.number}")
        trial.set_user_attr(SETTINGS, config.settings)
        # A training ends with a whole rollout.
        total = math.ceil(config.n_timesteps / config.rollout) * config.rollout
        every = math.ceil(total / self.n_evaluations)
        values = []

        def should_continue(rate: float, reward: float) -> bool:
            value = reward
            if config.task is not None:
                value = score(rate, reward, self.job.eval_episodes)
            values.append(value)
            trial.report(value, len(values))
            trial.set_user_attr(f"{config.best_by}_rate", rate)
            trial.set_user_attr("mean_reward", reward)
            return len(values) >= self.n_evaluations or not trial.should_prune()

        result = train(
            self.job.model_copy(update={"config": config, "eval_freq": every, "snapshot_every": 0}),
            report=lambda line: None,
            on_start=lambda run: trial.set_user_attr("run", str(run.path)),
            should_continue=should_continue,
        )
        if result.exit_code != 0:
            return math.nan
        if result.model.num_timesteps < total:
            raise optuna.TrialPruned
        return values[-1]

    def settings(self, trial: optuna.Trial) -> StrDict:
        """Return all settings of a trial."""
        settings = _plain(self.job.config)
        for name, values in self.space.items():
            with raised_as(ConfigError, f"search space: {name}: give a list, or low, high and log"):
                value = _suggest(trial, name, values)
            if isinstance(value, float) and str(settings.get(name)).startswith(LINEAR):
                value = f"{LINEAR}{value:.4g}"
            put_key(settings, name, value, name)
        return settings


def make_objective(job: TrainingJob, source: StrPath | None, n_evaluations: int) -> Objective:
    """Return the objective of a search.

    :param source: YAML file of the search space; None: the package's own for the algorithm.
    :raises ConfigError: an unreadable file, an unknown setting, invalid bounds.
    """
    space, where = SPACES.read(source or job.config.algo)
    if not space:
        raise ConfigError(f"{where}: must hold settings, such as 'gamma: [0.98, 0.99]'")
    valid = [*constructor_parameters(job.config.algorithm), *VARIED]
    refuse_unknown(f"{where}: setting", [name.partition(".")[0] for name in space], valid)
    objective = Objective(job, space, n_evaluations)
    # A trial that is not trained, so that Optuna checks the space.
    objective.settings(optuna.create_study().ask())
    return objective


def _suggest(trial: optuna.Trial, name: str, values: Any) -> Any:
    """Return the value of a setting in a trial."""
    if isinstance(values, list):
        # Optuna stores plain values alone.
        return parse_value(trial.suggest_categorical(name, [str(value) for value in values]))
    if isinstance(values["low"], int):
        return trial.suggest_int(name, **values)
    return trial.suggest_float(name, **values)


def _plain(config: TrainingConfig) -> StrDict:
    """Return a copy of the settings in which ``policy_kwargs`` are a mapping."""
    settings = copy.deepcopy(config.settings)
    if isinstance(settings.get("policy_kwargs"), str):
        settings["policy_kwargs"] = parse_value(settings["policy_kwargs"])
    return settings


def score(success: float, reward: float, n_episodes: int) -> float:
    """Return success and reward as one number: more successful episodes outweigh any reward, which
    decides between equals.

    ``success + s(reward) / n_episodes`` with s(x) = (1 + x / (1 + |x|)) / 2, which rises from 0 to
    1.

    :param success: share of ``n_episodes`` episodes.
    :param reward: mean reward per episode.
    """
    return success + (1.0 + reward / (1.0 + abs(reward))) / (2 * n_episodes)


def open_study(
    name: str, storage: str, objective: Objective, sampler: Any, pruner: Any
) -> optuna.Study:
    """Return the study of this name, which may already be in the storage.

    The first trial of a new study has the settings unchanged, as far as these are in the space.

    :param storage: a database's URL (with ``://``), by whose heartbeats trials of killed processes
        are tried again; or else the path of a journal file, which has none.
    :raises ConfigError: a storage that cannot be used; a study that was begun with other settings.
    """
    job = objective.job
    shared = (objective.space, objective.n_evaluations, job.config.settings, job.arguments())
    with raised_as(ConfigError, f"storage {storage}: cannot be used"):
        backend: Any
        if "://" in storage:
            again = RetryHeartbeatStaleTrialCallback()
            backend = RDBStorage(
                storage, heartbeat_interval=HEARTBEAT, heartbeat_stale_trial_callback=again
            )
        else:
            backend = JournalStorage(JournalFileBackend(storage))
        study = optuna.create_study(
            study_name=name,
            storage=backend,
            sampler=sampler,
            pruner=pruner,
            direction="maximize",
            load_if_exists=True,
        )
        if not study.trials:
            study.set_user_attr(SHARED, str(shared))
            study.enqueue_trial(_start(objective))
        elif study.user_attrs.get(SHARED) != str(shared):
            raise ConfigError(
                f"study {name} in {storage}: was begun with other settings; "
                "give the same again, or another --study-name"
            )
    return study


def _start(objective: Objective) -> StrDict:
    """Return the parameters that stand for the given settings, as far as the space has these."""
    start: StrDict = {}
    for name, values in objective.space.items():
        value: Any = _plain(objective.job.config)
        for key in name.split("."):
            value = value.get(key) if isinstance(value, dict) else None
        number = parse_number(str(value).removeprefix(LINEAR))
        if isinstance(values, list):
            # Optuna refuses anything else.
            if value in values:
                start[name] = str(value)
        elif isinstance(number, (int, float)):
            start[name] = number
    return start


def write_results(study: optuna.Study, objective: Objective, folder: Path) -> None:
    """Write all trials as ``trials.csv``, and the best settings as ``best.yml`` once there are any.

    :raises ConfigError: a folder that cannot be written, a full disk.
    """
    write_text(folder / "trials.csv", study.trials_dataframe().to_csv(index=False))
    if study.get_trials(deepcopy=False, states=[optuna.trial.TrialState.COMPLETE]):
        best = study.best_trial
        content = {objective.job.config.env_id: best.user_attrs[SETTINGS]}
        origin = f"# trial {best.number} of study {study.study_name}, value {best.value:.6g}\n"
        write_text(folder / "best.yml", origin + yaml.safe_dump(content, sort_keys=False))
