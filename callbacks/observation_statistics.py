"""Mean and deviation of what is observed while training: the σ by which observations are scaled (thesis 3.3.1)."""

from pathlib import Path
from typing import Any

import numpy as np
import yaml
from gymnasium import spaces
from stable_baselines3.common.running_mean_std import RunningMeanStd

from sb3_quad.base.arrays import FloatArray
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import one_line, refuse_existing, write_text
from sb3_quad.base.yaml_files import SUFFIXES, parse_mapping_file
from sb3_quad.callbacks.every import EveryTimesteps
from sb3_quad.simulation.observation import FEATURE_NAMES, FEATURES, GROUPS, OBSERVATION_SIZE


class ObservationStatistics(EveryTimesteps):
    """Running mean μ and standard deviation σ of every observed feature, by the parallel algorithm.

    The mean and sum of squares of each control step's observations are combined with those of all before (T. F. Chan, G. H.
    Golub, R. J. LeVeque, *Updating formulae and a pairwise algorithm for computing sample variances*, Stanford 1979; the
    thesis's [ChanGolubLeVeque79]): μ and σ (Eq. 3.17) are those of all observations together, none of which is kept.

    On the quadcopter's environments the scaling of Eq. 3.16 is undone first: μ and σ are in m, m/s and rad/s, with noise, and
    the σ of the four groups are what Table A.2 rounds. Elsewhere they are of the observations as they come (before
    ``VecNormalize``, if there is one).

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

    :param path: a YAML file for the results, written whole or not at all; None for no file. A training that is continued
        (``reset_num_timesteps=False``) continues the file; any other refuses an existing one. Its ``observation_std`` is a
        list as ``env_kwargs`` takes it.
    :param every: timesteps after which they are logged (``observation/std_<group>``) and saved; also done at the end.
    :param verbose: 1: prints the table at the end.
    :raises ConfigError: a file that is no YAML, ``every`` below 1; when training begins, a file that exists, or observations
        that are not one array of numbers.
    """

    def __init__(self, path: str | Path | None = None, every: int = 100_000, verbose: int = 0) -> None:
        super().__init__(every, verbose)
        self._path = None if path is None else Path(path)
        if self._path is not None and self._path.suffix not in SUFFIXES:
            raise ConfigError(f"ObservationStatistics: {path}: must be a .yaml file")
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
        printed = {each.name: f"  {each.std:9.3f} {each.unit}" for each in FEATURES if self._quadcopter}
        lines += [f"{name:<10} {sigma:10.3f}{printed.get(name, '')}" for name, sigma in self.groups().items()]
        return "\n".join(lines)

    def _on_training_start(self) -> None:
        super()._on_training_start()
        env = self.training_env
        if not isinstance(env.observation_space, spaces.Box):
            raise ConfigError(f"ObservationStatistics: observation space {env.observation_space}: must be a Box")
        size = int(np.prod(env.observation_space.shape))
        self._quadcopter = size == OBSERVATION_SIZE and env.has_attr("observation_std") and env.has_attr("observation_mean")
        scaling = [env.get_attr(f"observation_{name}") for name in ("std", "mean")] if self._quadcopter else [1.0, 0.0]
        self._scale, self._offset = map(np.array, scaling)
        resumed = self.num_timesteps > 0
        if self._path is not None and not resumed:
            refuse_existing(self._path, overwrite=False)
        if not resumed or self._moments.mean.shape != (size,):
            self._moments = RunningMeanStd(epsilon=0.0, shape=(size,))
            if self._path is not None and self._path.is_file():
                _read(self._path, self._moments)

    def _on_step(self) -> bool:
        normalised = self.model.get_vec_normalize_env()
        observations: Any = self.locals["new_obs"] if normalised is None else normalised.get_original_obs()
        features = np.asarray(observations, dtype=np.float64).reshape(self.training_env.num_envs, -1)
        self._moments.update(features * self._scale + self._offset)
        return super()._on_step()

    def _on_event(self) -> bool:
        for name, sigma in self.groups().items():
            self.logger.record(f"observation/std_{name}", sigma)
        if self._path is not None:
            self.save(self._path)
        return True

    def _on_training_end(self) -> None:
        if self.count:
            self._on_event()
            if self.verbose:
                print(self.table())

    def save(self, path: str | Path) -> None:
        """Write count, μ, σ and the names of the features as YAML.

        :raises ConfigError: a folder that cannot be written, a full disk.
        """
        names = list(FEATURE_NAMES) if self._quadcopter else [str(number) for number in range(len(self.mean))]
        moments = {"features": names, "observation_mean": self.mean.tolist(), "observation_std": self.std.tolist()}
        content = {"count": self.count, "groups": self.groups(), **moments}
        write_text(path, yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=127))


def _read(path: Path, moments: RunningMeanStd) -> None:
    """Take over what :meth:`ObservationStatistics.save` wrote.

    :raises ConfigError: a file that is damaged, or of another number of features.
    """
    try:
        content = parse_mapping_file(path)
        mean, std = (np.array(content[f"observation_{name}"], dtype=np.float64) for name in ("mean", "std"))
        if not mean.shape == std.shape == moments.mean.shape:
            raise ValueError(f"it is of {mean.size} features, these observations have {moments.mean.size}")
        moments.mean, moments.var, moments.count = mean, np.square(std), float(content["count"])
    except (KeyError, TypeError, ValueError) as error:
        raise ConfigError(f"{path}: holds no observation statistics ({one_line(error)}); name another file") from None
