"""Expert labels: the expert's action for the state an environment is in now."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv

from sb3_quad.base.errors import ExpertError
from sb3_quad.simulation.state import QuadcopterState

FloatArray = npt.NDArray[np.float32]


class _Source(Protocol):
    """Where raw labels come from: observations (n, ...) to actions (n, ...)."""

    def __call__(self, observation: npt.NDArray[Any]) -> Any: ...


class ExpertLabeller:
    """Asks any kind of expert for labels and checks what it says.

    The first of these that fits is used:

    1. ``expert.actions(state)`` (such as ``PIDExpert``), where the environment offers ``true_state()``: the true state,
       free of observation noise.
    2. ``expert.predict(observation, deterministic=True)``: another SB3 model, or an ``Expert`` of this package in an
       environment without a true state.
    3. ``expert(observation)``: a function from observations (n, ...) to actions (n, ...).

    2 and 3 get the observations that the policy sees, as they come out of the outermost vector environment; where that
    is a ``VecNormalize``, normalised ones. Experts with a memory (recurrent policies) are not supported.

    :param expert: the expert, as above
    :param env: the vector environment whose states are labelled
    :raises ExpertError: an expert that is none of the three, or whose spaces do not fit the environment
    """

    def __init__(self, expert: Any, env: VecEnv) -> None:
        if expert is None:
            raise ExpertError("no expert: give expert=... when building or loading the model, or call set_expert(expert)")
        if isinstance(expert, type):
            raise ExpertError(f"expert {expert.__name__}: is a class; give an instance, such as {expert.__name__}()")
        if not isinstance(env.action_space, spaces.Box):
            raise ExpertError(f"action space {env.action_space}: experts label Box action spaces only")
        self.expert = expert
        self.name = getattr(expert, "__name__", type(expert).__name__)
        self._space = env.action_space
        self._action_dim = int(np.prod(self._space.shape))
        self._low = self._space.low.reshape(-1).astype(np.float32)
        self._high = self._space.high.reshape(-1).astype(np.float32)
        self._check_spaces(env)
        self._needs_state = hasattr(expert, "actions") and _offers_state(env)
        self._source = self._choose_source(env)

    @property
    def needs_state(self) -> bool:
        """Whether labels come from the environment's true state rather than from observations."""
        return self._needs_state

    def labels(self, observation: npt.NDArray[Any]) -> FloatArray:
        """The expert's actions for the environment's present state, so call it before ``env.step``.

        :param observation: shape (n, ...): the observations of that state
        :return: float32 of shape (n, action_dim), clipped to the action space
        :raises ExpertError: labels that are not finite, or not of this shape
        """
        raw = np.asarray(self._source(observation))
        n = len(observation)
        if raw.shape not in ((n, *self._space.shape), (n, self._action_dim)):
            raise ExpertError(
                f"expert {self.name}: gave labels of shape {raw.shape}, expected {(n, *self._space.shape)} (row, action)"
            )
        labels = raw.reshape(n, self._action_dim).astype(np.float32)
        if not np.isfinite(labels).all():
            row = int(np.flatnonzero(~np.isfinite(labels).all(axis=1))[0])
            raise ExpertError(f"expert {self.name}: its label of row {row} is not finite: {labels[row].tolist()}")
        np.clip(labels, self._low, self._high, out=labels)
        return labels

    def _check_spaces(self, env: VecEnv) -> None:
        for kind in ("observation_space", "action_space"):
            theirs, ours = getattr(self.expert, kind, None), getattr(env, kind)
            if isinstance(theirs, spaces.Space) and theirs.shape != ours.shape:
                raise ExpertError(
                    f"expert {self.name}: its {kind.replace('_', ' ')} has shape {theirs.shape}, "
                    f"the environment's {ours.shape}"
                )

    def _choose_source(self, env: VecEnv) -> _Source:
        expert = self.expert
        if self.needs_state:
            base = env.unwrapped
            if hasattr(base, "true_state"):
                return lambda observation: expert.actions(base.true_state())
            return lambda observation: expert.actions(QuadcopterState.concatenate(env.env_method("true_state")))
        if hasattr(expert, "predict"):
            return lambda observation: expert.predict(observation, deterministic=True)[0]
        if callable(expert):
            return lambda observation: expert(observation)
        if hasattr(expert, "actions"):
            raise ExpertError(f"expert {self.name}: needs the true state, and this environment has no true_state()")
        raise ExpertError(
            f"expert {expert!r}: has neither actions(state) nor predict(observation), and is no function of observations"
        )


def _offers_state(env: VecEnv) -> bool:
    return hasattr(env.unwrapped, "true_state") or env.has_attr("true_state")
