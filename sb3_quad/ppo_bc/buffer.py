"""A rollout buffer that also keeps the expert's action for every visited state."""

from __future__ import annotations

from collections.abc import Generator
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch as th
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.vec_env import VecNormalize

from sb3_quad.base.arrays import Float32Array, IntArray


class ExpertRolloutBufferSamples(NamedTuple):
    """SB3's ``RolloutBufferSamples`` and ``expert_actions`` of shape (batch_size, action_dim)."""

    observations: th.Tensor
    actions: th.Tensor
    old_values: th.Tensor
    old_log_prob: th.Tensor
    advantages: th.Tensor
    returns: th.Tensor
    expert_actions: th.Tensor


class ExpertRolloutBuffer(RolloutBuffer):
    """SB3's rollout buffer with a row of expert actions beside each row of actions.

    ``expert_actions`` has shape (buffer_size, n_envs, action_dim) while the buffer fills; the algorithm writes row
    ``pos`` before it calls :meth:`add` for the same step.
    """

    expert_actions: Float32Array

    def reset(self) -> None:
        self.expert_actions = np.zeros((self.buffer_size, self.n_envs, self.action_dim), dtype=np.float32)
        super().reset()

    def get(  # type: ignore[override]
        self, batch_size: int | None = None
    ) -> Generator[ExpertRolloutBufferSamples, None, None]:
        if not self.generator_ready:
            self.expert_actions = self.swap_and_flatten(self.expert_actions)
        yield from super().get(batch_size)  # type: ignore[misc]

    def _get_samples(  # type: ignore[override]
        self, batch_inds: IntArray, env: VecNormalize | None = None
    ) -> ExpertRolloutBufferSamples:
        """SB3's samples and the labels; gathered by PyTorch, in a third of the time of NumPy's indexing and a copy."""
        rows = th.from_numpy(batch_inds)

        def gather(array: npt.NDArray[Any]) -> th.Tensor:
            return th.from_numpy(array).index_select(0, rows).to(self.device)

        return ExpertRolloutBufferSamples(
            observations=gather(self.observations),
            actions=gather(self.actions.astype(np.float32, copy=False)),
            old_values=gather(self.values).flatten(),
            old_log_prob=gather(self.log_probs).flatten(),
            advantages=gather(self.advantages).flatten(),
            returns=gather(self.returns).flatten(),
            expert_actions=gather(self.expert_actions),
        )
