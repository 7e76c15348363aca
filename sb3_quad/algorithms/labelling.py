"""Labels for imitation: what an expert would do in the present states of an environment."""

import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, unwrap_vec_normalize
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_quad.algorithms.controller import Controller, limits_of
from sb3_quad.base.errors import ConfigError, ExpertError
from sb3_quad.base.plugins import FLIGHT_SETTINGS, plugin
from sb3_quad.base.types import AnyArray, BoolArray, Float32Array


class StateExpert(Protocol):
    """An expert that sees the true state, such as ``PIDExpert``."""

    def actions(self, state: Any, /) -> Float32Array:
        """Return actions in [-1, 1], (n, a), for the true state of n rows.

        It is what the environment's ``true_state()`` returns: in those of this package, a
        :class:`~sb3_quad.envs.simulation.state.QuadcopterState`.
        """


ExpertLike = StateExpert | BaseAlgorithm | Callable[[Any], Any] | str
"""An expert on the true state, an SB3 model, or a function from observations to actions.

It may also be a name for :func:`~sb3_quad.agents.resolve.resolve_expert`, such as ``"pid"``.
"""


class Labeller:
    """Labels the states of a vector environment with an expert's actions.

    With ``VecNormalize``, experts see the raw observations. An SB3 model normalises them as in its
    own training. An expert that acts within other limits than the environment's, such as those
    below a ``RescaleAction``, is labelled in the environment's.

    :param expert: the expert. A name is resolved for the vehicle of row 0.
    :raises ConfigError: an unknown name, or an environment whose actions go beyond [-1, 1].
    :raises ExpertError: no expert, one of the wrong kind, or one whose spaces do not fit the
        environment.
    """

    def __init__(self, expert: ExpertLike | None, env: VecEnv) -> None:
        if expert is None:
            raise ExpertError(
                "no expert: give expert=... when building or loading the model, "
                "or call set_expert(expert); with beta=0, DAgger can clone the flights that its "
                "dataset holds"
            )
        refuse_wide_actions(env.action_space)
        self.expert = expert
        self.env = env
        vehicles = env.get_attr("vehicle") if env.has_attr("vehicle") else ["itm"]
        source: Any = expert
        if isinstance(expert, (str, Path)):
            source = plugin("expert")(expert, vehicles[0])
        warn_of_vehicle(source, vehicles)
        true_state = true_state_of(env) if hasattr(source, "actions") else None

        # The source may act within other limits: a model within those that it has learnt with, an
        # expert on the true state within those of the quadcopter below any wrappers.
        own: Any = getattr(source, "action_space", None)
        converts_actions = False
        if true_state is not None and env.has_attr(FLIGHT_SETTINGS):
            own = spaces.Box(-1.0, 1.0, env.action_space.shape)
            converts_actions = env.has_attr("action")
        if not isinstance(own, spaces.Box) or own.shape != env.action_space.shape:
            own = env.action_space
        self._controller = Controller(source, own, env.observation_space, true_state, "expert")
        name = self._controller.name
        space: Any = env.action_space
        self._limits = limits_of(space)
        self._own_limits = limits_of(own)
        converts_actions |= not np.allclose(self._own_limits, self._limits)
        if converts_actions and not _is_straight(env, own):
            raise ExpertError(
                f"{name}: its actions are of {own}, the environment's of {env.action_space}; no"
                " wrapper such as RescaleAction converts one into the other"
            )
        # Only a model of this package says what it has learnt to observe.
        if env.has_attr(FLIGHT_SETTINGS) and hasattr(source, FLIGHT_SETTINGS):
            plugin("observation")(name, source, env.get_attr(FLIGHT_SETTINGS, [0])[0])
        self._raw: Any = None
        if true_state is None:
            self._raw = unwrap_vec_normalize(env)
            if self._raw and self._raw.observation_space != env.observation_space:
                raise ExpertError(
                    f"{name}: sees raw observations, and a wrapper around VecNormalize changes"
                    " them; make VecNormalize the outermost wrapper"
                )

    def labels(self, observation: Any, episode_start: BoolArray | None = None) -> Float32Array:
        """Return the expert's actions for the present states within the action space, (n, a).

        Call it before ``env.step``.

        :param observation: the environment's observations of these states, (n, ...).
        :param episode_start: bool (n,), the rows that have just begun an episode. None: none.
        :raises ExpertError: the expert fails, or its actions are not finite or have another shape.
        """
        if self._raw is not None:
            observation = self._raw.get_original_obs()
        actions = self._controller.actions(observation, episode_start=episode_start)
        low, high = self._limits
        least, most = self._own_limits
        if not np.array_equal(self._limits, self._own_limits):
            actions = low + (actions - least) * ((high - low) / (most - least))
        return actions.clip(low, high)


def labeller_for(expert: ExpertLike | None, env: VecEnv, present: Labeller | None) -> Labeller:
    """Return the present labeller if it is for this expert and environment, otherwise a new one.

    A recurrent expert thus keeps its state while it labels the same environment.
    """
    if present and present.expert is expert and present.env is env:
        return present
    return Labeller(expert, env)


class LabellingVecEnv(VecEnvWrapper):
    """Labels the present state of an environment before each step.

    :param label: called before the actions of a step are passed on.
    """

    def __init__(self, venv: VecEnv, label: Callable[[], None]) -> None:
        super().__init__(venv)
        self._label = label

    def reset(self) -> VecEnvObs:
        return self.venv.reset()

    def step_async(self, actions: AnyArray) -> None:
        self._label()
        self.venv.step_async(actions)

    def step_wait(self) -> VecEnvStepReturn:
        return self.venv.step_wait()


def refuse_wide_actions(space: spaces.Space[Any]) -> None:
    """:raises ConfigError: actions beyond [-1, 1].

    The losses and the steps of Adam, which are about as long for every weight, assume that scale.
    """
    if isinstance(space, spaces.Box) and (np.abs(limits_of(space)) > 1.0).any():
        raise ConfigError(
            f"action space {space}: cloning needs actions within [-1, 1]; wrap the environment in"
            " gymnasium.wrappers.RescaleAction(env, -1, 1)"
        )


def warn_of_vehicle(source: Any, vehicles: Sequence[Any]) -> None:
    """Warn if an expert is made for another vehicle than one that it flies.

    :param vehicles: the vehicles of all rows.
    """
    known: Any = getattr(source, "vehicle", None)
    if not hasattr(known, "flies_as") or getattr(source, "is_privileged", False):
        return
    # Many rows share a vehicle.
    for flown in {id(vehicle): vehicle for vehicle in vehicles}.values():
        if hasattr(flown, "flies_as") and not known.flies_as(flown):
            name = type(source).__name__
            warnings.warn(
                f"{name}: is made for the vehicle {known.name} and flies"
                f" {name_beside(known, flown)}; make it for this one: {name}(vehicle), or give a"
                " privileged expert, which knows the vehicle of each row",
                stacklevel=4,
            )
            return


def name_beside(known: Any, flown: Any) -> str:
    """Return the name of a vehicle that a controller flies and does not know."""
    if known.name == flown.name:
        return f"{flown.name} with other parameters"
    return str(flown.name)


def _is_straight(env: VecEnv, own: spaces.Box) -> bool:
    """Whether the outermost action wrapper scales the environment's actions to those of ``own``,
    component by component.
    """
    if not env.has_attr("action"):
        return False
    space: Any = env.action_space
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


def true_state_of(env: VecEnv) -> Callable[[], Any] | None:
    """Return a function that returns the true state of all rows; None if ``env`` has no state."""
    # The batched environment has the state of all rows; others have one per environment.
    base: Any = env.unwrapped
    if hasattr(base, "true_state"):
        return base.true_state  # type: ignore[no-any-return]
    if env.has_attr("true_state"):
        return lambda: _joined(env.env_method("true_state"))
    return None


def _joined(states: list[Any]) -> Any:
    return type(states[0]).concatenate(states)
