"""A common way to ask a controller for actions, be it an expert, an SB3 model or a function."""

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_quad.agents.agent_settings import name_beside, warn_of_observation
from sb3_quad.agents.expert_like import ExpertLike
from sb3_quad.agents.resolve import resolve_expert
from sb3_quad.agents.statistics import statistics_of
from sb3_quad.base.errors import ControllerError, ExpertError, SB3QuadError, raised_as
from sb3_quad.base.types import BoolArray, Float32Array
from sb3_quad.envs.simulation.settings import KEY
from sb3_quad.envs.simulation.state import QuadcopterState
from sb3_quad.envs.vehicles.vehicle import Vehicle

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
    :param action_space: the environment's action space, a Box.
    :param observation_space: the environment's observation space.
    :param true_state: returns the current true state; None: not available.
    :param kind: the word for the controller in messages. With ``"expert"``, errors are
        ``ExpertError``.
    :param deterministic: whether ``predict`` returns the mean of its actions rather than a sample.
    :param env: the environment that an expert labels. It may have an action wrapper that is linear,
        such as ``RescaleAction``; :meth:`labels` then go through its inverse.
    :raises ControllerError: the source is none of the above, or its spaces do not fit
        (``ExpertError`` for an expert).
    """

    # A VecNormalize whose raw observations the source sees instead of those it is given.
    _raw: Any = None
    # Whether it has warned about actions outside of the action space.
    _warned = False

    def __init__(
        self,
        source: Any,
        action_space: spaces.Space[Any],
        observation_space: spaces.Space[Any],
        true_state: Callable[[], QuadcopterState] | None = None,
        kind: str = "controller",
        deterministic: bool = True,
        env: VecEnv | None = None,
    ) -> None:
        self.source = source
        # The ``expert=`` argument and the environment that :meth:`for_env` compares.
        self.made_for: tuple[Any, Any] = (None, None)
        self._deterministic = deterministic
        self._true_state = true_state if hasattr(source, "actions") else None
        self._predict_state: Any = None
        self._statistics = statistics_of(source)
        self._error: type[SB3QuadError] = ExpertError if kind == "expert" else ControllerError
        name = getattr(source, "__name__", type(source).__name__)
        self._who = f"{kind} {name}"

        # Refuse a controller that cannot work right away, not in the first step of a training.
        if isinstance(source, type):
            raise self._error(f"{self._who}: is a class; give an instance, such as {name}()")
        if not isinstance(action_space, spaces.Box):
            raise self._error(f"action space {action_space}: a {kind} gives Box actions only")
        if self._true_state is None and not (hasattr(source, "predict") or callable(source)):
            raise self._error(
                f"{kind} {source!r}: must be a function of observations or have "
                "predict(observation), or actions(state) if the environment has true_state()"
            )
        # SB3's models and policies have spaces; other controllers need none.
        for space, ours in (
            ("observation_space", observation_space),
            ("action_space", action_space),
        ):
            theirs = getattr(source, space, None)
            if isinstance(theirs, spaces.Space) and theirs.shape != ours.shape:
                # An agent that has flight settings also says what it observes.
                way_out = ""
                if space == "observation_space" and hasattr(source, KEY):
                    way_out = "; give **env_kwargs(the agent)"
                raise self._error(
                    f"{self._who}: its {space.replace('_', ' ')} has shape {theirs.shape}, "
                    f"the environment's {ours.shape}{way_out}"
                )

        # Actions are checked and clipped as flat rows.
        self._action_shape = action_space.shape
        self._limits = limits_of(action_space)
        # The source may use other limits: a model those that it has learnt with, an expert on the
        # true state those of the quadcopter without wrappers.
        own = getattr(source, "action_space", None)
        converts_actions = False
        if self._true_state is not None and env is not None and env.has_attr(KEY):
            own = spaces.Box(-1.0, 1.0, action_space.shape)
            converts_actions = env.has_attr("action")
        self._own_limits: Float32Array | None = None
        if isinstance(own, spaces.Box):
            if not np.allclose(limits_of(own), self._limits):
                self._own_limits = limits_of(own)
                converts_actions = True
            if converts_actions and not _is_straight(env, action_space, own):
                way_out = "no wrapper such as RescaleAction converts one into the other"
                if hasattr(source, "action_space"):
                    way_out = (
                        "train it within these, or give an environment with the wrapper that it"
                        " was trained in"
                    )
                raise self._error(
                    f"{self._who}: its actions are of {own}, the environment's of {action_space};"
                    f" {way_out}"
                )

    @staticmethod
    def for_env(
        expert: ExpertLike | None, env: VecEnv, present: "Controller | None" = None
    ) -> "Controller":
        """Return the controller that labels the states of a vector environment.

        With ``VecNormalize`` experts see the raw observations. An SB3 model normalises them as in
        its own training.

        :param expert: the expert. A name is resolved for the vehicle of row 0.
        :param present: the controller so far. It is returned, with its state, if it was made for
            the same expert and environment.
        :raises ConfigError: an unknown name.
        :raises ExpertError: no expert, one of the wrong kind, or one whose spaces do not fit the
            environment.
        """
        if expert is None:
            raise ExpertError(
                "no expert: give expert=... when building or loading the model, "
                "or call set_expert(expert); with beta=0, DAgger can clone the flights that its "
                "dataset holds"
            )
        # A recurrent expert keeps its state while it labels the same environment.
        if present and present.made_for[0] is expert and present.made_for[1] is env:
            return present
        vehicles = env.get_attr("vehicle") if env.has_attr("vehicle") else ["itm"]
        source = resolve_expert(expert, vehicles[0])
        warn_of_vehicle(source, vehicles)
        controller = Controller(
            source,
            env.action_space,
            env.observation_space,
            true_state_of(env),
            kind="expert",
            env=env,
        )
        if env.has_attr(KEY):
            warn_of_observation(controller._who, source, env.get_attr(KEY, [0])[0])
        if controller._true_state is None:
            controller._raw = unwrap_vec_normalize(env)
            if controller._raw and controller._raw.observation_space != env.observation_space:
                raise ExpertError(
                    f"{controller._who}: sees raw observations, and a wrapper around VecNormalize"
                    " changes them; make VecNormalize the outermost wrapper"
                )
        controller.made_for = (expert, env)
        return controller

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
        with raised_as(self._error, f"{self._who}: fails"):
            raw = np.asarray(self._ask(observation, episode_start))

        # Floats, integers and booleans.
        if raw.dtype.kind not in "fiub":
            raise self._error(
                f"{self._who}: gives actions of type {raw.dtype}, must be real numbers"
            )
        # Dictionary observations have a batch axis in each entry.
        batch = observation
        if isinstance(observation, dict):
            batch = next(iter(observation.values()))
        shape = (len(batch), *self._action_shape)
        flat_shape = (len(batch), self._limits.shape[1])
        if raw.shape not in (shape, flat_shape):
            raise self._error(f"{self._who}: gives actions of shape {raw.shape}, must be {shape}")
        actions = raw.reshape(flat_shape).astype(np.float32)

        # Rows that do not matter may contain anything, such as labels of a finished flight.
        if rows is not None:
            actions[~rows] = 0.0
        finite = np.isfinite(actions).all(axis=1)
        if not finite.all():
            row = int(finite.argmin())
            raise self._error(
                f"{self._who}: gives {actions[row].tolist()} in row {row}; "
                "every number must be finite"
            )
        self._warn_of_units(actions)
        return actions

    def labels(self, observation: Any, episode_start: BoolArray | None = None) -> Float32Array:
        """Return the labels that an agent imitates.

        They are :meth:`actions`, converted by the environment's action wrapper, within the action
        space.
        """
        actions = self.actions(observation, episode_start=episode_start)
        low, high = self._limits
        if self._own_limits is not None:
            least, most = self._own_limits
            actions = low + (actions - least) * ((high - low) / (most - least))
        return actions.clip(low, high)

    def _warn_of_units(self, actions: Float32Array) -> None:
        """Warn once if actions are far outside of the source's limits."""
        if self._warned:
            return
        low, high = self._limits if self._own_limits is None else self._own_limits
        beyond = np.abs(actions - actions.clip(low, high))
        if (beyond > FAR * (0.5 * high - 0.5 * low)).any():
            self._warned = True
            warnings.warn(
                f"{self._who}: gives actions far outside of the action space, such as"
                f" {actions.flat[beyond.argmax()]:.4g}, which are clipped; are they newtons or PWM"
                f" rather than actions from {low.min():g} to {high.max():g}?",
                stacklevel=3,
            )

    def _ask(self, observation: Any, episode_start: BoolArray | None) -> Any:
        """Return the controller's own answer, unchecked."""
        if self._true_state is not None:
            return self.source.actions(self._true_state())
        if self._raw is not None:
            observation = self._raw.get_original_obs()
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


def warn_of_vehicle(source: Any, vehicles: Sequence[Any]) -> None:
    """Warn if an expert is made for another vehicle than one that it flies.

    :param vehicles: the vehicles of all rows.
    """
    known = getattr(source, "vehicle", None)
    if not isinstance(known, Vehicle) or getattr(source, "is_privileged", False):
        return
    # Many rows share a vehicle.
    for flown in {id(vehicle): vehicle for vehicle in vehicles}.values():
        if isinstance(flown, Vehicle) and not known.flies_as(flown):
            name = type(source).__name__
            warnings.warn(
                f"{name}: is made for the vehicle {known.name} and flies"
                f" {name_beside(known, flown)}; make it for this one: {name}(vehicle), or give a"
                " privileged expert, which knows the vehicle of each row",
                stacklevel=4,
            )
            return


def limits_of(space: spaces.Box) -> Float32Array:
    """Return the lower and the upper limits of actions, (2, action_dim)."""
    return np.stack([space.low.ravel(), space.high.ravel()]).astype(np.float32)


def _is_straight(env: VecEnv | None, space: spaces.Box, own: spaces.Box) -> bool:
    """Whether the outermost action wrapper scales the actions of ``space`` to those of ``own``,
    component by component.
    """
    if env is None or not env.has_attr("action"):
        return False
    # Inside the limits, with another share for each component, a wrapper that is not linear or
    # reorders components is noticed.
    inner = np.linspace(0.2, 0.8, space.low.size).reshape(space.shape)
    for share in (0.0, 1.0, inner, 0.7 * inner):
        action = space.low + share * (space.high - space.low)
        expected = own.low + share * (own.high - own.low)
        made = env.env_method("action", action.astype(space.dtype), indices=[0])[0]
        if not np.allclose(made, expected, atol=1e-5):
            return False
    return True


def true_state_of(env: VecEnv) -> Callable[[], QuadcopterState] | None:
    """Return a function that returns the true state of all rows; None if ``env`` has no state."""
    # The batched environment has the state of all rows; others have one per environment.
    base: Any = env.unwrapped
    if hasattr(base, "true_state"):
        return base.true_state  # type: ignore[no-any-return]
    if env.has_attr("true_state"):
        return lambda: QuadcopterState.concatenate(env.env_method("true_state"))
    return None
