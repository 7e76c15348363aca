"""The search for hyperparameters by Optuna: what a trial trains, and how it is judged.

A search space's YAML file maps names of settings, dotted for entries of ``policy_kwargs``, to lists
of values, or to arguments of Optuna's ``suggest_float``, such as ``{low: 1e-4, high: 1e-2, log:
true}``. A whole ``low`` makes it ``suggest_int``. Of ``lin_x`` in the settings, the x varies.
"""

import copy
import math
import warnings
from contextlib import suppress
from pathlib import Path
from typing import Any

import optuna
from optuna.storages import JournalStorage, RDBStorage, RetryHeartbeatStaleTrialCallback
from optuna.storages.journal import JournalFileBackend

from sb3_quad.base.errors import ConfigError, named, raised_as
from sb3_quad.base.files import write_text
from sb3_quad.base.literals import parse_value, put_key
from sb3_quad.base.types import StrDict, StrPath
from sb3_quad.base.yaml_files import YamlFolder, write_yaml
from sb3_quad.training.config import TrainingConfig, TrainingJob, build_config
from sb3_quad.training.trainer import train

SPACES = YamlFolder("search space", "sb3_quad.zoo_configs.search_spaces", ".yml")
LINEAR = "lin_"
HEARTBEAT = 60  # s
SETTINGS = "settings"  # the user attribute of a trial with all its settings
# Heartbeats are experimental in Optuna.
warnings.filterwarnings("ignore", category=optuna.exceptions.ExperimentalWarning)
# SB3 warns of each batch size that does not divide the rollout, which a search often tries.
warnings.filterwarnings("ignore", message="You have specified a mini-batch size")


def train_trial(trial: optuna.Trial, job: TrainingJob, space: StrDict, n_evaluations: int) -> float:
    """Train a trial, and return the value of its last evaluation.

    All trials have the same seed, and the same episodes of evaluation. The first one has the
    settings unchanged.

    :param job: the job of every trial, except for the varied settings.
    :param n_evaluations: evaluations of each trial, the last one at its end.
    :raises optuna.TrialPruned: the study's pruner ended the training.
    :raises KeyboardInterrupt: a signal did.
    """
    config = job.config
    if trial.number > 0:
        config = suggest(trial, space, config)
    trial.set_user_attr(SETTINGS, config.settings)
    every = math.ceil(config.n_timesteps / n_evaluations)
    values = []

    def should_continue(rate: float, reward: float) -> bool:
        values.append(score(rate, reward, job.eval_episodes))
        trial.report(values[-1], len(values))
        return not trial.should_prune()

    result = train(
        job.model_copy(update={"config": config, "eval_freq": every, "snapshot_every": 0}),
        report=lambda line: None,
        should_continue=should_continue,
    )
    if result.exit_code != 0:
        raise KeyboardInterrupt
    if result.model.num_timesteps < config.n_timesteps:
        raise optuna.TrialPruned
    return values[-1]


def score(success: float, reward: float, n_episodes: int) -> float:
    """Return success and reward as one number: more successful episodes outweigh any reward, which
    decides between equals.

    ``success + s(reward) / n_episodes`` with s(x) = (1 + x / (1 + |x|)) / 2, which rises from 0 to
    1.

    :param success: share of ``n_episodes`` episodes; 0 where the environment reports none.
    :param reward: mean reward per episode.
    """
    return success + (1.0 + reward / (1.0 + abs(reward))) / (2 * n_episodes)


def load_space(source: StrPath | None, config: TrainingConfig) -> StrDict:
    """Return the values of each setting that a search varies.

    :param source: YAML file of the search space; None: the package's own for the algorithm.
    :raises ConfigError: an unreadable file, an unknown setting, invalid bounds.
    """
    space, where = SPACES.read(source or config.algo)
    if not space:
        raise ConfigError(f"{where}: must hold settings, such as 'gamma: [0.98, 0.99]'")
    # A trial that is not trained, so that Optuna and the settings check the space.
    with named(where):
        suggest(optuna.create_study().ask(), space, config)
    return space


def suggest(trial: optuna.Trial, space: StrDict, config: TrainingConfig) -> TrainingConfig:
    """Return the settings of a trial."""
    settings = copy.deepcopy(config.settings)
    if isinstance(settings.get("policy_kwargs"), str):
        settings["policy_kwargs"] = parse_value(settings["policy_kwargs"])
    for name, values in space.items():
        with raised_as(ConfigError, f"{name}: give a list, or low, high and log"):
            if isinstance(values, list):
                # Optuna stores plain values alone.
                text = trial.suggest_categorical(name, [str(value) for value in values])
                value = parse_value(text)
            elif isinstance(values["low"], int):
                value = trial.suggest_int(name, **values)
            else:
                value = trial.suggest_float(name, **values)
        if str(settings.get(name)).startswith(LINEAR) and isinstance(value, float):
            value = f"{LINEAR}{value:.4g}"
        put_key(settings, name, value, name)
    return build_config(config.algo, config.env_id, settings)


def open_study(name: str, storage: str, **keywords: Any) -> optuna.Study:
    """Return the study of this name, which may already be in the storage.

    :param storage: a database's URL (with ``://``), by whose heartbeats trials of killed processes
        are tried again; or else the path of a journal file, which has none.
    :param keywords: sampler and pruner.
    :raises ConfigError: a storage that cannot be used.
    """
    with raised_as(ConfigError, f"storage {storage}: cannot be used"):
        backend: Any
        if "://" in storage:
            again = RetryHeartbeatStaleTrialCallback()
            backend = RDBStorage(
                storage, heartbeat_interval=HEARTBEAT, heartbeat_stale_trial_callback=again
            )
        else:
            backend = JournalStorage(JournalFileBackend(storage))
        return optuna.create_study(
            study_name=name,
            storage=backend,
            direction="maximize",
            load_if_exists=True,
            **keywords,
        )


def write_results(study: optuna.Study, env_id: str, folder: Path) -> None:
    """Write all trials as ``trials.csv``, and the best settings as ``best.yml`` once there are any.

    :raises ConfigError: a folder that cannot be written, a full disk.
    """
    write_text(folder / "trials.csv", study.trials_dataframe().to_csv(index=False))
    # Optuna raises one if no trial is complete.
    with suppress(ValueError):
        write_yaml(folder / "best.yml", {env_id: study.best_trial.user_attrs[SETTINGS]})
