"""Learning curves: the evaluations that a training wrote into its run folder, read without
matplotlib.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sb3_quad.base.errors import ConfigError, raised_as
from sb3_quad.base.files import read_arrays
from sb3_quad.base.types import FloatArray, StrPath

# The arrays of a file, (k, episodes), by their names here. Third-party environments may not report
# the last two.
EPISODES = {"reward": "results", "success": "successes", "survival": "survivals"}
OPTIONAL = ("successes", "survivals")


class Curve(NamedTuple):
    """The evaluations of one run, k of them."""

    timesteps: FloatArray  # (k,)
    seconds: FloatArray  # of training, evaluations along the way included, (k,)
    # By name, (k,): the mean reward, the shares of success and survival if the environment reports
    # them, and losses of the update before each evaluation, NaN if there was none.
    measures: Mapping[str, FloatArray]

    def values(self, name: str) -> FloatArray:
        """Return a measure, (k,); NaN if the run does not have it."""
        return self.measures.get(name, np.full(len(self.timesteps), np.nan))


def read_curve(run: StrPath, task: str | None = None) -> Curve:
    """Read the curve of a run folder from its ``evaluations.npz``.

    :param task: one of the run's ``eval_tasks``; None for its environment's own.
    :raises ConfigError: a folder without evaluations, or a damaged file.
    """
    path = Path(run) / ("evaluations.npz" if task is None else f"evaluations_{task}.npz")
    if not path.is_file():
        raise ConfigError(
            f"{path}: no such file; a run has one for itself and one for each of its eval_tasks,"
            " unless it was trained with --eval-episodes 0"
        )
    arrays = read_arrays(path)
    measures = {}
    # A third-party file may contain anything.
    with raised_as(ConfigError, f"{path}: cannot be read"):
        for name, key in EPISODES.items():
            if key in arrays or key not in OPTIONAL:
                measures[name] = arrays[key].mean(axis=1)
        # There is a row of episodes, or one number, for each evaluation.
        columns = np.stack([arrays["timesteps"], arrays["seconds"], *measures.values()])
        timesteps, seconds, *_ = columns.astype(np.float64)
    for key, losses in arrays.items():
        if key.startswith("train/"):
            measures[key.removeprefix("train/")] = losses
    return Curve(timesteps, seconds, measures)
