"""The last good model in memory, so that neither an interruption nor a diverging loss costs it."""

from __future__ import annotations

import random
from dataclasses import dataclass

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from sb3_quad.base.arrays import Arrays
from sb3_quad.base.errors import TrainingError
from sb3_quad.base.files import model_bytes

ENVIRONMENT = "environment."  # before the names of the environments' arrays


@dataclass(frozen=True)
class Snapshot:
    """A training between two rollouts: everything it needs to continue as if nothing had happened, except a dataset."""

    timesteps: int
    model: bytes  # the zip
    state: Arrays  # random numbers, and the environments' arrays under ``ENVIRONMENT``


class LastGoodModel(BaseCallback):
    """Takes a :class:`Snapshot` whenever a rollout starts.

    >>> from stable_baselines3 import PPO
    >>> from sb3_quad.envs import QuadcopterVecEnv
    >>> model = PPO("MlpPolicy", QuadcopterVecEnv(8, seed=0), n_steps=100, batch_size=400, device="cpu")
    >>> last_good = LastGoodModel()
    >>> _ = model.learn(1600, callback=last_good)
    >>> import io
    >>> last_good.snapshot.timesteps, PPO.load(io.BytesIO(last_good.snapshot.model), device="cpu").num_timesteps
    (800, 800)

    :raises TrainingError: parameters that are no longer finite; the snapshot is then the one from before that update.
    """

    snapshot: Snapshot | None = None

    def _on_rollout_start(self) -> None:
        for name, parameter in self.model.policy.named_parameters():
            if not th.isfinite(parameter).all():
                raise TrainingError(f"after {self.num_timesteps:,} timesteps {name} is no longer finite; lower learning_rate")
        batch = getattr(self.training_env.unwrapped, "batch", None)  # there is none in dummy and subproc
        arrays = {} if batch is None else batch.snapshot()
        state = random_state() | {f"{ENVIRONMENT}{name}": array for name, array in arrays.items()}
        self.snapshot = Snapshot(self.model.num_timesteps, model_bytes(self.model), state)

    def _on_step(self) -> bool:
        return True


def random_state() -> Arrays:
    """The states of torch's, NumPy's and Python's global random number generators."""
    _, keys, position, has_normal, normal = np.random.get_state(legacy=True)  # noqa: NPY002 - SB3 samples from it
    version, words, gauss = random.getstate()
    return {
        "torch": th.get_rng_state().numpy().copy(),
        "numpy.keys": np.array(keys),
        "numpy.rest": np.array([position, has_normal, normal], dtype=np.float64),
        "python.words": np.array([version, *words], dtype=np.int64),
        "python.gauss": np.array([np.nan if gauss is None else gauss]),
    }


def set_random_state(state: Arrays) -> None:
    """Undo what has happened to the random numbers since ``random_state``."""
    th.set_rng_state(th.from_numpy(np.array(state["torch"], dtype=np.uint8)))
    position, has_normal, normal = (float(value) for value in state["numpy.rest"])
    legacy = ("MT19937", np.array(state["numpy.keys"], dtype=np.uint32), int(position), int(has_normal), normal)
    np.random.set_state(legacy)  # noqa: NPY002
    version, *words = (int(word) for word in state["python.words"])
    gauss = float(state["python.gauss"][0])
    random.setstate((version, tuple(words), None if np.isnan(gauss) else gauss))
