"""Resuming a run from its snapshot, with its other files as they were at that moment."""

import os
import shlex
from typing import Any

from stable_baselines3.common.vec_env import VecEnv

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import read_arrays, write_arrays, write_bytes
from sb3_quad.base.types import Arrays
from sb3_quad.callbacks.snapshot import misfit, restore
from sb3_quad.training.config import TrainingJob
from sb3_quad.training.runs import RunFolder


def load_snapshot(run: RunFolder, job: TrainingJob, env: VecEnv, **attributes: Any) -> Any:
    """Load the model of a run's snapshot, ready for ``learn(…, reset_num_timesteps=False)``.

    The run's files are rolled back to the snapshot.

    :param attributes: passed to ``load``: what is in neither the zip nor the job, such as
        ``expert``.
    :raises ConfigError: a file that is missing or damaged, or has other settings; then nothing has
        been rolled back.
    """
    if not run.resume_state.is_file():
        message = f"run folder {run.path}: holds no interrupted run"
        if run.result.is_file():
            message += f"; to train its model further use -i {shlex.quote(str(run.result))}"
        raise ConfigError(message)
    keywords = job.model_dump(include={"device", "tensorboard_log", "verbose"})
    model, state = restore(run.resume_state, job.config.algorithm, env, **keywords, **attributes)
    _roll_back(run, state)
    return model


def _roll_back(run: RunFolder, state: Arrays) -> None:
    """Roll logs and best model back to the snapshot, so that resuming does not duplicate rows."""
    kept = {}
    for path in run.path.glob("evaluations*.npz"):
        rows = read_arrays(path)
        try:
            is_earlier = rows["timesteps"] <= state["timesteps"]
            earlier = {name: array[is_earlier] for name, array in rows.items()}
        except (KeyError, IndexError, TypeError):
            raise misfit(path, "holds no evaluations") from None
        # A file that stays as it is needs no space on the disk.
        if not is_earlier.all():
            kept[path] = earlier
    # Change files only when all are known to be good.
    for path, rows in kept.items():
        if rows["timesteps"].size:
            write_arrays(path, **rows)
        else:
            path.unlink()
    if state["best_model"].size:
        write_bytes(run.best_model, state["best_model"].tobytes())
    else:
        run.best_model.unlink(missing_ok=True)
    if run.episodes.is_file():
        os.truncate(run.episodes, min(run.episodes.stat().st_size, int(state["episodes"])))
