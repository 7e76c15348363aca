"""Soft actor-critic that also clones an expert: a value-based stage two."""

from typing import Any

import numpy as np
import numpy.typing as npt
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from stable_baselines3.common.utils import FloatSchedule, polyak_update
from stable_baselines3.sac.policies import SACPolicy
from torch import nn
from torch.nn import functional as F

from sb3_quad.algorithms.buffers import (
    ExpertDictReplayBuffer,
    ExpertNStepReplayBuffer,
    ExpertReplayBuffer,
    ExpertReplaySamples,
)
from sb3_quad.algorithms.common import ExpertMixin, arguments_of, is_ever_nonzero
from sb3_quad.algorithms.networks.losses import CloningLoss, agree, cloning_errors
from sb3_quad.base.arrays import BoolArray, Float32Array
from sb3_quad.base.errors import ConfigError, ExpertError, TrainingError, unknown
from sb3_quad.controllers.controller import Controller

BC_LOSSES: tuple[CloningLoss, ...] = ("mse", "huber", "huber_mse")
BC_FILTERS = ("none", "q", "agreement")


class SACBC(ExpertMixin, SAC):  # type: ignore[misc]
    """Soft Actor-Critic with a cloning term in the actor's loss (SAC+BC).

    All arguments of :class:`stable_baselines3.SAC` keep their meaning and defaults. With the
    additions at their defaults it is SAC, bit for bit. A saved model loads with ``SAC.load``, even
    where this package is not installed. For any environment with a Box action space.

    What is added, with its source:

    =====================
    ============================================================================================
    ``critic_layer_norm``  layer-normalised critics, which overestimate unseen actions less: RLPD,
                           https://arxiv.org/abs/2302.02948
    ``bc_coef``            a cloning term in the actor's loss: Nair et al.,
    https://arxiv.org/abs/1709.10089; weighed by
                           the mean absolute Q as in TD3+BC, https://arxiv.org/abs/2106.06860. The
                           expert labels every state that is visited, as in DAgger, not its own
                           flights alone
    ``bc_filter="q"``      only where the critic prefers the expert's action: the Q filter of Nair
    et al. =====================
    ============================================================================================

    :param expert: who labels: an object with ``actions(state)`` on the true state of our
        environments, an SB3 model, or a function from observations to actions; or a name as YAML
        takes it, such as ``"pid"``. It is never saved. Needed when learning starts with cloning.
    :param bc_coef: weight of the cloning term in units of the mean absolute Q: a float, or a
        schedule of the remaining progress.
    :param bc_loss: error of the policy's mean action: ``"mse"``, squared; ``"huber"``, linear
        beyond 0.05; ``"huber_mse"``, that and three times the squared error. Actions are those of
        the policy, within -1 and 1.
    :param bc_filter: where to clone: ``"none"``, everywhere; ``"q"``, where Q of the expert's
        action is greater than Q of the policy's mean action; ``"agreement"``, where both differ by
        less than 0.3, as of :class:`PPOBC`.
    :param critic_warmup: for this many gradient steps only the critic learns, so that an actor that
        comes from imitation is not moved by a critic that has learnt nothing yet.
    :param critic_layer_norm: whether the critics normalise the inputs of their activations, without
        parameters: in stock ``SAC`` the zip loads and its actor is the same, but its critics do not
        normalise.
    :raises ConfigError: a value out of range, a name that is not known, or a space that is not
        supported, when built.
    :raises ExpertError: when learning starts: no expert, or one whose labels do not fit.
    :raises TrainingError: a loss that is not finite.
    """

    def __init__(
        self,
        policy: str | type[SACPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 3e-4,
        buffer_size: int = 1_000_000,
        learning_starts: int = 100,
        batch_size: int = 256,
        tau: float = 0.005,
        gamma: float = 0.99,
        train_freq: int | tuple[int, str] = 1,
        gradient_steps: int = 1,
        action_noise: ActionNoise | None = None,
        replay_buffer_class: type[ReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        optimize_memory_usage: bool = False,
        n_steps: int = 1,
        ent_coef: str | float = "auto",
        target_update_interval: int = 1,
        target_entropy: str | float = "auto",
        use_sde: bool = False,
        sde_sample_freq: int = -1,
        use_sde_at_warmup: bool = False,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        expert: Any = None,
        bc_coef: float | Schedule = 0.0,
        bc_loss: CloningLoss = "mse",
        bc_filter: str = "none",
        critic_warmup: int = 0,
        critic_layer_norm: bool = False,
        _init_setup_model: bool = True,
    ):
        super().__init__(**arguments_of(SAC, locals()), _init_setup_model=False)
        for name, value, valid in (
            ("bc_loss", bc_loss, BC_LOSSES),
            ("bc_filter", bc_filter, BC_FILTERS),
        ):
            if value not in valid:
                raise ConfigError(unknown(name, value, valid))
        self.expert = expert
        self.bc_coef = bc_coef
        self.bc_loss: CloningLoss = bc_loss
        self.bc_filter = bc_filter
        self.critic_warmup = critic_warmup
        self.critic_layer_norm = critic_layer_norm
        self._clones = False
        self._labels: Float32Array | None = (
            None  # (n_envs, action_dim): its scaled actions for the present states
        )
        self._starts: BoolArray | None = (
            None  # (n_envs,): which rows have just begun an episode; None: all
        )

        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        self.bc_coef = FloatSchedule(self.bc_coef)
        self._clones = is_ever_nonzero(self.bc_coef)
        if isinstance(self.observation_space, spaces.Dict) and self.n_steps > 1:
            raise ConfigError(
                f"n_steps {self.n_steps}: Stable-Baselines3 has no n-step returns of Dict observations; give 1"
            )
        if self._clones:
            if self.replay_buffer_class not in (
                None,
                ReplayBuffer,
                NStepReplayBuffer,
                DictReplayBuffer,
            ):
                raise ConfigError(
                    f"replay_buffer_class {self.replay_buffer_class}: has no room for the expert's actions"
                )
            kind = ExpertReplayBuffer if self.n_steps == 1 else ExpertNStepReplayBuffer
            if isinstance(self.observation_space, spaces.Dict):
                kind = ExpertDictReplayBuffer
            returns = {} if self.n_steps == 1 else {"n_steps": self.n_steps, "gamma": self.gamma}
            both = self.observation_space, self.action_space
            memory = self.device, self.n_envs, self.optimize_memory_usage
            self.replay_buffer = kind(
                self.buffer_size, *both, *memory, **self.replay_buffer_kwargs, **returns
            )
        super()._setup_model()
        if self.critic_layer_norm:
            _normalise_layers(self.critic)
            _normalise_layers(self.critic_target)

    @property
    def policy_is_idle(self) -> bool:
        """Whether the policy is still the one that it began with, since only the critic has learnt
        (``critic_warmup``).
        """
        return 0 < self.critic_warmup >= self._n_updates

    def will_clone(self) -> bool:
        """Whether the expert is needed at all."""
        return self._clones

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
        if (
            self._clones
        ):  # before the step: an expert that sees the true state labels the present one
            assert self.env is not None and self._last_obs is not None
            self._labeller = Controller.for_env(self.expert, self.env, self._labeller)
            labels = self._labeller.labels(self._last_obs, self._starts)  # type: ignore[arg-type]
            scaled = self.policy.scale_action(labels.reshape(n_envs, *self.action_space.shape))  # type: ignore[misc]
            self._labels = np.asarray(scaled, dtype=np.float32).reshape(n_envs, -1)
        return super()._sample_action(learning_starts, action_noise, n_envs)

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: npt.NDArray[Any],
        new_obs: Any,
        reward: npt.NDArray[Any],
        dones: npt.NDArray[Any],
        infos: list[dict[str, Any]],
    ) -> None:
        if isinstance(replay_buffer, ExpertReplayBuffer) and self._labels is not None:
            replay_buffer.label(self._labels)
        self._starts = dones
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)

    @staticmethod
    def _least_q(critic: Any, observations: Any, actions: th.Tensor) -> th.Tensor:
        """The least of the critics' values, (b, 1)."""
        return th.cat(critic(observations, actions), dim=1).min(dim=1, keepdim=True).values

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """Updates on the replay buffer: SAC's loop, with what is added to it marked by ``+``."""
        assert self.replay_buffer is not None
        self.policy.set_training_mode(True)
        optimizers = [self.actor.optimizer, self.critic.optimizer]
        if self.ent_coef_optimizer is not None:
            optimizers += [self.ent_coef_optimizer]
        self._update_learning_rate(optimizers)
        bc_coef = self.bc_coef(self._current_progress_remaining)  # type: ignore[operator]  # +
        monitored: dict[str, list[float]] = {}  # by name: a number of each gradient step

        def monitor(**values: th.Tensor) -> None:
            for name, value in values.items():
                monitored.setdefault(name, []).append(value.item())

        for gradient_step in range(gradient_steps):
            data: Any = self.replay_buffer.sample(
                batch_size, env=self._vec_normalize_env
            )  # + with the expert's actions
            discounts = data.discounts if data.discounts is not None else self.gamma
            if self.use_sde:
                self.actor.reset_noise()

            actions_pi, log_prob = self.actor.action_log_prob(data.observations)
            log_prob = log_prob.reshape(-1, 1)
            mean = self.actor.action_dist.mode() if bc_coef > 0.0 else None  # +
            warming_up = self._n_updates + gradient_step < self.critic_warmup  # +

            if self.ent_coef_optimizer is not None and self.log_ent_coef is not None:
                # The coefficient of this step is that from before its update.
                ent_coef = th.exp(self.log_ent_coef.detach())
                assert isinstance(self.target_entropy, float)
                ent_coef_loss = -(
                    self.log_ent_coef * (log_prob + self.target_entropy).detach()
                ).mean()
                monitor(ent_coef_loss=ent_coef_loss)
                if not warming_up:
                    self.ent_coef_optimizer.zero_grad()
                    ent_coef_loss.backward()  # type: ignore[no-untyped-call]
                    self.ent_coef_optimizer.step()
            else:
                ent_coef = self.ent_coef_tensor
            monitor(ent_coef=ent_coef)

            with th.no_grad():
                next_actions, next_log_prob = self.actor.action_log_prob(data.next_observations)
                next_q = self._least_q(self.critic_target, data.next_observations, next_actions)
                next_values = next_q - ent_coef * next_log_prob.reshape(-1, 1)
                targets = data.rewards + (1 - data.dones) * discounts * next_values

            current = self.critic(data.observations, data.actions)
            critic_loss: Any = 0.5 * sum(F.mse_loss(q, targets) for q in current)
            monitor(critic_loss=critic_loss)
            if not np.isfinite(monitored["critic_loss"][-1]):  # +
                advice = (
                    "lower learning_rate, or look for rewards and observations that are not finite"
                )
                raise TrainingError(
                    f"the critic's loss is not finite after {self.num_timesteps} timesteps: {advice}"
                )
            self.critic.optimizer.zero_grad()
            critic_loss.backward()
            self.critic.optimizer.step()

            if not warming_up:  # +
                q_pi = self._least_q(self.critic, data.observations, actions_pi)
                actor_loss = (ent_coef * log_prob - q_pi).mean()
                monitor(actor_loss=actor_loss)
                if mean is not None and isinstance(data, ExpertReplaySamples):  # +
                    bc_loss, cloned = self._bc_loss(data.observations, mean, data.expert_actions)
                    actor_loss = actor_loss + bc_coef * q_pi.detach().abs().mean() * bc_loss
                    monitor(bc_loss=bc_loss, bc_share=cloned)
                self.actor.optimizer.zero_grad()
                own = [*self.actor.parameters()]
                actor_loss.backward(inputs=own)  # type: ignore[no-untyped-call]  # + the critic needs no gradient of this loss
                self.actor.optimizer.step()

            if gradient_step % self.target_update_interval == 0:
                polyak_update(self.critic.parameters(), self.critic_target.parameters(), self.tau)
                polyak_update(self.batch_norm_stats, self.batch_norm_stats_target, 1.0)

        self._n_updates += gradient_steps
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        for name, values in monitored.items():
            self.logger.record(f"train/{name}", np.mean(values))
        if self._clones:  # +
            self.logger.record("train/bc_coef", bc_coef)

    def _bc_loss(
        self, observations: Any, mean: th.Tensor, labels: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        """The cloning term over the mini-batch, and the share of its rows that are cloned; the
        others count as zero.

        :param mean: the policy's mean actions, (b, dim), as ``labels`` the expert's.
        """
        errors = cloning_errors(
            self.bc_loss, mean, mean, labels
        )  # no kind of error here needs log_std
        kept = th.ones_like(errors, dtype=th.bool)
        with th.no_grad():
            if self.bc_filter == "q":
                theirs, own = (
                    self._least_q(self.critic, observations, each) for each in (labels, mean)
                )
                kept = (theirs > own).flatten()
            elif self.bc_filter == "agreement":
                kept = agree(mean, labels)
        return (errors * kept).mean(), kept.float().mean()

    def _prepare_to_learn(self, anew: bool) -> None:
        if self.will_clone() and self.expert is None:
            raise ExpertError(
                "SACBC needs an expert: SACBC(..., expert='geometric') or model.set_expert(...)"
            )
        if anew or self._last_obs is None:  # the environments begin anew
            self._starts = self._labeller = None

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_labels", "_starts"]


def _normalise_layers(critic: ContinuousCritic) -> None:
    """Normalise what goes into each activation over its layer; nothing is learnt there, so a zip's
    names stay those of SAC.
    """
    networks: list[Any] = critic.q_networks
    for network in networks:
        for i, layer in enumerate([*network][:-1]):
            if isinstance(layer, nn.Linear):
                normal = nn.LayerNorm(layer.out_features, elementwise_affine=False)
                network[i + 1] = nn.Sequential(normal, network[i + 1])
