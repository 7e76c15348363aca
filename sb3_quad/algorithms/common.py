"""What all algorithms that learn from an expert share."""

from typing import Any

import numpy as np
from stable_baselines3.common.type_aliases import Schedule

from sb3_quad.base.arrays import Arrays
from sb3_quad.controllers.controller import Controller

_CRITIC = ("mlp_extractor.value_net.", "value_net.", "vf_features_extractor.")  # names of the critic's own parameters


class ExpertMixin:
    """The expert of an algorithm, and its state from rollout to rollout."""

    expert: Any
    _labeller: Controller | None = None  # asks the expert, and holds its state

    def set_expert(self, expert: Any) -> None:
        """Learn from ``expert`` from now on, as a model must that was loaded without one."""
        self.expert = expert

    def _excluded_save_params(self) -> list[str]:
        # Nothing of this package may be pickled: PPO.load must work where it is not installed.
        return [*super()._excluded_save_params(), "expert", "_labeller"]  # type: ignore[misc]

    def expert_state(self) -> Arrays:
        """What an expert with a state, such as a recurrent policy, carries on, which no zip holds."""
        return {} if self._labeller is None else self._labeller.state()

    def restore_expert_state(self, state: Arrays) -> None:
        """Go back to an :meth:`expert_state`; the model needs its expert and environment.

        :raises ExpertError: an expert whose state could not be saved.
        """
        if state:
            self._labeller = Controller.for_env(self.expert, self.get_env(), self._labeller)  # type: ignore[attr-defined]
            self._labeller.restore(state)


def parameters_of_both(policy: Any) -> tuple[list[Any], list[Any]]:
    """The parameters of the actor, with what it shares with the critic, and those of the critic alone."""
    named = [*policy.named_parameters()]
    return [p for name, p in named if not name.startswith(_CRITIC)], [p for name, p in named if name.startswith(_CRITIC)]


def is_ever_nonzero(schedule: Schedule) -> bool:
    """Whether a schedule gives its term a weight anywhere, as far as a hundred samples of it tell."""
    return any(schedule(progress) for progress in np.linspace(1.0, 0.0, 101).tolist())
