"""The type of everything that can be an expert."""

from collections.abc import Callable
from typing import Any, Protocol

from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_quad.base.types import Float32Array
from sb3_quad.envs.simulation.state import QuadcopterState


class StateExpert(Protocol):
    """An expert that sees the true state, such as ``PIDExpert``."""

    def actions(self, state: QuadcopterState, /) -> Float32Array:
        """Return actions in [-1, 1], (n, 4), for the true state of n vehicles."""


ExpertLike = StateExpert | BaseAlgorithm | Callable[[Any], Any] | str
"""An expert on the true state, an SB3 model, or a function from observations to actions.

It may also be a name for :func:`~sb3_quad.agents.resolve.resolve_expert`, such as ``"pid"``.
"""
