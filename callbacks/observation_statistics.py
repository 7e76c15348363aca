"""Mean and deviation of what is observed while training: the σ by which observations are scaled (thesis 3.3.1)."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import yaml
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.running_mean_std import RunningMeanStd

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import refuse_existing, write_bytes, write_text
from sb3_quad.simulation.observation import DEFAULT_STD, FEATURE_NAMES, OBSERVATION_SIZE

FloatArray = npt.NDArray[np.float64]
GROUPS = {"position": slice(0, 3), "rotation": slice(3, 12), "velocity": slice(12, 15), "body_rates": slice(15, 18)}
UNITS = {"position": "m", "rotation": "-", "velocity": "m/s", "body_rates": "rad/s"}


class ObservationStatistics(BaseCallback):
    """Running mean μ and standard deviation σ of every observed feature, by the parallel algorithm.

    Each control step is a set of observations, one of each environment; its mean and sum of squares are combined with those
    of all before it (T. F. Chan, G. H. Golub, R. J. LeVeque, *Updating formulae and a pairwise algorithm for computing sample
    variances*, Stanford 1979; the thesis's [ChanGolubLeVeque79]), so that μ and σ (Eq. 3.17) are those of all observations
    together, whatever their number. Nothing is kept of them.

    On the quadcopter's environments the scaling of Eq. 3.16 is undone first: μ and σ are in m, m/s and rad/s, with noise, and
    the σ of the four groups are what Table A.2 rounds. With any other environment they are of the observations as they come
    (before ``VecNormalize``, if there is one).

    >>> from sb3_quad import DAgger, PIDExpert
    >>> from sb3_quad.envs import QuadcopterVecEnv
    >>> env = QuadcopterVecEnv(8, task="state_recovery", max_episode_steps=100, seed=0)
    >>> model = DAgger("MlpPolicy", env, PIDExpert(), n_steps=100, batch_size=400, n_epochs=1, seed=0, device="cpu")
    >>> statistics = ObservationStatistics("sigma.yaml")
    >>> _ = model.learn(1600, callback=statistics)
    >>> statistics.count, statistics.std.shape
    (1600, (18,))
    >>> print(statistics.table())  # doctest: +ELLIPSIS, +NORMALIZE_WHITESPACE
    group           sigma  Table A.2
    position   ...  5.774 m
    rotation   ...  1.732 -
    velocity   ...  5.000 m/s
    body_rates ...  5.000 rad/s

    In a configuration file::

        callback:
          - sb3_quad.callbacks.ObservationStatistics: {path: sigma.yaml, every: 1000000}

    Its ``observation_std`` is a list as ``env_kwargs`` takes it.

    :param path: a ``.yaml`` or ``.npz`` file for what was found, written whole or not at all; None for none. A training that
        goes on (``reset_num_timesteps=False``) goes on with it; else one that is there already is refused.
    :param every: transitions between two logs (``observation/std_<group>``) and savings; there is one at the end, too.
    :param verbose: 1: prints the table at the end.
    :raises ConfigError: another kind of file, ``every`` below 1; when training begins, a file that exists, or observations
        that are not one array of numbers.
    """

    def __init__(self, path: str | Path | None = None, every: int = 100_000, verbose: int = 0) -> None:
        super().__init__(verbose)
        self._path = None if path is None else Path(path)
        if self._path is not None and self._path.suffix not in (".yaml", ".yml", ".npz"):
            raise ConfigError(f"ObservationStatistics: {path}: must be a .yaml or .npz file")
        if every < 1:
            raise ConfigError(f"ObservationStatistics: every is {every}, must be at least 1")
        self._every, self._next = every, every
        self._moments = RunningMeanStd(epsilon=0.0)
        self._quadcopter = False

    @property
    def count(self) -> int:
        """Number of observations so far."""
        return int(self._moments.count)

    @property
    def mean(self) -> FloatArray:
        """μ, (features,)."""
        return self._moments.mean

    @property
    def std(self) -> FloatArray:
        """σ of Eq. 3.17, (features,)."""
        return np.asarray(np.sqrt(self._moments.var))

    def groups(self) -> dict[str, float]:
        """σ of each group of Table A.2, the root mean square over its features; of all features, elsewhere."""
        groups = GROUPS if self._quadcopter else {"all": slice(None)}
        return {name: float(np.sqrt(np.mean(self._moments.var[rows]))) for name, rows in groups.items()}

    def table(self) -> str:
        """σ of each group, beside that of Table A.2 where there is one."""
        lines = [f"{'group':<10} {'sigma':>10}" + ("  Table A.2" if self._quadcopter else "")]
        for name, sigma in self.groups().items():
            beside = f"  {DEFAULT_STD[GROUPS[name]][0]:9.3f} {UNITS[name]}" if self._quadcopter else ""
            lines.append(f"{name:<10} {sigma:10.3f}{beside}")
        return "\n".join(lines)

    def _on_training_start(self) -> None:
        env = self.training_env
        if not isinstance(env.observation_space, spaces.Box):
            raise ConfigError(f"ObservationStatistics: observation space {env.observation_space}: must be a Box")
        size = int(np.prod(env.observation_space.shape))
        self._quadcopter = size == OBSERVATION_SIZE and env.has_attr("observation_std") and env.has_attr("observation_mean")
        going_on = self.num_timesteps > 0
        if self._path is not None and not going_on:
            refuse_existing(self._path, overwrite=False)
        if not going_on or self._moments.mean.shape != (size,):
            self._moments = RunningMeanStd(epsilon=0.0, shape=(size,))
            if self._path is not None and self._path.is_file():
                self._moments = _read(self._path, size)
        self._next = (self.num_timesteps // self._every + 1) * self._every

    def _on_rollout_start(self) -> None:
        if self._quadcopter:
            env = self.training_env
            self._scale, self._offset = np.array(env.get_attr("observation_std")), np.array(env.get_attr("observation_mean"))

    def _on_step(self) -> bool:
        normalised = self.model.get_vec_normalize_env()
        observations: Any = self.locals["new_obs"] if normalised is None else normalised.get_original_obs()
        features = np.asarray(observations, dtype=np.float64).reshape(self.training_env.num_envs, -1)
        if self._quadcopter:
            features = features * self._scale + self._offset
        self._moments.update(features)
        if self.num_timesteps >= self._next:
            self._next = (self.num_timesteps // self._every + 1) * self._every
            self._log()
        return True

    def _on_training_end(self) -> None:
        if self.count:
            self._log()
            if self.verbose:
                print(self.table())

    def _log(self) -> None:
        for name, sigma in self.groups().items():
            self.logger.record(f"observation/std_{name}", sigma)
        if self._path is not None:
            self.save(self._path)

    def save(self, path: str | Path) -> None:
        """Write count, μ, σ and the names of the features, as YAML or npz by the file's suffix.

        :raises ConfigError: a folder that cannot be written, a full disk.
        """
        names = list(FEATURE_NAMES) if self._quadcopter else [str(number) for number in range(len(self.mean))]
        if Path(path).suffix == ".npz":
            buffer = io.BytesIO()
            arrays: dict[str, Any] = {"observation_mean": self.mean, "observation_std": self.std, "features": np.array(names)}
            np.savez(buffer, count=np.array(self.count), **arrays)
            write_bytes(path, buffer.getvalue())
            return
        content = {
            "count": self.count,
            "groups": self.groups(),
            "features": names,
            "observation_mean": self.mean.tolist(),
            "observation_std": self.std.tolist(),
        }
        write_text(path, yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=127))


def _read(path: Path, size: int) -> RunningMeanStd:
    """What :meth:`ObservationStatistics.save` wrote.

    :raises ConfigError: a file that is damaged, or of another number of features.
    """
    moments = RunningMeanStd(epsilon=0.0, shape=(size,))
    try:
        content = np.load(path) if path.suffix == ".npz" else yaml.safe_load(path.read_text(encoding="utf-8"))
        moments.mean = np.array(content["observation_mean"], dtype=np.float64)
        moments.var = np.square(np.array(content["observation_std"], dtype=np.float64))
        moments.count = float(content["count"])
    except (OSError, KeyError, TypeError, ValueError, EOFError, yaml.YAMLError, zipfile.BadZipFile) as error:
        raise ConfigError(f"{path}: holds no observation statistics ({' '.join(str(error).split())}); move it away") from None
    if moments.mean.shape != (size,) or moments.var.shape != (size,):
        raise ConfigError(f"{path}: is of {moments.mean.size} features, these observations have {size}; name another file")
    return moments
