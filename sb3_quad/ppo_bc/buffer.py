"""A rollout buffer that also keeps the expert's action for every visited state."""

from __future__ import annotations

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
        if not self.generator_ready:
            self.expert_actions = self.swap_and_flatten(self.expert_actions)
        yield from super().get(batch_size)  # type: ignore[misc]

    def _get_samples(self, batch_inds: IntArray, env: VecNormalize | None = None) -> Samples:  # type: ignore[override]
        return super()._get_samples(batch_inds, env), self.to_torch(self.expert_actions[batch_inds])
