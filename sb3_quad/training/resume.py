"""Interrupted runs: what is written for them, and how they go on.

The snapshot that is written lies between two rollouts. Where the environments can be restored (the batched one can), the
resumed run is bit for bit the one that was not interrupted; elsewhere episodes start anew.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import write_bytes
from sb3_quad.callbacks.last_good import ENVIRONMENT, Snapshot, set_random_state
from sb3_quad.settings.algorithms import get_algorithm
from sb3_quad.training.environments import set_environment_state
from sb3_quad.training.runs import RunFolder

if TYPE_CHECKING:
    from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
    from stable_baselines3.common.vec_env import VecEnv


def write_snapshot(run: RunFolder, snapshot: Snapshot, model: OnPolicyAlgorithm, resumable: bool) -> None:
    """Write the snapshot's model and, if the run is to be resumable, random numbers, environments and dataset.

    :raises ConfigError: a folder that cannot be written, a full disk.
    """
    if resumable:
        save_dataset: Callable[..., None] | None = getattr(model, "save_dataset", None)
        if save_dataset is not None:
            save_dataset(run.dataset)
        buffer = io.BytesIO()
        np.savez(buffer, timesteps=np.array(snapshot.timesteps), **snapshot.state)  # type: ignore[arg-type]
        write_bytes(run.resume_state, buffer.getvalue())
    write_bytes(run.model, snapshot.model)


def forget_snapshot(run: RunFolder) -> None:
    """Remove what only an interrupted run needs."""
    run.resume_state.unlink(missing_ok=True)
    run.dataset.unlink(missing_ok=True)


def load_snapshot(run: RunFolder, algo: str, env: VecEnv, device: str, **attributes: Any) -> OnPolicyAlgorithm:
    """The model of an interrupted run, ready for ``learn(…, reset_num_timesteps=False)``.

    :param attributes: given to ``load``: what the zip does not hold, such as ``expert``.
    :raises ConfigError: a file that is missing or damaged.
    """
    if not run.resume_state.is_file():
        raise ConfigError(f"run folder {run.path}: holds no interrupted run; to train its model further use -i {run.model}")
    try:
        with np.load(run.resume_state, allow_pickle=False) as file:
            state = {name: file[name] for name in file.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise ConfigError(f"{run.resume_state}: cannot be read ({error})") from None
    environment = {name.removeprefix(ENVIRONMENT): array for name, array in state.items() if name.startswith(ENVIRONMENT)}
    try:
        model = get_algorithm(algo).load(run.model, env=env, device=device, force_reset=not environment, **attributes)
    except ConfigError:
        raise
    except Exception as error:  # what a damaged archive raises depends on where the damage is
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ConfigError(f"{run.model}: not a complete SB3 zip ({reason[:160]})") from None
    if model.num_timesteps != int(state["timesteps"]):
        raise ConfigError(
            f"run folder {run.path}: {run.model.name} is after {model.num_timesteps:,} transitions, "
            f"{run.resume_state.name} after {int(state['timesteps']):,}; they belong to different interruptions"
        )
    load_dataset: Callable[..., None] | None = getattr(model, "load_dataset", None)
    if load_dataset is not None:
        load_dataset(run.dataset)
    set_environment_state(env, environment)
    set_random_state(state)
    return model
