"""Your own callback: mean and standard deviation of the observations of a training.

Table A.2 of the thesis comes from them.

    python examples/observation_statistics.py

The result is not an agent: the script measures PPO's first flights, when it has hardly begun to
learn.

In a settings file, with ``PYTHONPATH=examples`` on the command line::

    callback:
      - observation_statistics.ObservationStatistics: {path: sigma.yaml, every: 1000000}
"""

import argparse

import numpy as np
import yaml
from stable_baselines3 import PPO
from stable_baselines3.common.running_mean_std import RunningMeanStd

from sb3_quad.base.files import write_text
from sb3_quad.callbacks.every import EveryTimesteps
from sb3_quad.envs import QuadcopterVecEnv
from sb3_quad.envs.simulation.observation import FEATURES, GROUPS, OBSERVATION_SIZE


class ObservationStatistics(EveryTimesteps):
    """Running mean and standard deviation (Eq. 3.17) of the 18 features, with noise.

    They are in m, m/s and rad/s: the scaling (Eq. 3.16) is undone. The observations of each control
    step are combined with all earlier ones (T. F. Chan, G. H. Golub, R. J. LeVeque, *Updating
    formulae and a pairwise algorithm for computing sample variances*, Stanford 1979).

    :param path: YAML file to write; its ``observation_std`` is a list for ``env_kwargs``. None: no
        file.
    :param every: timesteps after which it logs (``observation/std_<group>``) and writes. It does so
        at the end, too.
    """

    def __init__(self, path: str | None = None, every: int = 100_000, verbose: int = 0) -> None:
        super().__init__(every, verbose)
        self._path = path
        self.moments = RunningMeanStd(epsilon=0.0, shape=(OBSERVATION_SIZE,))

    def groups(self) -> dict[str, float]:
        """The deviation of each group of Table A.2: the root mean square over its features."""
        return {
            name: float(np.sqrt(np.mean(self.moments.var[rows]))) for name, rows in GROUPS.items()
        }

    def table(self) -> str:
        """The deviation of each group next to that of Table A.2."""
        groups = self.groups()
        lines = [f"{'group':<10} {'sigma':>10}  Table A.2"]
        for feature in FEATURES:
            sigma = groups[feature.name]
            lines.append(f"{feature.name:<10} {sigma:10.3f}  {feature.std:9.3f} {feature.unit}")
        return "\n".join(lines)

    def _on_step(self) -> bool:
        # The environments scale observations; undo that.
        std = np.array(self.training_env.get_attr("observation_std"))
        mean = np.array(self.training_env.get_attr("observation_mean"))
        self.moments.update(self.locals["new_obs"] * std + mean)
        return super()._on_step()

    def _on_event(self) -> bool:
        for name, sigma in self.groups().items():
            self.logger.record(f"observation/std_{name}", sigma)
        if self._path is not None:
            settings = {
                "observation_mean": self.moments.mean.tolist(),
                "observation_std": np.sqrt(self.moments.var).tolist(),
            }
            write_text(self._path, yaml.safe_dump(settings))
        return True

    def _on_training_end(self) -> None:
        self._on_event()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--timesteps", type=int, default=100_000, help="over all environments (%(default)s)"
    )
    arguments = parser.parse_args()
    model = PPO(
        "MlpPolicy",
        QuadcopterVecEnv(40, "target_tracking", seed=0),
        n_steps=100,
        batch_size=4000,
        device="cpu",
    )
    statistics = ObservationStatistics("sigma.yaml")
    model.learn(arguments.timesteps, callback=statistics)
    print(statistics.table())
