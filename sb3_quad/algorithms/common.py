"""The parts that all algorithms with an expert share."""

import math
from collections.abc import Callable
from functools import wraps
from typing import Any

import gymnasium
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.utils import FloatSchedule, explained_variance
from stable_baselines3.common.vec_env import VecEnv
from typing_extensions import Self

from sb3_quad.agents.controller import Controller, limits_of
from sb3_quad.agents.expert_like import ExpertLike
from sb3_quad.agents.statistics import STATISTICS, share_statistics
from sb3_quad.algorithms import offset_correction
from sb3_quad.algorithms.networks.gradients import Terms, network_of
from sb3_quad.algorithms.networks.perceptron import one_torch_thread
from sb3_quad.algorithms.transfer import transfer_policy
from sb3_quad.base.errors import ConfigError, ExpertError, TrainingError, raised_as
from sb3_quad.base.files import one_line
from sb3_quad.base.types import Float32Array, StrDict
from sb3_quad.envs.simulation.settings import KEY, FlightSettings

_MOST = 2**40
# Arguments that are whole numbers
_COUNTS = (
    "n_steps",
    "batch_size",
    "n_epochs",
    "stats_window_size",
    "buffer_size",
    "train_freq",
    "target_update_interval",
    "substeps",
)
_SCHEDULES = ("learning_rate", "clip_range", "clip_range_vf", "bc_coef")
_SHARES = ("learning_rate", "gamma", "gae_lambda", "tau", "beta", "beta_final")
_WEIGHTS = (
    "max_grad_norm",
    "clip_range",
    "clip_range_vf",
    "target_kl",
    "critic_warmup",
    "bc_coef",
    "l2_coef",
    "vf_coef",
    "beta_decay",
    "body_rates_coef",
    "low_force_coef",
)
LIMITS = {
    **dict.fromkeys((*_COUNTS, "max_row_ratio"), (1, _MOST)),
    **dict.fromkeys(_SHARES, (0, 1)),
    **dict.fromkeys(_WEIGHTS, (0, _MOST)),
}
"""Valid range of each argument of the algorithms; for weights and counts, the greatest
holds for settings files alone."""
History = dict[str, list[float]]
"""The value of each term of the loss in every mini-batch of an update, by logged name."""
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
    "n_critics",
)
# Prefixes of the parameters that only the critic has.
_CRITIC = ("mlp_extractor.value_net.", "value_net.", "vf_features_extractor.")
# A limit further than this from the middle of the range counts as unbounded.
_UNLIMITED = 1e9


def with_unit_actions(train: Callable[[Any], None]) -> Callable[[Any], None]:
    """Rescale actions to [-1, 1] during an update, and back after it.

    The losses assume that scale. So do Adam's steps, which move every weight by about the same
    amount: negligible for outputs of 1,000 to 2,000, far too much for ±0.002. In a Box of [-1, 1]
    nothing changes.
    """

    @wraps(train)
    def scaled(self: Any) -> None:
        self._scale_actions()
        try:
            train(self)
        finally:
            self._scale_actions(inverse=True)

    return scaled


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
    _labeller: Controller | None = None
    # Further attributes that are not saved.
    _not_saved: tuple[str, ...] = ()

    def set_expert(self, expert: ExpertLike | None) -> None:
        """Learn from ``expert`` from now on; needed if a model was loaded without one.

        :raises ExpertError: an expert that does not fit the environment.
        """
        if expert is not None and self.env is not None:
            self._labeller = Controller.for_env(expert, self.env, self._labeller)
        self.expert = expert

    def _check_expert(self) -> None:
        if self.expert is None:
            name = type(self).__name__
            raise ExpertError(
                f"{name} needs an expert to clone: {name}(..., expert='geometric'),"
                " model.set_expert(...), or bc_coef=0"
            )

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

    def correct_offset(self, seed: int = 0, scale: float = 1.0) -> offset_correction.Correction:
        """Cancel the steady offset at which the agent hovers next to its targets.

        It changes the agent's own first layer, so the zip stays an ordinary SB3 zip (thesis 4.3.1).
        See :func:`~sb3_quad.algorithms.offset_correction.correct_offset`.

        :param seed: seed of the flights that measure the offset, with the settings of the model's
            environment.
        :param scale: α of Eq. 4.10; below 1, the agent is quicker near its target.
        :return: the offset before and after, m.
        :raises ConfigError: no quadcopter environment; an agent that crashes on the way to targets,
            or whose first layer does not read the 18 features. The agent is left unchanged.
        """
        settings = flight_settings_of(self.env)
        if settings is None:
            raise ConfigError(
                "correct_offset: the model has no quadcopter environment to measure the offset in;"
                " give it one by model.set_env(...)"
            )
        return offset_correction.correct_offset(self, seed, settings, scale)

    def _check_arguments(self) -> None:
        # SB3 would pickle NumPy numbers into the zip, and does not accept all of them.
        for name, value in [*vars(self).items()]:
            if isinstance(value, np.generic):
                setattr(self, name, value.item())
        for name, (least, _) in LIMITS.items():
            value = getattr(self, name, None)
            if callable(value) and name in _SCHEDULES:
                value = float(value(1.0))  # at its start
            # Some arguments can be None, and train_freq a tuple.
            if value is None or isinstance(value, tuple):
                continue
            valid, most = f"a number and at least {least}", math.inf
            if name in _SHARES and name not in _SCHEDULES:
                valid, most = "a number from 0 to 1", 1.0
            if not isinstance(value, (int, float)) or not least <= value <= most:
                raise ConfigError(f"{name} {value!r}: must be {valid}")
            if name in _COUNTS and not isinstance(value, int):
                raise ConfigError(f"{name} {value!r}: must be a whole number")
        # PPO cannot load the None that DAgger allows.
        if getattr(self, "max_grad_norm", 0.0) is None:
            self.max_grad_norm = math.inf
        # Rows are sampled all at once.
        capacity = getattr(self, "dataset_capacity", 0) or getattr(self, "buffer_size", 0)
        if 0 < capacity < getattr(self, "batch_size", 0):
            raise ConfigError(
                f"batch_size {self.batch_size}: more than the {capacity} rows of dataset_capacity"
                " or buffer_size"
            )
        if hasattr(self, "bc_coef"):
            self.bc_coef = FloatSchedule(self.bc_coef)
        if not issubclass(self.policy_class, self.policy_aliases["MlpPolicy"]):
            raise ConfigError(
                f"policy {self.policy_class.__name__}: {type(self).__name__} does not support it;"
                " give an agent of another algorithm as expert=... to a new model"
            )
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
            transfer_policy(initial, self)

    def _setup_model(self) -> None:
        self._check_arguments()
        # The orthogonal weights of a new network depend on the number of threads that make them.
        with one_torch_thread(compiled=True):
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

    def _scale_actions(self, inverse: bool = False) -> None:
        """Rescale actions to [-1, 1] for an update, or back; see :func:`with_unit_actions`.

        :param inverse: scale them back.
        :raises ConfigError: an action space without usable limits, or an actor without a plain last
            layer.
        """
        factor, offset = unit_action_transform(self.action_space, inverse)
        if (factor == 1.0).all() and not offset.any():
            return
        policy = self.policy
        buffer = self.rollout_buffer
        buffer.expert_actions = buffer.expert_actions * factor + offset
        if policy.squash_output:  # its actions are in [-1, 1] already
            return
        buffer.actions = buffer.actions * factor + offset
        buffer.log_probs = buffer.log_probs - np.log(factor).sum()
        scale = th.as_tensor(factor, device=policy.device)
        unfit = f"action space {self.action_space}: wrap it in RescaleAction(env, -1, 1)"
        with raised_as(ConfigError, unfit), th.no_grad():
            if getattr(policy.action_dist, "use_expln", False):
                raise ValueError("use_expln: log_std is not the log of a standard deviation")
            policy.action_net.weight *= scale[:, None]
            policy.action_net.bias.mul_(scale).add_(th.as_tensor(offset, device=policy.device))
            policy.log_std += scale.log()

    def _note_flight_settings(self) -> None:
        settings = flight_settings_of(self.env)
        if settings is not None:
            settings.write_into(self)
        elif hasattr(self, KEY):
            delattr(self, KEY)  # left by an earlier environment
        # BaseAlgorithm keeps them as ``_vec_normalize_env``, which is not saved.
        setattr(self, STATISTICS, self._vec_normalize_env)

    def learn(self, *arguments: Any, **keywords: Any) -> Self:
        """Learn as SB3 does. While compiled networks learn, PyTorch has one thread.

        :raises ExpertError: no expert where one is needed, or one that does not fit.
        """
        if self.env is not None and self.will_clone():
            self._labeller = Controller.for_env(self.expert, self.env, self._labeller)
        policy = self.policy
        compiled = isinstance(policy, ActorCriticPolicy) and network_of(policy) is not policy
        with one_torch_thread(compiled):
            return super().learn(*arguments, **keywords)  # type: ignore[safe-super]

    def _labels(self, env: VecEnv) -> Float32Array:
        """Return the expert's actions for the present states, (n_envs, action_dim).

        Call it before the step.
        """
        self._labeller = Controller.for_env(self.expert, env, self._labeller)
        with th.enable_grad():  # SB3's loops disable gradients, which an expert may need
            return self._labeller.labels(self._last_obs, self._last_episode_starts)

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
        own = ["expert", "_labeller", "rollout_buffer_class", "rollout_buffer_kwargs"]
        return [*super()._excluded_save_params(), *own, *self._not_saved]


def unit_action_transform(
    space: spaces.Box, inverse: bool = False
) -> tuple[Float32Array, Float32Array]:
    """Return factors and offsets, (a,) each, that map actions of a space to [-1, 1].

    :param inverse: return those that map [-1, 1] back to the space.
    :raises ConfigError: limits so far apart that they count as unbounded.
    """
    low, high = limits_of(space)
    half = 0.5 * high - 0.5 * low
    middle = low + half
    if not (half < _UNLIMITED).all():
        raise ConfigError(f"action space {space}: give it the limits of the actuators")
    half[half == 0.0] = 1.0  # an action that cannot change
    if inverse:
        return half, middle
    return 1.0 / half, -middle / half


def flight_settings_of(env: VecEnv | None) -> FlightSettings | None:
    """Return the flight settings of an environment, or None if they would not describe its agents.

    Wrappers may change rewards, and VecNormalize may be among them, since its statistics are in a
    model's zips. None: the environment is not one of this package, or a wrapper changes
    observations or actions, so that its agent would fly differently without the wrapper.
    """
    if env is None or not env.has_attr(KEY):
        return None
    changing = (
        gymnasium.ObservationWrapper,
        gymnasium.ActionWrapper,
        gymnasium.wrappers.MaxAndSkipObservation,
    )
    if any(any(env.env_is_wrapped(wrapper)) for wrapper in changing):
        return None
    settings: FlightSettings = env.get_attr(KEY, [0])[0]
    return settings if env.observation_space.shape == (settings.observation.size,) else None


def policy_arguments(
    given: StrDict | None,
    initial: BaseAlgorithm | None,
    family: type[BaseAlgorithm],
    log_std_init: float | None = None,
) -> StrDict:
    """Return the ``policy_kwargs`` of a new model.

    :param given: the user's arguments, which take precedence. ``log_std_init=None``: use no
        default.
    :param initial: the agent that the model starts from. If it belongs to the same ``family``, the
        arguments that define what its networks compute are taken from it, such as ``net_arch`` and
        the features extractor.
    :param log_std_init: the default.
    """
    arguments: StrDict = {}
    if isinstance(initial, family):
        for name in _OF_NETWORKS:
            if name in initial.policy_kwargs:
                arguments[name] = initial.policy_kwargs[name]
    arguments |= {"log_std_init": log_std_init} | (given or {})
    if arguments["log_std_init"] is None:
        del arguments["log_std_init"]
    return arguments


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
