"""A common way to ask a controller for actions, be it an expert, an SB3 model or a function."""

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_quad.algorithms.chain import chain_of, limits_of, refuse_wrapped, statistics_of
from sb3_quad.base.errors import ControllerError, ExpertError, SB3QuadError, raised_as
from sb3_quad.base.plugins import FLIGHT_SETTINGS
from sb3_quad.base.types import BoolArray, Float32Array

# Actions this far beyond the limits of the action space, in half ranges, must be in another unit.
FAR = 0.5


class Controller:
    """Asks a controller of any kind for its actions and checks the answers.

    The first of these that fits is used:

    1. ``source.actions(state)`` (such as ``GeometricExpert``), if the true state is available. The
       true state is free of noise.
    2. ``source.predict(observation)``: an SB3 model, or an ``Expert`` of this package without a
       true state.
    3. ``source(observation)``: a function from observations (n, ...) to actions (n, ...).

    2 and 3 get the observations that a policy sees. An SB3 model that was trained behind
    ``VecNormalize`` gets raw ones, normalised by its own statistics. ``predict`` may return a state
    together with the actions, as SB3's recurrent policies do. The next call passes it back as
    ``state``, with ``episode_start`` (n,), the rows that have just begun an episode. For a new
    Controller, all rows begin one.

    :param source: the controller, as above.
    :param action_space: the space of its actions, a Box.
    :param observation_space: the environment's observation space.
    :param true_state: returns the current true state; None: not available.
    :param kind: the word for the controller in messages. With ``"expert"``, errors are
        ``ExpertError``.
    :param deterministic: whether ``predict`` returns the mean of its actions rather than a sample.
    :param wrappers: the record of the wrappers that it flies behind, of
        ``sb3_quad.algorithms.chain.describe``. None: any will do.
    :raises ControllerError: the source is none of the above, or its spaces do not fit
        (``ExpertError`` for an expert).
    :raises ConfigError: a model that was trained behind other wrappers.
    """

    # Whether it has warned about actions outside of the action space.
    _warned = False

    def __init__(
        self,
        source: Any,
        action_space: spaces.Space[Any],
        observation_space: spaces.Space[Any],
        true_state: Callable[[], Any] | None = None,
        kind: str = "controller",
        deterministic: bool = True,
        wrappers: Sequence[str] | None = (),
    ) -> None:
        self.source = source
        self._deterministic = deterministic
        self._true_state = true_state if hasattr(source, "actions") else None
        self._predict_state: Any = None
        self._statistics = statistics_of(source)
        self._error: type[SB3QuadError] = ExpertError if kind == "expert" else ControllerError
        name = getattr(source, "__name__", type(source).__name__)
        self.name = f"{kind} {name}"

        # Refuse a controller that cannot work right away, not in the first step of a training.
        if isinstance(source, type):
            raise self._error(f"{self.name}: is a class; give an instance, such as {name}()")
        if not isinstance(action_space, spaces.Box):
            raise self._error(f"action space {action_space}: a {kind} gives Box actions only")
        if self._true_state is None and not (hasattr(source, "predict") or callable(source)):
            raise self._error(
                f"{kind} {source!r}: must be a function of observations or have "
                "predict(observation), or actions(state) if the environment has true_state()"
            )
        self._check_spaces(action_space, observation_space)
        if wrappers is not None and self._true_state is None:
            refuse_wrapped(self.name, chain_of(source), [*wrappers])
        # Actions are checked and clipped as flat rows.
        self._action_shape = action_space.shape
        self._limits = limits_of(action_space)

    def _check_spaces(self, action_space: spaces.Box, observation_space: spaces.Space[Any]) -> None:
        """Refuse an SB3 model or policy with other spaces; other controllers have none."""
        ours = {"observation_space": observation_space, "action_space": action_space}
        for name, space in ours.items():
            theirs = getattr(self.source, name, None)
            if isinstance(theirs, spaces.Space) and theirs.shape != space.shape:
                # An agent that has flight settings also says what it observes.
                way_out = ""
                if name == "observation_space" and hasattr(self.source, FLIGHT_SETTINGS):
                    way_out = "; give **env_kwargs(the agent)"
                raise self._error(
                    f"{self.name}: its {name.replace('_', ' ')} has shape {theirs.shape}, "
                    f"the environment's {space.shape}{way_out}"
                )
        own = getattr(self.source, "action_space", None)
        if self._true_state is not None or not isinstance(own, spaces.Box):
            return
        if not np.allclose(limits_of(own), limits_of(action_space)):
            raise self._error(
                f"{self.name}: its actions are of {own}, the environment's of {action_space}; train"
                " it within these, or give an environment with the wrapper that it was trained in"
            )

    def actions(
        self,
        observation: Any,
        rows: BoolArray | None = None,
        episode_start: BoolArray | None = None,
    ) -> Float32Array:
        """Return the actions for the current state, float32 of shape (n, action_dim).

        Call it before ``env.step``.

        :param observation: the observations of that state, (n, ...).
        :param rows: bool (n,), the rows that matter; the others get zeros. None: all.
        :param episode_start: bool (n,), the rows that have just begun an episode. None: none.
        :raises ControllerError: the controller fails, or its actions are not finite or have another
            shape (``ExpertError`` for an expert).
        """
        # A user's controller may raise anything.
        with raised_as(self._error, f"{self.name}: fails"):
            raw = np.asarray(self._ask(observation, episode_start))

        # Floats, integers and booleans.
        if raw.dtype.kind not in "fiub":
            raise self._error(
                f"{self.name}: gives actions of type {raw.dtype}, must be real numbers"
            )
        # Dictionary observations have a batch axis in each entry.
        batch = observation
        if isinstance(observation, dict):
            batch = next(iter(observation.values()))
        shape = (len(batch), *self._action_shape)
        flat_shape = (len(batch), self._limits.shape[1])
        if raw.shape not in (shape, flat_shape):
            raise self._error(f"{self.name}: gives actions of shape {raw.shape}, must be {shape}")
        actions = raw.reshape(flat_shape).astype(np.float32)

        # Rows that do not matter may contain anything, such as labels of a finished flight.
        if rows is not None:
            actions[~rows] = 0.0
        finite = np.isfinite(actions).all(axis=1)
        if not finite.all():
            row = int(finite.argmin())
            raise self._error(
                f"{self.name}: gives {actions[row].tolist()} in row {row}; "
                "every number must be finite"
            )
        self._warn_of_units(actions)
        return actions

    def _warn_of_units(self, actions: Float32Array) -> None:
        """Warn once if actions are far outside of the source's limits."""
        if self._warned:
            return
        low, high = self._limits
        beyond = np.abs(actions - actions.clip(low, high))
        if (beyond > FAR * (0.5 * high - 0.5 * low)).any():
            self._warned = True
            warnings.warn(
                f"{self.name}: gives actions far outside of the action space, such as"
                f" {actions.flat[beyond.argmax()]:.4g}, which are clipped; are they newtons or PWM"
                f" rather than actions from {low.min():g} to {high.max():g}?",
                stacklevel=3,
            )

    def _ask(self, observation: Any, episode_start: BoolArray | None) -> Any:
        """Return the controller's own answer, unchecked."""
        if self._true_state is not None:
            return self.source.actions(self._true_state())
        if self._statistics is not None:
            observation = self._statistics.normalize_obs(observation)
        if not hasattr(self.source, "predict"):
            return self.source(observation)
        # As long as there is no state, the policy starts by itself. Many policies do not take these
        # keywords.
        keywords = {}
        if self._predict_state is not None:
            keywords["state"] = self._predict_state
            if episode_start is not None:
                keywords["episode_start"] = episode_start
        actions, self._predict_state, *_ = self.source.predict(
            observation, deterministic=self._deterministic, **keywords
        )
        return actions
