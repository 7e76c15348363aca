"""The rollout buffer of :class:`~sb3_quad.algorithms.ppo_bc.PPOBC`: SB3's, with the expert's actions beside those flown."""

from collections.abc import Generator

import numpy as np
import torch as th
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.type_aliases import RolloutBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from sb3_quad.base.arrays import Float32Array, IntArray

Samples = tuple[RolloutBufferSamples, th.Tensor]  # SB3's, and the expert's actions, (batch_size, action_dim)


class ExpertRolloutBuffer(RolloutBuffer):
    """SB3's rollout buffer with a row of expert actions beside each row of actions; :meth:`get` yields both.

    ``expert_actions`` has shape (buffer_size, n_envs, action_dim) while the buffer fills; the algorithm writes row
    ``pos`` before it calls :meth:`add` for the same step.
    """

    expert_actions: Float32Array

    def reset(self) -> None:
        self.expert_actions = np.zeros((self.buffer_size, self.n_envs, self.action_dim), dtype=np.float32)
        super().reset()

    def get(self, batch_size: int | None = None) -> Generator[Samples, None, None]:  # type: ignore[override]
        for index in self.indices(batch_size):
            yield self.samples(index)

    def indices(self, batch_size: int | None = None, shuffle: bool = True) -> Generator[IntArray, None, None]:
        """The rows of each mini-batch of :meth:`get`; without ``shuffle``, consecutive in time over all environments."""
        if not self.generator_ready:
            self.expert_actions = self.swap_and_flatten(self.expert_actions)
        in_time, first = np.arange(self.buffer_size * self.n_envs).reshape(self.n_envs, -1).T.reshape(-1), 0
        for index in super().get(batch_size):
            yield index if shuffle else in_time[first : first + len(index)]  # type: ignore[misc]
            first += len(index)

    def _get_samples(self, batch_inds: IntArray, env: VecNormalize | None = None) -> IntArray:  # type: ignore[override]
        return batch_inds

    def samples(self, index: IntArray) -> Samples:
        """SB3's samples and the labels, gathered by PyTorch: in a third of the time of NumPy's indexing and a copy."""
        rows = th.from_numpy(index)
        columns = (self.values, self.log_probs, self.advantages, self.returns)
        arrays = (self.observations, self.actions.astype(np.float32, copy=False), self.expert_actions, *columns)
        states, actions, labels, *others = (th.from_numpy(array).index_select(0, rows).to(self.device) for array in arrays)
        return RolloutBufferSamples(states, actions, *(each.flatten() for each in others)), labels

    def targets(self, labelled: bool) -> tuple[Float32Array, Float32Array, Float32Array]:
        """After :meth:`indices`: observations, and the targets of actor and critic as :mod:`.networks` takes them.

        :param labelled: whether the expert's actions are among them.
        """
        labels = [self.expert_actions] if labelled else []
        for_actor = np.hstack([*labels, self.actions, self.log_probs, self.advantages], dtype=np.float32)
        return self.observations.reshape(len(for_actor), -1), for_actor, np.hstack([self.values, self.returns])
