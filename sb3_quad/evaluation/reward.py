"""A reward of your own, which is measured next to the task's."""

from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from sb3_quad.base.errors import ControllerError, raised_as
from sb3_quad.base.types import BoolArray, Float32Array
from sb3_quad.envs.simulation.state import QuadcopterState
from sb3_quad.envs.vehicles.vehicle import Vehicle
from sb3_quad.evaluation.hooks import Hook

Reward: TypeAlias = Callable[[QuadcopterState, Float32Array], npt.ArrayLike]
"""A reward of your own: a function from the state after a control step and the actions (n, 4) that
led to it to rewards (n,).
"""


class OwnRewards(Hook):
    """The sum of a user's reward over each flight: ``own_reward``; NaN if there is none.

    :param reward: a class is instantiated afresh, since its instances may remember.
    """

    def __init__(self, reward: Reward | None) -> None:
        self._reward = reward() if isinstance(reward, type) else reward

    def on_start(self, state: QuadcopterState, vehicle: Vehicle) -> None:
        self._flying = np.ones(state.n, bool)
        self._total = np.full(state.n, np.nan if self._reward is None else 0.0)

    def after_step(
        self, step: int, state: QuadcopterState, actions: Float32Array, flying: BoolArray
    ) -> None:
        if self._reward is None:
            return
        # Instances of a class have no ``__name__``.
        own = getattr(self._reward, "__name__", type(self._reward).__name__)
        name = f"reward {own}"
        # The function may do anything.
        with raised_as(ControllerError, f"{name}: fails"):
            values = np.asarray(self._reward(state, actions), dtype=np.float64)
        # What it gives for lost flights does not matter.
        if values.shape != (state.n,) or not np.isfinite(values[self._flying]).all():
            raise ControllerError(
                f"{name}: gives an array {values.shape}, must be finite and ({state.n},)"
            )
        self._total += np.where(self._flying, values, 0.0)
        self._flying = flying

    def results(self) -> Mapping[str, Any]:
        return {"own_reward": self._total}
