"""Labels for imitation: what an expert would do in the present states of an environment."""

import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import (
    VecEnv,
    VecEnvWrapper,
    VecTransposeImage,
    unwrap_vec_normalize,
)
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_quad.algorithms.chain import Chain, chain_of, describe, limits_of
from sb3_quad.algorithms.controller import Controller
from sb3_quad.base.errors import ConfigError, ExpertError
from sb3_quad.base.plugins import FLIGHT_SETTINGS, plugin
from sb3_quad.base.types import AnyArray, BoolArray, Float32Array

# How to train where the check of an expert says no.
GO_ON = "check_expert=False"


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
    own training. A function sees pictures as they are before VecTransposeImage, which SB3 adds. An
    expert that acts within other limits than the environment's, such as those below a
    ``RescaleAction``, is labelled in the environment's.

    :param expert: the expert. A name is resolved for the vehicle of row 0.
    :param check: whether to refuse an expert whose labels the environment's wrappers would falsify.
    :raises ConfigError: an unknown name; an environment whose actions go beyond [-1, 1]; a model
        that was trained behind other wrappers; a wrapper around VecNormalize.
    :raises ExpertError: no expert, one of the wrong kind, or one whose spaces or labels do not fit
        the environment.
    """

    # The observations that :meth:`look` has labelled, and their labels.
    _seen: tuple[Any, Any] = (None, None)

    def __init__(self, expert: ExpertLike | None, env: VecEnv, check: bool = True) -> None:
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
        settings = env.get_attr(FLIGHT_SETTINGS, [0])[0] if env.has_attr(FLIGHT_SETTINGS) else None
        action = getattr(settings, "action", "thrusts")
        if isinstance(expert, (str, Path)):
            source = plugin("expert")(expert, vehicles[0], action=action)
        if settings is not None:
            refuse_other_action(f"expert {type(source).__name__}", source, action)
        warn_of_vehicle(source, vehicles)
        self._true_state = true_state_of(env) if hasattr(source, "actions") else None

        # The source may act within other limits: a model within those that it has learnt with, an
        # expert on the true state within those of the quadcopter below any wrappers.
        own: Any = getattr(source, "action_space", None)
        if self._true_state is not None and settings is not None:
            own = spaces.Box(-1.0, 1.0, env.action_space.shape)
        if not isinstance(own, spaces.Box) or own.shape != env.action_space.shape:
            own = env.action_space
        self._controller = Controller(
            source,
            own,
            env.observation_space,
            self._true_state,
            "expert",
            wrappers=describe(env).record if check else None,
        )
        name = self._controller.name
        space: Any = env.action_space
        self._limits = limits_of(space)
        self._own_limits = limits_of(own)
        if check:
            self._refuse_wrappers(describe(env))
        # Only a model of this package says what it has learnt to observe.
        if settings is not None and hasattr(source, FLIGHT_SETTINGS):
            plugin("observation")(name, source, settings)
        self._raw: Any = None if self._true_state else unwrap_vec_normalize(env)
        self._turned = isinstance(env, VecTransposeImage) and not self._is_model

    @property
    def _is_model(self) -> bool:
        """Whether it is a model of SB3, which sees what it has learnt to see."""
        return self._true_state is None and hasattr(self._controller.source, "observation_space")

    def _refuse_wrappers(self, chain: Chain) -> None:
        """:raises ExpertError: wrappers behind which the labels would be wrong."""
        chain.refuse_inner_statistics()
        name = self._controller.name
        source = self._controller.source
        changes = chain.changes
        if self._true_state is None and not self._is_model:
            # A function sees what the wrappers give, and returns what they take.
            if "NormalizeObservation" in chain.links:
                raise ExpertError(
                    f"{name}: NormalizeObservation would change what it sees while its statistics"
                    " continue; use VecNormalize, behind which it sees raw observations"
                )
        elif self._is_model and "o" in changes and chain_of(source) != chain.record:
            raise ExpertError(
                f"{name}: was not trained behind {', '.join(chain.record)}, or does not say so;"
                f" normalise by VecNormalize instead, or give {GO_ON} if it was"
            )
        elif "a" in changes:
            raise ExpertError(
                f"{name}: its actions may not reach the simulator through"
                f" {', '.join(chain.record)}; scale actions by RescaleAction, say in the class of a"
                f' wrapper what it changes (changes = "" if it is only the reward), or give {GO_ON}'
            )
        elif "s" not in changes and not np.allclose(self._own_limits, self._limits):
            raise ExpertError(
                f"{name}: its actions are of {source.action_space}, the environment's of"
                f" {self.env.action_space}; no wrapper such as RescaleAction converts one into the"
                " other"
            )

    def look(self, observation: Any, episode_start: BoolArray) -> None:
        """Label the present states, which a callback may change before the next step.

        :param observation: the environment's observations of these states, (n, ...).
        :param episode_start: bool (n,), the rows that have just begun an episode.
        """
        self._seen = (None, None)
        self._seen = (observation, self.labels(observation, episode_start))

    def labels(self, observation: Any, episode_start: BoolArray | None = None) -> Float32Array:
        """Return the expert's actions for the present states within the action space, (n, a); for
        observations that :meth:`look` has got, those of that time.

        Call it before ``env.step``.

        :param observation: the environment's observations of these states, (n, ...).
        :param episode_start: bool (n,), the rows that have just begun an episode. None: none.
        :raises ExpertError: the expert fails, or its actions are not finite or have another shape.
        """
        before, labels = self._seen
        if before is observation:
            return labels  # type: ignore[no-any-return]
        if self._raw is not None:
            observation = self._raw.get_original_obs()
        if self._turned:
            observation = np.moveaxis(observation, 1, -1)
        actions = self._controller.actions(observation, episode_start=episode_start)
        low, high = self._limits
        least, most = self._own_limits
        if not np.array_equal(self._limits, self._own_limits):
            actions = low + (actions - least) * ((high - low) / (most - least))
        return actions.clip(low, high)


def labeller_for(
    expert: ExpertLike | None, env: VecEnv, present: Labeller | None, check: bool = True
) -> Labeller:
    """Return the present labeller if it is for this expert and environment, otherwise a new one.

    A recurrent expert thus keeps its state while it labels the same environment.
    """
    if present and present.expert is expert and present.env is env:
        return present
    return Labeller(expert, env, check)


class LabellingVecEnv(VecEnvWrapper):
    """Labels the states of an environment.

    :param label: called before the actions of a step are passed on.
    :param look: called after a step, with the observations, which rows have ended, and the infos.
    """

    def __init__(
        self,
        venv: VecEnv,
        label: Callable[[], None],
        look: Callable[[Any, BoolArray, Any], None],
    ) -> None:
        super().__init__(venv)
        self._label = label
        self._look = look

    def reset(self) -> VecEnvObs:
        return self.venv.reset()

    def step_async(self, actions: AnyArray) -> None:
        self._label()
        self.venv.step_async(actions)

    def step_wait(self) -> VecEnvStepReturn:
        results = self.venv.step_wait()
        self._look(results[0], results[2], results[3])
        return results


def refuse_wide_actions(space: spaces.Space[Any]) -> None:
    """:raises ConfigError: actions beyond [-1, 1].

    The losses and the steps of Adam, which are about as long for every weight, assume that scale.
    """
    if isinstance(space, spaces.Box) and (np.abs(limits_of(space)) > 1.0).any():
        raise ConfigError(
            f"action space {space}: cloning needs actions within [-1, 1]; wrap the environment in"
            " gymnasium.wrappers.RescaleAction(env, -1, 1)"
        )


def action_of(source: Any, default: str) -> str:
    """Return what the actions of a controller command; the default if it does not say, as a
    function does not.
    """
    record = getattr(source, FLIGHT_SETTINGS, None)
    if isinstance(record, dict):
        return str(record.get("action", "thrusts"))
    known = getattr(source, "action", "thrusts" if hasattr(source, "actions") else default)
    return known if isinstance(known, str) else default


def refuse_other_action(name: str, source: Any, action: str) -> None:
    """Refuse a controller whose actions command something else. A function does not say what.

    :param name: what the message calls it.
    :param action: what actions command here.
    :raises ConfigError: they command something else.
    """
    known = action_of(source, action)
    if known != action:
        raise ConfigError(
            f"{name}: commands {known}, and here actions are {action}; give action: {known}, or a"
            f" controller of {action}"
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
