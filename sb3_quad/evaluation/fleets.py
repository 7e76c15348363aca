"""n episodes flown at the same time, in either environment, for
:mod:`sb3_quad.evaluation.flights`.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt

from sb3_quad.base.types import Float32Array, FloatArray
from sb3_quad.envs.simulation.batch import QuadcopterBatch, StepResult
from sb3_quad.envs.simulation.observation import OBSERVATION_SIZE
from sb3_quad.envs.simulation.settings import ENDLESS, FlightSettings
from sb3_quad.envs.simulation.state import TARGET

# The environment on PyBullet; its task comes with the settings.
ENV_ID = "QuadTargetTracking-v0"


class Fleet(QuadcopterBatch):
    """n vehicles in their first episodes; a lost row stays lost.

    :param seeds: seeds of the episodes, (n,).
    :param settings: how they fly; ``max_episode_steps`` is ignored here, since flights end by their
        plan.
    """

    def __init__(self, seeds: Sequence[int], settings: FlightSettings) -> None:
        super().__init__(
            len(seeds), settings.with_changes(max_episode_steps=ENDLESS), autoreset=False
        )
        self.seed(seeds)

    def begin(self, start: Mapping[str, FloatArray]) -> Float32Array:
        """Begin the episodes; return the observations, (n, observation.size).

        :param start: replaces what the episodes sample: any of position, velocity, body_rates,
            target (n, 3) and quaternion (n, 4).
        """
        self.reset()
        for name, values in start.items():
            self.fix(name, values.T)
        return self.observe()

    def close(self) -> None:
        """Release the environments, if there are any."""


class PyBulletFleet(Fleet):
    """A fleet whose vehicles are moved by one PyBullet environment per row, one after the other.

    The batch samples the same episodes as they do from the same seeds, and scores what they fly.
    """

    def __init__(self, seeds: Sequence[int], settings: FlightSettings) -> None:
        super().__init__(seeds, settings)
        self._seeds = seeds
        # Flights end by their plan; -1 switches Gymnasium's time limit off. The batch moves the
        # targets, so that no environment needs tables of references.
        keywords = {
            **dict(settings),
            "max_episode_steps": -1,
            "reference": None,
            "disable_env_checker": True,
        }
        self._envs: list[Any] = []
        for row, vehicle in enumerate(self.vehicle_list):
            scaling = self.scaling_of_rows[:, row]
            keywords["vehicle"] = vehicle
            keywords["observation_mean"] = scaling[:OBSERVATION_SIZE]
            keywords["observation_std"] = scaling[OBSERVATION_SIZE : 2 * OBSERVATION_SIZE]
            keywords["noise"] = {"relative": scaling[-2], "additive": scaling[-1]}
            # Made by its id, since PyBullet may be missing, which matters only here.
            self._envs.append(gymnasium.make(ENV_ID, **keywords).unwrapped)

    def begin(self, start: Mapping[str, FloatArray]) -> Float32Array:
        super().begin(start)
        for row, env in enumerate(self._envs):
            # The target is not part of an environment's state; it matters only to the score.
            state = {name: values[row] for name, values in start.items() if name != "target"}
            env.reset(seed=self._seeds[row], options={"state": state})
            self._read(row)
        return self.observe()

    def step(self, actions: npt.NDArray[Any]) -> StepResult:
        # The others have ended; their environments may not be stepped.
        for row in np.flatnonzero(self.outcome["truncated"]).tolist():
            env = self._envs[row]
            env.batch.wrench[:, 0] = self.wrench[:, row]
            env.step(actions[row])
            self._read(row)
        return self.score(actions)

    def _read(self, row: int) -> None:
        """Read the state of a row, except for its target, from its environment."""
        self.state[: TARGET.start, row] = self._envs[row].batch.state[: TARGET.start, 0]

    def close(self) -> None:
        for env in self._envs:
            env.close()


FLEETS: Mapping[str, type[Fleet]] = {"batch": Fleet, "pybullet": PyBulletFleet}
