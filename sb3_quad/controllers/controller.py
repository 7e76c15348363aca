"""One way to ask a controller, whatever it is: an expert, an SB3 model, a function."""

from collections.abc import Callable
from typing import Any, cast

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv

from sb3_quad.base.arrays import BoolArray, Float32Array
from sb3_quad.base.errors import ConfigError, ControllerError, ExpertError, SB3QuadError
from sb3_quad.controllers.resolve import resolve_expert
from sb3_quad.simulation.state import QuadcopterState


class Controller:
    """Asks anything that flies for its actions, and checks its answers.

    The first of these that fits is used:

    1. ``source.actions(state)`` (such as ``GeometricExpert``), where the true state is to be had:
      it is free of noise.
    2. ``source.predict(observation)``: an SB3 model, or an ``Expert`` of this package without a
      true state.
    3. ``source(observation)``: a function from observations (n, ...) to actions (n, ...).

    2 and 3 get the observations that a policy sees. The state that ``predict`` returns beside the
    actions, as SB3's recurrent policies do, is given to it again as ``state`` when it is asked
    next, with ``episode_start`` (n,): the rows that have just begun an episode. All rows of a new
    Controller begin one.

    :param source: the controller, as above.
    :param action_space: a Box.
    :param observation_space: None: not checked.
    :param true_state: gives the present true state; None: there is none.
    :param kind: what messages call it.
    :param deterministic: whether ``predict`` is asked for the mean of its actions, or a sample.
    :raises ConfigError: a source that is none of the three, or whose spaces do not fit;
        ``ExpertError`` of an expert.
    """

    def __init__(
        self,
        source: Any,
        action_space: spaces.Space[Any],
        observation_space: spaces.Space[Any] | None = None,
        true_state: Callable[[], QuadcopterState] | None = None,
        kind: str = "controller",
        deterministic: bool = True,
    ) -> None:
        error: type[SB3QuadError] = ExpertError if kind == "expert" else ConfigError
        self.source, self.kind, self._deterministic = source, kind, deterministic
        self.name = getattr(source, "__name__", type(source).__name__)
        who = f"{kind} {self.name}"
        if isinstance(source, type):
            raise error(f"{who}: is a class; give an instance, such as {self.name}()")
        if not isinstance(action_space, spaces.Box):
            raise error(f"action space {action_space}: a {kind} gives Box actions only")
        if not any(hasattr(source, name) for name in ("actions", "predict", "__call__")):
            raise error(
                f"{kind} {source!r}: needs actions(state) or predict(observation), or must be a function of observations"
            )
        self._space, self._action_dim = action_space, int(np.prod(action_space.shape))
        self._low, self._high = (
            np.float32(bound.reshape(-1)) for bound in (action_space.low, action_space.high)
        )
        for what, ours in (
            ("observation_space", observation_space),
            ("action_space", action_space),
        ):
            theirs = getattr(source, what, None)
            if isinstance(theirs, spaces.Space) and ours is not None and theirs.shape != ours.shape:
                raise error(
                    f"{who}: its {what.replace('_', ' ')} has shape {theirs.shape}, the environment's {ours.shape}"
                )
        self.needs_state = hasattr(source, "actions") and true_state is not None
        if not (self.needs_state or hasattr(source, "predict") or callable(source)):
            raise error(f"{who}: needs the true state, and this environment has no true_state()")
        self._true_state, self._env, self._state = (
            true_state,
            cast(VecEnv | None, None),
            cast(Any, None),
        )
        self._given = source  # of which the source is made, where that is a name

    @staticmethod
    def for_env(expert: Any, env: VecEnv, present: "Controller | None" = None) -> "Controller":
        """An expert that labels the states of a vector environment; with ``VecNormalize`` it sees
        normalised observations.

        :param expert: as above, or what :func:`~sb3_quad.controllers.resolve.resolve_expert` takes,
            for the vehicle of row 0.
        :param present: given back, with its state, if it is of the same expert and environment.
        :raises ConfigError: an unknown name. :class:`ExpertError`: an expert that is none of the
            three, or whose spaces do not fit the environment.
        """
        if expert is None:
            raise ExpertError(
                "no expert: give expert=... when building or loading the model, or call set_expert(expert)"
            )
        if present is not None and present._given is expert and present._env is env:
            return present
        vehicle = env.get_attr("vehicle", [0])[0] if env.has_attr("vehicle") else "itm"
        controller = Controller(
            resolve_expert(expert, vehicle),
            env.action_space,
            env.observation_space,
            true_state_of(env),
            "expert",
        )
        controller._env, controller._given = env, expert
        return controller

    def actions(
        self,
        observation: npt.NDArray[Any],
        rows: BoolArray | None = None,
        episode_start: BoolArray | None = None,
    ) -> Float32Array:
        """The actions for the present state, float32 of shape (n, action_dim); ask before
        ``env.step``.

        :param observation: (n, ...): the observations of that state.
        :param rows: bool (n,): the rows that matter; the others get zeros. None: all.
        :param episode_start: bool (n,): the rows that have just begun an episode. None: none.
        :raises ExpertError: of an expert, what it raises itself, actions that are not finite, or
            not of this shape; ``ControllerError`` of others.
        """
        error = ExpertError if self.kind == "expert" else ControllerError
        try:
            raw = np.asarray(self._answer(observation, episode_start))
        except SB3QuadError:
            raise
        except (Exception, SystemExit) as failed:  # a controller of the user's may raise anything
            raise error(
                f"{self.kind} {self.name}: fails with {type(failed).__name__}: {failed}"
            ) from failed
        if raw.dtype.kind not in "fiub":
            raise error(
                f"{self.kind} {self.name}: gives actions of type {raw.dtype}, must be real numbers"
            )
        n = len(next(iter(observation.values())) if isinstance(observation, dict) else observation)
        if raw.shape not in ((n, *self._space.shape), (n, self._action_dim)):
            raise error(
                f"{self.kind} {self.name}: gives actions of shape {raw.shape}, must be {(n, *self._space.shape)}"
            )
        actions = raw.reshape(n, self._action_dim).astype(np.float32)
        if rows is not None:
            actions[~rows] = 0.0
        if not np.isfinite(actions).all():
            row = int(np.flatnonzero(~np.isfinite(actions).all(axis=1))[0])
            raise error(
                f"{self.kind} {self.name}: gives {actions[row].tolist()} in row {row}; every number must be finite"
            )
        return actions

    def labels(
        self, observation: npt.NDArray[Any], episode_start: BoolArray | None = None
    ) -> Float32Array:
        """As :meth:`actions`, clipped to the action space: what an agent is to learn."""
        actions = self.actions(observation, episode_start=episode_start)
        np.clip(actions, self._low, self._high, out=actions)
        return actions

    def _answer(self, observation: npt.NDArray[Any], episode_start: BoolArray | None) -> Any:
        if self.needs_state and self._true_state is not None:
            return self.source.actions(self._true_state())
        if not hasattr(self.source, "predict"):
            return self.source(observation)
        before: dict[str, Any] = {}
        if self._state is not None:
            before = {"state": self._state} | (
                {} if episode_start is None else {"episode_start": episode_start}
            )
        actions, self._state, *_ = self.source.predict(
            observation, deterministic=self._deterministic, **before
        )
        return actions


def true_state_of(env: VecEnv) -> Callable[[], QuadcopterState] | None:
    """What gives the true state of all rows of a vector environment; None if there is none."""
    base: Any = env.unwrapped
    if hasattr(base, "true_state"):
        return base.true_state  # type: ignore[no-any-return]
    if env.has_attr("true_state"):
        return lambda: QuadcopterState.concatenate(env.env_method("true_state"))
    return None
