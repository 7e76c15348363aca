"""Learning curves: the evaluations that a training noted in its run folder, read without
matplotlib.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sb3_quad.base.arrays import FloatArray
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import read_arrays

NAMES = {"timesteps", "seconds", "results"}  # of the arrays that every file has
SHARES = "successes", "survivals"  # where the environment reports them


class Curve(NamedTuple):
    """The evaluations of one run, k of them."""

    timesteps: FloatArray  # (k,)
    seconds: FloatArray  # of training, evaluations along the way included, (k,)
    success: (
        FloatArray | None
    )  # share of successful episodes, (k,); None: the environment reports none, as of survival
    reward: FloatArray  # mean per episode, (k,)
    survival: FloatArray | None = None  # share of episodes, (k,)
    losses: Mapping[
        str, FloatArray
    ] = {}  # by name, of the update before each evaluation, (k,); NaN where there was none

    def values(self, name: str) -> FloatArray:
        """What a panel shows: success, survival, reward or the loss of a name, (k,); NaN where
        there is none.
        """
        found: Any = self.losses.get(name) if name.endswith("loss") else getattr(self, name)
        return np.full(len(self.timesteps), np.nan) if found is None else found


def read_curve(run: str | Path, task: str | None = None) -> Curve:
    """The curve of a run folder, from its ``evaluations.npz``.

    :param task: one of the run's ``eval_tasks``; None for its environment's own.
    :raises ConfigError: a folder without evaluations, or a damaged file.
    """
    path = Path(run) / ("evaluations.npz" if task is None else f"evaluations_{task}.npz")
    if not path.is_file():
        reason = "a run that was trained with --eval-episodes 0 has no curve"
        raise ConfigError(
            f"{path}: no such file; "
            + (f"{task} is none of this run's eval_tasks" if task else reason)
        )
    arrays = read_arrays(path)
    if missing := NAMES - arrays.keys():
        raise ConfigError(f"{path}: cannot be read ({', '.join(sorted(missing))}: no such array)")
    known = {name: array for name, array in arrays.items() if name in NAMES or name in SHARES}
    count = known["timesteps"].size
    right = count > 0 and all(
        array.ndim == (1 if name in ("timesteps", "seconds") else 2)
        and len(array) == count
        and array.dtype.kind in "fiub"
        for name, array in known.items()
    )
    if not right:
        raise ConfigError(
            f"{path}: cannot be read ({', '.join(sorted(known))} do not fit together)"
        )
    timesteps, seconds = (
        np.asarray(arrays[name], dtype=np.float64) for name in ("timesteps", "seconds")
    )
    success, survival = (known[name].mean(axis=1) if name in known else None for name in SHARES)
    losses = {
        name.removeprefix("train/"): array
        for name, array in arrays.items()
        if name.startswith("train/")
    }
    return Curve(timesteps, seconds, success, arrays["results"].mean(axis=1), survival, losses)
