"""DAgger for policies that remember: truncated backpropagation through time over the rollouts of an aggregated dataset."""

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import MaybeCallback
from typing_extensions import Self

from sb3_quad import common
from sb3_quad.base.arrays import Arrays, Float32Array, IntArray
from sb3_quad.base.errors import ConfigError, unknown
from sb3_quad.base.imports import require
from sb3_quad.dagger.dagger import DAgger, Timeout
from sb3_quad.dagger.dataset import AggregatedDataset, SequenceDataset
from sb3_quad.recurrent.raptor_policy import RaptorPolicy

require("sb3_contrib", "recurrent", "recurrent_dagger")

from sb3_contrib import RecurrentPPO  # noqa: E402
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy  # noqa: E402
from sb3_contrib.common.recurrent.type_aliases import RNNStates  # noqa: E402

State = tuple[th.Tensor, ...]  # of a recurrent module: hidden and cell, (n_layers, n, size) each
Ask = Callable[[th.Tensor, State, th.Tensor], th.Tensor]  # of observations, states and episode starts, as the policy's methods
PADDING = 2.0  # times the steps of a mini-batch, up to which its episodes are computed side by side

_STATES = "policy."  # before the names of the policy's states in a memory


class RecurrentDAgger(DAgger):
    """DAgger whose agent is a recurrent policy of sb3-contrib: ``MlpLstmPolicy``, ``CnnLstmPolicy``, or a subclass of theirs.

    As :class:`~sb3_quad.dagger.DAgger`, but for what a memory needs. In flight, the policy's recurrent states go on from
    rollout to rollout and begin anew with each episode. The dataset holds sequences, each of what one environment saw in one
    rollout, together with the actor's state before it. Every optimiser step takes some of them, from any rollouts, and
    backpropagates through all their ``n_steps`` steps; not beyond, nor across the start of an episode. The state before a
    sequence stays the one that it was flown with, though the policy has learnt since.

    A saved model loads with ``sb3_contrib.RecurrentPPO.load``, even where this package is not installed; but one with our
    :class:`~sb3_quad.recurrent.raptor_policy.RaptorPolicy`, which PX4 flies, needs it.

    Source of the method beside those of DAgger: R. J. Williams, J. Peng, *An efficient gradient-based algorithm for on-line
    training of recurrent network trajectories*, Neural Computation 2 (4), 1990 (truncated backpropagation through time).

    Arguments are those of DAgger; these differ:

    :param policy: ``MlpLstmPolicy``, ``CnnLstmPolicy``, ``RaptorPolicy``, or a subclass of ``RecurrentActorCriticPolicy``
    :param n_steps: Steps of a rollout in each environment, which gradients go back through at most
    :param batch_size: Minibatch size, in pairs: ``batch_size // n_steps`` sequences, and one at least
    :param dataset_capacity: Most pairs kept, in whole sequences, the oldest leave first. 0: the current rollout only
    :raises ConfigError: an argument out of range, a policy that is not recurrent, or a space that is not supported
    :raises ExpertError: an expert that does not fit the environment
    """

    policy_aliases = {**RecurrentPPO.policy_aliases, "RaptorPolicy": RaptorPolicy}
    dataset: SequenceDataset
    _states: RNNStates | None = None  # what the policy remembers now
    _states_before: RNNStates  # what it remembered when the rollout began
    _flown_values: list[Float32Array]  # V (n_envs,) of each step of the rollout

    def _get_policy_from_name(self, policy_name: str) -> type[BasePolicy]:
        if policy_name not in self.policy_aliases:
            raise ConfigError(unknown("recurrent policy", policy_name, self.policy_aliases))
        return self.policy_aliases[policy_name]

    def _check_arguments(self) -> None:
        if not issubclass(self.policy_class, RecurrentActorCriticPolicy):
            raise ConfigError(
                f"policy {self.policy_class.__name__}: RecurrentDAgger needs a RecurrentActorCriticPolicy, such as "
                "MlpLstmPolicy; DAgger takes the others"
            )
        super()._check_arguments()

    def _empty_dataset(
        self, capacity: int, observation_shape: tuple[int, ...], action_dim: int, dtype: npt.DTypeLike
    ) -> AggregatedDataset:
        policy: Any = self.policy
        n_layers, _, size = policy.lstm_hidden_state_shape
        return SequenceDataset(capacity, observation_shape, action_dim, dtype, self.n_steps, (n_layers, size))

    # --- In flight ---

    def _means(self, networks: common.Perceptrons | None, observations: npt.NDArray[Any], step: int) -> Float32Array:
        policy: Any = self.policy
        n_layers, _, size = policy.lstm_hidden_state_shape
        zeros = th.zeros(n_layers, len(observations), size, device=self.device)
        if self._states is None or self._states.pi[0].shape != zeros.shape:
            self._states = RNNStates((zeros, zeros), (zeros, zeros))
        if step == 0:
            self._states_before, self._flown_values = self._states, []
        with th.no_grad():
            seen, starts = self._now(observations)
            means, values, _, self._states = policy.forward(seen, self._states, starts, deterministic=True)
        self._flown_values.append(values.flatten().cpu().numpy())
        return np.asarray(means.reshape(len(means), -1).cpu().numpy())

    def _now(self, observations: Any) -> tuple[th.Tensor, th.Tensor]:
        """Observations, and the rows that begin an episode with them, as the policy takes them."""
        starts: Any = self._last_episode_starts
        return th.as_tensor(observations, device=self.device), th.as_tensor(starts, dtype=th.float32, device=self.device)

    def _critic_memory(self, row: int) -> State:
        assert self._states is not None
        return tuple(part[:, row] for part in self._states.vf)

    def _rollout_values(self, timeouts: list[Timeout]) -> tuple[Float32Array, Float32Array, Float32Array]:
        policy: Any = self.policy
        assert self._states is not None
        with th.no_grad():
            seen, starts = self._now(self._last_obs)
            last = policy.predict_values(seen, self._states.vf, starts).flatten().cpu().numpy()
            terminal = np.empty(0, dtype=np.float32)
            if timeouts:
                _, _, observations, states = zip(*timeouts, strict=True)
                seen = th.as_tensor(np.stack(observations), device=self.device)
                state = tuple(th.stack(part, dim=1) for part in zip(*states, strict=True))
                going_on = th.zeros(len(seen), device=self.device)
                terminal = policy.predict_values(seen, state, going_on).flatten().cpu().numpy()
        return np.stack(self._flown_values), last, terminal

    def _aggregate(self, labels: Float32Array) -> None:
        buffer = self.rollout_buffer
        hidden, cell = (part.transpose(0, 1).cpu().numpy() for part in self._states_before.pi)
        starts = buffer.episode_starts.T > 0.0
        self.dataset.add_sequences(buffer.observations.swapaxes(0, 1), labels.swapaxes(0, 1), starts, (hidden, cell))

    # --- Learning ---

    def _batch_rows(self) -> tuple[int, int]:
        return self.n_envs, max(self.batch_size // self.n_steps, 1)

    def _critic_data(self) -> tuple[npt.NDArray[Any], Float32Array]:
        """Observations (n_envs, n_steps, ...) of the rollout; V when it was flown, and the returns, (n_envs, n_steps, 2)."""
        buffer = self.rollout_buffer
        values = np.stack([buffer.values.T, buffer.returns.T], axis=2)
        return buffer.observations.swapaxes(0, 1), values

    def _actor_batch(self, rows: IntArray) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        policy: Any = self.policy
        parts = (part.to(self.device) for part in self.dataset.sequences(th.from_numpy(rows)))
        observations, labels, starts, *states = parts

        def mean(*given: Any) -> th.Tensor:
            return policy.get_distribution(*given)[0].mode()  # type: ignore[no-any-return]

        return through_time(mean, observations, starts, tuple(states)), policy.log_std, labels.flatten(0, 1)

    def _critic_batch(self, flown: npt.NDArray[Any], values: Float32Array, rows: IntArray) -> tuple[th.Tensor, th.Tensor]:
        policy: Any = self.policy
        starts = self.rollout_buffer.episode_starts.T > 0.0
        observations, begins, bounds = (th.as_tensor(part[rows], device=self.device) for part in (flown, starts, values))
        states = tuple(part[:, rows].transpose(0, 1) for part in self._states_before.vf)
        return through_time(policy.predict_values, observations, begins, states).flatten(), bounds.flatten(0, 1)

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1,
        tb_log_name: str = "RecurrentDAgger",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """As of :class:`~sb3_quad.dagger.DAgger`."""
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)

    # --- Saving ---

    def memory(self) -> Arrays:
        """What is remembered from rollout to rollout and is in no zip: by the expert, and by the policy."""
        states = [] if self._states is None else [*self._states.pi, *self._states.vf]
        return super().memory() | {f"{_STATES}{k}": part.cpu().numpy() for k, part in enumerate(states)}

    def restore_memory(self, memory: Arrays) -> None:
        own = {name for name in memory if name.startswith(_STATES)}
        super().restore_memory({name: memory[name] for name in memory.keys() - own})
        if own:
            parts = [th.as_tensor(memory[f"{_STATES}{k}"], device=self.device) for k in range(len(own))]
            half = len(parts) // 2
            self._states = RNNStates(tuple(parts[:half]), tuple(parts[half:]))

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_states", "_states_before", "_flown_values"]


def through_time(ask: Ask, observations: th.Tensor, starts: th.Tensor, states: State) -> th.Tensor:
    """What a recurrent policy gives along sequences that hold several episodes, (b * n_steps, ...), sequence by sequence.

    sb3-contrib goes through a sequence step by step as soon as an episode begins in one of them. Here each part from one
    start to the next is a sequence of its own, padded to the longest, so that PyTorch's modules go through all of them at
    once; unless that is so much padding that steps are cheaper. Both give the same to rounding.

    :param ask: from observations (m, ...), states (n_layers, s, size) and episode starts (m,) of s sequences.
    :param observations: (b, n_steps, ...); :param starts: bool (b, n_steps), where an episode begins.
    :param states: before the sequences, each (b, n_layers, size).
    """
    (n, n_steps), flat = starts.shape, observations.flatten(0, 1)
    begins = starts.clone()
    begins[:, 0] = True
    first = begins.flatten().nonzero()[:, 0]
    end = first.new_tensor([n * n_steps])
    lengths = th.diff(first, append=end)
    offsets = th.arange(int(lengths.max()), device=first.device)
    if len(first) * len(offsets) > PADDING * n * n_steps:
        before = tuple(part.transpose(0, 1).contiguous() for part in states)
        return ask(flat, before, starts.flatten().float())
    goes_on = ~starts.flatten()[first, None, None]
    before = tuple((part[first // n_steps] * goes_on).transpose(0, 1).contiguous() for part in states)
    places = (first[:, None] + offsets).clamp(max=n * n_steps - 1).flatten()
    given = ask(flat[places], before, th.zeros(len(places), device=flat.device))
    return given[(offsets < lengths[:, None]).flatten()]
