"""What all algorithms that learn from an expert share."""

import inspect
from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import MaybeCallback, Schedule
from typing_extensions import Self

from sb3_quad.algorithms.networks.gradients import network_of
from sb3_quad.algorithms.networks.perceptron import one_torch_thread
from sb3_quad.base.errors import ConfigError
from sb3_quad.controllers.controller import Controller

LIMITS = {
    **dict.fromkeys(("learning_rate", "gamma", "gae_lambda", "tau"), (0, 1)),
    **dict.fromkeys(
        ("n_steps", "batch_size", "n_epochs", "stats_window_size", "buffer_size"), (1, 2**40)
    ),
    **dict.fromkeys(("train_freq", "target_update_interval"), (1, 2**40)),
    **dict.fromkeys(
        ("max_grad_norm", "clip_range", "clip_range_vf", "target_kl", "critic_warmup"), (0, 2**40)
    ),
    **dict.fromkeys(("bc_coef", "aux_coef", "l2_coef", "vf_coef", "beta_decay"), (0, 2**40)),
}
"""Of arguments of the algorithms: the least, and the greatest that a settings file may have."""
_CRITIC = (
    "mlp_extractor.value_net.",
    "value_net.",
    "vf_features_extractor.",
)  # names of the critic's own parameters


class ExpertMixin:
    """The expert of an algorithm."""

    expert: Any
    _labeller: Controller | None = (
        None  # asks the expert, and holds what a recurrent one carries on
    )

    def set_expert(self, expert: Any) -> None:
        """Learn from ``expert`` from now on, as a model must that was loaded without one."""
        self.expert = expert

    def _setup_model(self) -> None:
        for name, (least, _) in LIMITS.items():
            given = getattr(self, name, None)
            value = given(1.0) if callable(given) else given  # at the start of a schedule
            if isinstance(value, (int, float)) and not value >= least:
                raise ConfigError(f"{name} {value:g}: must be at least {least}")
        with one_torch_thread(
            compiled=True
        ):  # the orthogonal weights of a network depend on how many threads make them
            super()._setup_model()  # type: ignore[misc]

    def _prepare_to_learn(self, anew: bool) -> None:
        """Check the expert, and forget what the environments before have left where they begin
        ``anew``.
        """
        raise NotImplementedError

    def learn(self, total_timesteps: int, callback: MaybeCallback = None, **keywords: Any) -> Self:
        """As in SB3; ``tb_log_name`` is the name of the class unless another is given.

        :raises ExpertError: no expert where one is needed, or one that does not fit the
            environment.
        """
        self._prepare_to_learn(keywords.get("reset_num_timesteps", True))
        policy: Any = self.policy  # type: ignore[attr-defined]
        with one_torch_thread(
            isinstance(policy, ActorCriticPolicy) and network_of(policy) is not policy
        ):
            return super().learn(
                total_timesteps, callback, **{"tb_log_name": type(self).__name__, **keywords}
            )  # type: ignore[misc, no-any-return]

    def _refuse_dict_observations(self) -> None:
        space = self.observation_space  # type: ignore[attr-defined]
        if isinstance(space, spaces.Dict):
            raise ConfigError(
                f"observation space {space}: {type(self).__name__} does not support Dict with an expert; wrap the environment "
                "in gymnasium.wrappers.FlattenObservation"
            )

    def _excluded_save_params(self) -> list[str]:
        # Nothing of this package may be pickled: PPO.load must work where it is not installed.
        return [*super()._excluded_save_params(), "expert", "_labeller"]  # type: ignore[misc]


def arguments_of(algorithm: type[BaseAlgorithm], given: Mapping[str, Any]) -> dict[str, Any]:
    """Those of some arguments that the constructor of SB3's ``algorithm`` takes, but for
    ``_init_setup_model``.
    """
    names = inspect.signature(algorithm.__init__).parameters.keys() - {"self", "_init_setup_model"}
    return {name: value for name, value in given.items() if name in names}


def parameters_of_both(policy: Any) -> tuple[list[Any], list[Any]]:
    """The parameters of the actor, with what it shares with the critic, and those of the critic
    alone.
    """
    named = [*policy.named_parameters()]
    return [p for name, p in named if not name.startswith(_CRITIC)], [
        p for name, p in named if name.startswith(_CRITIC)
    ]


def is_ever_nonzero(schedule: Schedule) -> bool:
    """Whether a schedule gives its term a weight anywhere, as far as a hundred samples of it tell."""
    return any(schedule(progress) for progress in np.linspace(1.0, 0.0, 101).tolist())
