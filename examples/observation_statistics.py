"""A callback of one's own: mean and deviation of what is observed while training, from which Table
A.2 of the thesis comes.

    python examples/observation_statistics.py

No agent comes of it: PPO has hardly begun to learn, and its first flights are what is measured.

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
from sb3_quad.simulation.observation import FEATURES, GROUPS, OBSERVATION_SIZE


class ObservationStatistics(EveryTimesteps):
    """Running mean and standard deviation (Eq. 3.17) of the 18 features, in m, m/s and rad/s, with
    noise.

    Each control step's observations, whose scaling (Eq. 3.16) is undone, are combined with all
    before (T. F. Chan, G. H. Golub, R. J. LeVeque, *Updating formulae and a pairwise algorithm for
    computing sample variances*, Stanford 1979).

    :param path: of a YAML file, whose ``observation_std`` is a list as ``env_kwargs`` takes it;
        None for no file.
    :param every: timesteps between two logs (``observation/std_<group>``) and writes; both are also
        done at the end.
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
        """The deviation of each group beside that of Table A.2."""
        groups = self.groups()
        lines = [
            f"{each.name:<10} {groups[each.name]:10.3f}  {each.std:9.3f} {each.unit}"
            for each in FEATURES
        ]
        return "\n".join([f"{'group':<10} {'sigma':>10}  Table A.2", *lines])

    def _on_step(self) -> bool:
        std, mean = (
            np.array(self.training_env.get_attr(f"observation_{name}")) for name in ("std", "mean")
        )
        self.moments.update(self.locals["new_obs"] * std + mean)
        return super()._on_step()

    def _on_event(self) -> bool:
        for name, sigma in self.groups().items():
            self.logger.record(f"observation/std_{name}", sigma)
        if self._path is not None:
            found = {
                "observation_mean": self.moments.mean,
                "observation_std": np.sqrt(self.moments.var),
            }
            write_text(
                self._path, yaml.safe_dump({name: array.tolist() for name, array in found.items()})
            )
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
