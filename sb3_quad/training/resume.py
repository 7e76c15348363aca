"""Interrupted runs: what is written for them, and how they go on.

The snapshot that is written lies between two rollouts. Where the environments can be restored (the batched one can), the
resumed run is bit for bit the one that was not interrupted; elsewhere episodes start anew.
"""

from __future__ import annotations

from typing import Any

from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import one_line, read_arrays, write_arrays, write_bytes
from sb3_quad.callbacks.interruption import ENVIRONMENT, Snapshot, set_random_state
from sb3_quad.settings.algorithms import get_algorithm
from sb3_quad.training.runs import RunFolder


def write_snapshot(run: RunFolder, snapshot: Snapshot, model: OnPolicyAlgorithm) -> None:
    """Write the snapshot's model, random numbers and environments, and the dataset if there is one.

    :raises ConfigError: a folder that cannot be written, a full disk.
    """
    if hasattr(model, "save_dataset"):
        model.save_dataset(run.dataset)
    state: dict[str, Any] = {"timesteps": snapshot.timesteps, **snapshot.state}
    write_arrays(run.resume_state, **state)
    write_bytes(run.model, snapshot.model)


def load_snapshot(run: RunFolder, algo: str, env: VecEnv, device: str, **attributes: Any) -> OnPolicyAlgorithm:
    """The model of an interrupted run, ready for ``learn(…, reset_num_timesteps=False)``.

    :param attributes: given to ``load``: what the zip does not hold, such as ``expert``.
    :raises ConfigError: a file that is missing or damaged.
    """
    if not run.resume_state.is_file():
        raise ConfigError(f"run folder {run.path}: holds no interrupted run; to train its model further use -i {run.model}")
    state = read_arrays(run.resume_state)
    environment = {name.removeprefix(ENVIRONMENT): array for name, array in state.items() if name.startswith(ENVIRONMENT)}
    try:
        model = get_algorithm(algo).load(run.model, env=env, device=device, force_reset=not environment, **attributes)
    except ConfigError:
        raise
    except Exception as error:  # what a damaged archive raises depends on where the damage is
        raise ConfigError(f"{run.model}: not a complete SB3 zip ({one_line(error)})") from None
    if model.num_timesteps != int(state["timesteps"]):
        raise ConfigError(
            f"run folder {run.path}: {run.model.name} is after {model.num_timesteps:,} timesteps, "
            f"{run.resume_state.name} after {int(state['timesteps']):,}; they belong to different interruptions"
        )
    if hasattr(model, "load_dataset"):
        model.load_dataset(run.dataset)
    batch: Any = getattr(env.unwrapped, "batch", None)
    if environment and batch is None:
        raise ConfigError(f"{run.resume_state}: holds the state of batched environments; use the run's own settings")
    if environment:
        batch.restore(environment)
    set_random_state(state)
    return model
