"""n episodes flown at the same time, for :mod:`sb3_quad.evaluation.flights`."""

from collections.abc import Mapping, Sequence

from sb3_quad.base.types import Float32Array, FloatArray
from sb3_quad.envs.simulation.batch import QuadcopterBatch
from sb3_quad.envs.simulation.settings import ENDLESS, FlightSettings


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
