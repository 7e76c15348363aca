"""SB3's rollout and replay buffers with the expert's actions beside those flown."""

from collections.abc import Generator
from typing import Any, NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer, RolloutBuffer
from stable_baselines3.common.vec_env import VecNormalize

from sb3_quad.algorithms.networks.gradients import Batch
from sb3_quad.base.arrays import BoolArray, Float32Array, IntArray


class ExpertRolloutBuffer(RolloutBuffer):
    """SB3's rollout buffer with a row of expert actions beside each row of actions.

    ``expert_actions`` has shape (buffer_size, n_envs, action_dim) while the buffer fills; the algorithm writes row
    ``pos`` before it calls :meth:`add` for the same step. ``bc_coef`` is the weight of the cloning term in the update on this
    rollout; where it is 0 there are no expert actions.
    """

    expert_actions: Float32Array
    bc_coef = 0.0

    def reset(self) -> None:
        self.expert_actions = np.zeros((self.buffer_size, self.n_envs, self.action_dim), dtype=np.float32)
        self._targets: tuple[Float32Array, Float32Array] | None = None
        super().reset()

    def get(self, batch_size: int | None = None, shuffle: bool = True) -> Generator[tuple[Batch, Batch], None, None]:  # type: ignore[override]
        """Mini-batches of the actor and of the critic, the same rows; without ``shuffle``, consecutive in time."""
        in_time, first = np.arange(self.buffer_size * self.n_envs).reshape(self.n_envs, -1).T.reshape(-1), 0
        sampled: Any = super().get(batch_size)
        for rows in sampled:
            if self._targets is None:
                labels = [self.swap_and_flatten(self.expert_actions)] if self.bc_coef != 0.0 else []
                for_actor = np.hstack([*labels, self.actions, self.log_probs, self.advantages], dtype=np.float32)
                self._targets = for_actor, np.hstack([self.values, self.returns])
            chosen = rows if shuffle else in_time[first : first + len(rows)]
            first += len(rows)
            yield Batch(chosen, self.observations, self._targets[0]), Batch(chosen, self.observations, self._targets[1])

    def _get_samples(self, batch_inds: IntArray, env: VecNormalize | None = None) -> IntArray:  # type: ignore[override]
        return batch_inds


class ExpertReplaySamples(NamedTuple):
    """SB3's ``ReplayBufferSamples``, (b, ...) each, with the expert's scaled actions for a state and the next one.

    ``next_is_labelled``, bool (b, 1), says where there are expert actions for the next state.
    """

    observations: th.Tensor
    actions: th.Tensor
    next_observations: th.Tensor
    dones: th.Tensor
    rewards: th.Tensor
    discounts: th.Tensor | None
    expert_actions: th.Tensor
    next_expert_actions: th.Tensor
    next_is_labelled: th.Tensor


class ExpertReplayBuffer(ReplayBuffer):
    """SB3's replay buffer with the expert's scaled actions for each state and for the next one.

    The algorithm calls :meth:`label` before it calls :meth:`add` for the same step.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        shape = (self.buffer_size, self.n_envs, self.action_dim)
        self.expert_actions, self.next_expert_actions = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        self.next_is_labelled = np.zeros((*shape[:2], 1), np.bool_)

    def label(self, actions: Float32Array, next_actions: Float32Array, next_is_labelled: BoolArray) -> None:
        """Set the expert's actions (n_envs, action_dim) for the row that is added next, and the next states that have one."""
        self.expert_actions[self.pos], self.next_expert_actions[self.pos] = actions, next_actions
        self.next_is_labelled[self.pos] = next_is_labelled[:, None]

    def _get_samples(self, batch_inds: IntArray, env: VecNormalize | None = None) -> ExpertReplaySamples:  # type: ignore[override]
        # SB3 samples each row's environment itself and keeps it to itself: the same numbers are sampled twice.
        before = np.random.get_state()  # noqa: NPY002
        at = batch_inds, np.random.randint(0, high=self.n_envs, size=batch_inds.shape)  # noqa: NPY002
        np.random.set_state(before)  # noqa: NPY002
        labels = self.expert_actions[at], self.next_expert_actions[at], self.next_is_labelled[at]
        return ExpertReplaySamples(*super()._get_samples(batch_inds, env), *map(self.to_torch, labels))


class ExpertNStepReplayBuffer(ExpertReplayBuffer, NStepReplayBuffer):  # type: ignore[misc]
    """The same with SB3's n-step returns; the next state's labels are those one step on."""
