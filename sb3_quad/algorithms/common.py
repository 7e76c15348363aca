"""The parts that all algorithms with an expert share."""

import warnings
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from stable_baselines3.common.utils import FloatSchedule, explained_variance
from stable_baselines3.common.vec_env import VecEnv
from typing_extensions import Self

from sb3_quad.algorithms.chain import (
    STATISTICS,
    chain_of,
    describe,
    note_chain,
    refuse_wrapped,
    share_statistics,
    statistics_of,
)
from sb3_quad.algorithms.labelling import (
    ExpertLike,
    Labeller,
    labeller_for,
    refuse_other_action,
)
from sb3_quad.algorithms.networks import Terms, network_of, one_thread
from sb3_quad.base.errors import ConfigError, TrainingError
from sb3_quad.base.files import one_line
from sb3_quad.base.plugins import FLIGHT_SETTINGS, plugin
from sb3_quad.base.types import BoolArray, Float32Array, FloatArray, StrDict, StrPath
from sb3_quad.base.validate import Share, Weight, check_arguments

RateOrSchedule = Share | Schedule
WeightOrSchedule = Weight | Schedule
History = dict[str, list[float]]
"""The value of each term of the loss in every mini-batch of an update, by logged name."""
# Attributes that have the name of an argument, but are not what the user gave, or may be anything
_OBJECTS = ("policy", "env", "expert", "cost", "device")
# Arguments that SB3 would store in a loaded model without using them
_OF_NEW_MODELS = {
    "initial_policy": "a zip holds its policy; give the other one to a new model",
    "demonstrations": "a loaded model of DAgger takes them by model.dataset.load(...)",
}
# The ``policy_kwargs`` that define what the networks compute.
_OF_NETWORKS = (
    "net_arch",
    "activation_fn",
    "features_extractor_class",
    "features_extractor_kwargs",
    "share_features_extractor",
    "normalize_images",
    "squash_output",
    "use_expln",
    "full_std",
)
# The first episodes of environments are compared with their last ones if there are this many.
_COMPARED = 10
# Prefixes of the parameters that only the critic has.
_CRITIC = ("mlp_extractor.value_net.", "value_net.", "vf_features_extractor.")


class ExpertMixin(BaseAlgorithm):
    """Adds an expert to an algorithm, and records in its zips how its agent flies."""

    policy: Any
    action_space: Any
    rollout_buffer: Any
    _last_obs: Any
    _last_episode_starts: Any
    batch_size: Any
    bc_coef: Any
    expert: ExpertLike | None = None
    # Queries the expert, and keeps a recurrent expert's state.
    _labeller: Labeller | None = None
    # By environment, return and length of its first episode and of its last one
    _episodes: dict[int, tuple[Any, Any]]
    check_expert: bool = True
    # Further attributes that are not saved.
    _not_saved: tuple[str, ...] = ()

    def set_expert(self, expert: ExpertLike | None) -> None:
        """Learn from ``expert`` from now on; needed if a model was loaded without one.

        :raises ExpertError: an expert that does not fit the environment.
        """
        if expert is not None and self.env is not None:
            self._labeller = labeller_for(expert, self.env, self._labeller, self.check_expert)
        self.expert = expert

    def will_clone(self) -> bool:
        """Return whether learning asks the expert: whether the cloning term ever has a weight.

        The schedule is sampled at 101 points.
        """
        return any(self.bc_coef(progress) for progress in np.linspace(1.0, 0.0, 101).tolist())

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """Learn in another environment from now on; see SB3's ``set_env``.

        From then on the model's zips record the flight settings of this environment, or none if
        they cannot be read. The model's VecNormalize statistics continue there.

        :raises ConfigError: only one of the agent and the environment normalises observations.
        """
        if hasattr(self, STATISTICS):
            share_statistics(getattr(self, STATISTICS), env, training=True)
        super().set_env(env, force_reset)
        self._note_flight_settings()

    def _check_arguments(self) -> None:
        if not issubclass(self.policy_class, self.policy_aliases["MlpPolicy"]):
            raise ConfigError(
                f"policy {self.policy_class.__name__}: {type(self).__name__} does not support it;"
                " give an agent of another algorithm as expert=... to a new model"
            )
        # SB3 would pickle NumPy numbers into the zip, and does not accept all of them.
        for name, value in [*vars(self).items()]:
            if isinstance(value, np.generic):
                setattr(self, name, value.item())
        given = {name: value for name, value in vars(self).items() if name not in _OBJECTS}
        check_arguments(type(self), given)
        if hasattr(self, "bc_coef"):
            self.bc_coef = FloatSchedule(self.bc_coef)
        is_for_parts = issubclass(self.policy_class, self.policy_aliases["MultiInputPolicy"])
        if is_for_parts and not isinstance(self.observation_space, spaces.Dict):
            raise ConfigError("policy MultiInputPolicy: needs Dict observations; give MlpPolicy")
        net_arch = self.policy_kwargs.get("net_arch")
        if isinstance(net_arch, str):
            raise ConfigError(f"net_arch {net_arch!r}: must be a list of numbers, as in [64, 64]")

    def _set_up(self, initial: BaseAlgorithm | None) -> None:
        """Set the model up, with the policy of the agent that it starts from."""
        self._setup_model()
        if initial is not None:
            copy_policy(initial, self)

    def _setup_model(self) -> None:
        self._check_arguments()
        # The orthogonal weights of a new network depend on the number of threads that make them.
        with one_thread():
            super()._setup_model()  # type: ignore[safe-super]
        if self.env is not None:
            # The statistics of a zip, which are read before this, continue in the environment.
            if hasattr(self, STATISTICS):
                share_statistics(getattr(self, STATISTICS), self.env, training=True)
            self._note_flight_settings()

    @classmethod
    def load(cls, *arguments: Any, **keywords: Any) -> Self:
        """Load a model by SB3's ``load``.

        :raises ConfigError: an argument that only a new model takes.
        """
        for name, way_out in _OF_NEW_MODELS.items():
            if keywords.get(name) is not None:
                raise ConfigError(f"{cls.__name__}.load does not take {name}; {way_out}")
        return super().load(*arguments, **keywords)

    def set_parameters(self, *arguments: Any, **keywords: Any) -> None:
        """Take the parameters of another model by SB3's ``set_parameters``.

        :raises RuntimeError: the parameters belong to other networks; the message is one line.
        """
        try:
            super().set_parameters(*arguments, **keywords)
        except RuntimeError as error:
            raise RuntimeError(f"set_parameters: {one_line(error)}") from None

    def _note_flight_settings(self) -> None:
        settings = note_chain(self, self.env)
        if self.env is not None:
            describe(self.env).refuse_inner_statistics()
        if settings is not None:
            settings.write_into(self)
        elif hasattr(self, FLIGHT_SETTINGS):
            delattr(self, FLIGHT_SETTINGS)  # left by an earlier environment
        # BaseAlgorithm keeps them as ``_vec_normalize_env``, which is not saved.
        setattr(self, STATISTICS, self._vec_normalize_env)

    def learn(self, *arguments: Any, **keywords: Any) -> Self:
        """Learn as SB3 does. While an accelerator learns, PyTorch has one thread.

        A warning says if the last episodes have far lower returns than the first ones.

        :raises ExpertError: no expert where one is needed, or one that does not fit.
        """
        if self.env is not None and self.will_clone():
            self._labeller = labeller_for(self.expert, self.env, self._labeller, self.check_expert)
        with network_of(self.policy).learning():
            super().learn(*arguments, **keywords)  # type: ignore[safe-super]
        if len(self._episodes) >= _COMPARED:
            first, last = np.array([*self._episodes.values()]).transpose(1, 0, 2)
            warn_if_worse(type(self).__name__, first, last)
        return self

    def _shows_in_returns(self) -> bool:
        """Return whether the returns of the present rollout say how well the agent flies."""
        return True

    def _labels(self, env: VecEnv) -> Float32Array:
        """Return the expert's actions for the present states, (n_envs, action_dim).

        Call it before the step.
        """
        self._labeller = labeller_for(self.expert, env, self._labeller, self.check_expert)
        return self._labeller.labels(self._last_obs, self._last_episode_starts)

    def _look(self, observations: Any, dones: BoolArray, infos: Any = ()) -> None:
        """Label the states that the policy has just observed, before a callback changes them."""
        for row in np.flatnonzero(dones) if infos else ():
            if "terminal_observation" not in infos[row]:
                warnings.warn(
                    f"row {row} ended without info['terminal_observation'], so the critic takes"
                    " its last reward for the end; a wrapper drops infos",
                    stacklevel=2,
                )
        if self._labeller is not None and self.expert is not None:
            self._labeller.look(observations, dones)

    def _setup_learn(self, *arguments: Any, **keywords: Any) -> Any:
        self._episodes = {}
        before, planned = self._last_obs, getattr(self, "_total_timesteps", 0)
        results = super()._setup_learn(*arguments, **keywords)
        if self._last_obs is not before:
            self._look(self._last_obs, self._last_episode_starts)
        # A training that continues after an interruption keeps its plan.
        continues = self.num_timesteps > 0 and self._total_timesteps > planned
        schedules = {"learning_rate": self.lr_schedule, "bc_coef": getattr(self, "bc_coef", None)}
        for name, schedule in schedules.items():
            if continues and schedule is not None and schedule(1.0) != schedule(0.0):
                warnings.warn(
                    f"{name}: its schedule ends with each call of learn; give one call all"
                    f" timesteps, or {name} a number",
                    stacklevel=3,
                )
        return results

    def _update_info_buffer(self, infos: Any, dones: Any = None) -> None:
        # SB3 would look into the infos of all rows, of which only those that ended tell an episode.
        if dones is not None:
            rows = np.flatnonzero(dones)
            infos, dones = [infos[row] for row in rows], dones[rows]
            for row, info in zip(rows.tolist(), infos, strict=True):
                episode = info.get("episode")
                if episode is not None and self._shows_in_returns():
                    last = (episode["r"], episode["l"])
                    first, _ = self._episodes.get(row, (last, last))
                    self._episodes[row] = (first, last)
        super()._update_info_buffer(infos, dones)

    def _refuse_dict_observations(self) -> None:
        space = self.observation_space
        if isinstance(space, spaces.Dict):
            raise ConfigError(
                f"observation space {space}: {type(self).__name__} does not support Dict with an"
                " expert; wrap the environment in gymnasium.wrappers.FlattenObservation"
            )

    def _log_update(self, history: History) -> None:
        """Log the mean of each term of an update."""
        for name, values in history.items():
            self.logger.record(f"train/{name}", float(np.mean(values)))
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")

    def _log_rollout(self, buffer: RolloutBuffer, clip_range_vf: float | None) -> None:
        """Log the other values that PPO logs after an update."""
        explained_var = explained_variance(buffer.values.flatten(), buffer.returns.flatten())
        self.logger.record("train/explained_variance", explained_var)
        if hasattr(self.policy, "log_std"):
            self.logger.record("train/std", th.exp(self.policy.log_std).mean().item())
        if clip_range_vf is not None:
            self.logger.record("train/clip_range_vf", clip_range_vf)

    def _diverged(self, terms: Terms) -> TrainingError:
        """Return the error for a loss or gradient that is not finite."""
        values = ", ".join(f"{name} {term:.3g}" for name, term in terms.items())
        return TrainingError(
            f"the loss is not finite after {self.num_timesteps} timesteps ({values}): lower"
            " learning_rate or bc_coef, and look for rewards and observations that are not finite"
        )

    def _excluded_save_params(self) -> list[str]:
        # No object of this package may be pickled: PPO.load must work where it is not installed.
        own = ["expert", "_labeller", "_episodes", "rollout_buffer_class", "rollout_buffer_kwargs"]
        return [*super()._excluded_save_params(), *own, *self._not_saved]


def warn_if_worse(name: str, first: FloatArray, last: FloatArray) -> None:
    """Warn if the last episodes of a training have far lower returns than its first ones.

    That is, by more than the standard deviation of the first ones plus half of that of the last
    ones, and by more than a quarter of the first ones' mean. Where the last ones are longer, they
    may cost more in proportion: the first ones of many environments often end early.

    :param name: what learned.
    :param first: the return and the length of each episode, (n, 2).
    :param last: likewise.
    """
    start, first_length = first.mean(axis=0)
    end, last_length = last.mean(axis=0)
    usual = first[:, 0].std() + 0.5 * last[:, 0].std()
    longer = max(last_length / first_length, 1.0)
    if end < min(start, longer * start) - max(usual, 0.25 * abs(start)):
        warnings.warn(
            f"{name}: the training ends far below its start: the last episodes have a mean reward"
            f" of {end:.3g}, the first ones had {start:.3g}; keep the agent that you had, or lower"
            " learning_rate",
            stacklevel=4,
        )


def model_of(source: BaseAlgorithm | StrPath | None) -> Any:
    """Return the model that ``initial_policy`` is or names; None for None."""
    if source is None or isinstance(source, BaseAlgorithm):
        return source
    return plugin("agent")(source)


def copy_policy(teacher: Any, model: BaseAlgorithm, name: str = "") -> None:
    """Give ``model`` the policy and critic of another with the same spaces and networks.

    ``log_std`` is the teacher's, unless the model's ``policy_kwargs`` have a ``log_std_init``. The
    optimiser is left as it is, so a new model starts with a new one. Statistics of VecNormalize go
    into the model's environment.

    If both say what they observe, a warning names the settings that differ.

    :param teacher: a model of any algorithm.
    :param name: what messages call the teacher.
    :raises ConfigError: parameters that are not finite; layers that differ, which the message
        names; or a policy that computes something else with the same layers.
    """
    name = name or f"the policy of {type(teacher).__name__}"
    record = getattr(model, FLIGHT_SETTINGS, {})
    if record and hasattr(teacher, FLIGHT_SETTINGS):
        refuse_other_action(name, teacher, record.get("action", "thrusts"))
        plugin("observation")(name, teacher, record)
    here = chain_of(model) or []
    learnt = chain_of(teacher)
    refuse_wrapped(name, learnt, here)
    if here and learnt == []:
        warnings.warn(f"{name}: was trained without {', '.join(here)}", stacklevel=2)
    theirs = dict(teacher.policy.state_dict())
    ours = model.policy.state_dict()
    if teacher.action_space != model.action_space:
        raise ConfigError(
            f"{name}: its actions are of {teacher.action_space}, here they are of"
            f" {model.action_space}"
        )
    share_statistics(statistics_of(teacher), model.get_env(), training=True)
    if not all(th.isfinite(tensor).all() for tensor in theirs.values()):
        raise ConfigError(f"{name}: holds parameters that are not finite")
    # The weights of a preview that the agent did not have are zero.
    added = 3 * len(record.get("preview") or ())
    for key, weights in theirs.items():
        if key in ours and weights.ndim == 2 and ours[key].shape[1] == weights.shape[1] + added:
            theirs[key] = th.nn.functional.pad(weights, (0, added))
    if "log_std_init" in model.policy_kwargs and "log_std" in ours:
        theirs["log_std"] = ours["log_std"]
    try:
        model.policy.load_state_dict(theirs)
    except RuntimeError as error:
        difference = one_line(error).partition(": ")[2]
        raise ConfigError(
            f"{name}: environment spaces and policy_kwargs must be the same ({difference});"
            " train takes them from it unless --conf-file is given"
        ) from None
    # Networks that compute something else may have parameters of the same names and shapes.
    if teacher.observation_space != model.observation_space:
        return
    for _ in range(8):
        observation = model.observation_space.sample()
        wanted, _ = teacher.policy.predict(observation, deterministic=True)
        actions, _ = model.policy.predict(observation, deterministic=True)
        if not np.allclose(actions, wanted, 0.01, 0.01 * np.abs(wanted).max(), equal_nan=True):
            raise ConfigError(
                f"{name}: its weights give other actions here; give the policy and policy_kwargs"
                " that it has, such as activation_fn or features_extractor_class"
            )


def policy_arguments(given: StrDict | None, initial: Any, log_std_init: float) -> StrDict:
    """Return the ``policy_kwargs`` of a new model.

    :param given: the user's arguments, which take precedence.
    :param initial: the agent that the model starts from, or None. Of an on-policy agent, those
        arguments are taken that define what its networks compute, such as ``net_arch`` and the
        features extractor, and its log_std stays.
    :param log_std_init: the default of a model that starts from scratch.
    """
    arguments: StrDict = {"log_std_init": log_std_init}
    if isinstance(initial, OnPolicyAlgorithm):
        theirs = initial.policy_kwargs
        arguments = {name: theirs[name] for name in _OF_NETWORKS if name in theirs}
    return arguments | (given or {})


def actor_and_critic_parameters(policy: Any) -> tuple[list[Any], list[Any]]:
    """Return the parameters of the actor and those that only the critic has.

    Parameters that both share count as the actor's.
    """
    actor: list[Any] = []
    critic: list[Any] = []
    for name, parameter in policy.named_parameters():
        if name.startswith(_CRITIC):
            critic.append(parameter)
        else:
            actor.append(parameter)
    return actor, critic
