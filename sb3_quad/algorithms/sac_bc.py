"""Soft actor-critic that also clones an expert: a value-based stage two."""

import math
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import polyak_update
from stable_baselines3.sac.policies import SACPolicy
from torch import nn
from torch.nn import functional as F
from typing_extensions import Self

from sb3_quad.agents.expert_like import ExpertLike
from sb3_quad.algorithms.common import ExpertMixin, History, policy_arguments
from sb3_quad.algorithms.networks.losses import (
    BC_FILTERS,
    CLONING_LOSSES,
    CloningFilter,
    CloningLoss,
    agree,
    cloning_errors,
)
from sb3_quad.algorithms.transfer import model_of
from sb3_quad.base.errors import ConfigError, refuse_unknown
from sb3_quad.base.types import AnyArray, Float32Array, StrDict, StrPath

_STOCK_BUFFERS = (None, ReplayBuffer, NStepReplayBuffer, DictReplayBuffer)


class SACBC(ExpertMixin, SAC):
    """Soft Actor-Critic with a cloning term in the actor's loss (SAC+BC).

    All arguments of :class:`stable_baselines3.SAC` keep their meaning and defaults. With the
    additions at their defaults it is SAC, bit for bit. A saved model loads with ``SAC.load``, even
    where this package is not installed. For any environment with a Box action space.

    The additions and their sources:

    - ``critic_layer_norm``: layer-normalised critics, which overestimate unseen actions less: RLPD,
      https://arxiv.org/abs/2302.02948
    - ``bc_coef``: a cloning term in the actor's loss: Nair et al.,
      https://arxiv.org/abs/1709.10089; weighted by the mean absolute Q as in TD3+BC,
      https://arxiv.org/abs/2106.06860. The expert labels every visited state, as in DAgger, not
      only those of its own flights
    - ``bc_filter="q"``: only where the critic prefers the expert's action: the Q filter of Nair et
      al.

    :param expert: what labels the states: an object with ``actions(state)`` on the true state of
        our environments, an SB3 model, or a function from observations to actions; or a name, as in
        YAML, such as ``"pid"``. It is never saved. Needed when learning starts with cloning.
    :param initial_policy: the agent to start from: a model, the path of a zip, or the name of a
        shipped agent. A SAC agent passes on all its weights, and its ``net_arch``,
        ``activation_fn`` and features extractor unless ``policy_kwargs`` gives them. The actor
        imitates any other agent.
    :param bc_coef: weight of the cloning term in units of the mean absolute Q: a float, or a
        schedule of the remaining progress.
    :param bc_loss: error of the policy's mean action: ``"mse"``, squared; ``"huber"``, quadratic up
        to 0.05 and linear beyond; ``"huber_mse"``, the same plus three times the squared error.
        Actions are scaled to [-1, 1], as the policy's are.
    :param bc_filter: where to clone: ``"none"``, everywhere; ``"q"``, where Q of the expert's
        action is greater than Q of the policy's mean action; ``"agreement"``, where both differ by
        less than 0.3, as for :class:`PPOBC`.
    :param critic_warmup: for this many gradient steps only the critic learns, so that an untrained
        critic does not spoil an actor that comes from imitation.
    :param critic_layer_norm: whether the critics normalise the inputs of their activations, without
        parameters. Stock ``SAC`` loads the zip with the same actor, but its critics do not
        normalise.
    :raises ConfigError: on construction: a value out of range, an unknown name, or a space that is
        not supported.
    :raises ExpertError: when learning starts: no expert, or one whose labels do not fit.
    :raises TrainingError: a loss that is not finite.
    """

    _not_saved = ("_scaled_labels",)

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
        replay_buffer_kwargs: StrDict | None = None,
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
        policy_kwargs: StrDict | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        *,
        expert: ExpertLike | None = None,
        initial_policy: BaseAlgorithm | StrPath | None = None,
        bc_coef: float | Schedule = 0.0,
        bc_loss: CloningLoss = "mse",
        bc_filter: CloningFilter = "none",
        critic_warmup: int = 0,
        critic_layer_norm: bool = False,
        _init_setup_model: bool = True,
    ):
        initial = model_of(initial_policy)
        if getattr(initial, "critic_layer_norm", False) and not critic_layer_norm:
            raise ConfigError(
                "initial_policy: its critics normalise their layers; give critic_layer_norm=True"
            )
        super().__init__(
            policy,
            env,
            learning_rate,
            buffer_size=buffer_size,
            learning_starts=learning_starts,
            batch_size=batch_size,
            tau=tau,
            gamma=gamma,
            train_freq=train_freq,
            gradient_steps=gradient_steps,
            action_noise=action_noise,
            replay_buffer_class=replay_buffer_class,
            replay_buffer_kwargs=replay_buffer_kwargs,
            optimize_memory_usage=optimize_memory_usage,
            n_steps=n_steps,
            ent_coef=ent_coef,
            target_update_interval=target_update_interval,
            target_entropy=target_entropy,
            use_sde=use_sde,
            sde_sample_freq=sde_sample_freq,
            use_sde_at_warmup=use_sde_at_warmup,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_arguments(policy_kwargs, initial, OffPolicyAlgorithm),
            verbose=verbose,
            seed=seed,
            device=device,
            _init_setup_model=False,
        )
        self.expert = expert
        self.bc_coef = bc_coef
        self.bc_loss = bc_loss
        self.bc_filter = bc_filter
        self.critic_warmup = critic_warmup
        self.critic_layer_norm = critic_layer_norm
        self._clones = False
        # The expert's scaled actions for the present states, (n_envs, action_dim)
        self._scaled_labels: Float32Array | None = None

        if _init_setup_model:
            self._set_up(initial)

    def _setup_model(self) -> None:
        # The negative log-likelihood is not meaningful for tanh-squashed actions.
        kinds = [name for name in CLONING_LOSSES if name != "nll"]
        refuse_unknown("bc_loss", [self.bc_loss], kinds)
        refuse_unknown("bc_filter", [self.bc_filter], BC_FILTERS)
        if isinstance(self.observation_space, spaces.Dict) and self.n_steps > 1:
            raise ConfigError(
                f"n_steps {self.n_steps}: Stable-Baselines3 has no n-step returns for Dict"
                " observations; give 1"
            )
        self._check_arguments()
        self._clones = super().will_clone()
        if self._clones and self.replay_buffer_class not in _STOCK_BUFFERS:
            raise ConfigError(
                f"replay_buffer_class {self.replay_buffer_class}: has no room for the expert's"
                " actions"
            )
        super()._setup_model()
        if self._clones:
            # An action is stored with the expert's action appended, so that SB3 always samples
            # both.
            buffer: Any = self.replay_buffer
            buffer.action_dim *= 2
            buffer.actions = np.zeros((*buffer.actions.shape[:2], buffer.action_dim), np.float32)
        if self.critic_layer_norm:
            _normalise_layers(self.critic)
            _normalise_layers(self.critic_target)

    @property
    def policy_is_idle(self) -> bool:
        """Whether only the critic has learnt so far (``critic_warmup``)."""
        return 0 < self.critic_warmup >= self._n_updates

    def will_clone(self) -> bool:
        """Return whether the expert is needed, which is decided when the replay buffer is built."""
        return self._clones

    def load_replay_buffer(self, path: Any, truncate_last_traj: bool = True) -> None:
        """Load a replay buffer by SB3's ``load_replay_buffer``.

        :raises ConfigError: the buffer has expert actions and this model does not clone, or the
            reverse; the present buffer is kept.
        """
        present: Any = self.replay_buffer
        super().load_replay_buffer(path, truncate_last_traj)
        loaded: Any = self.replay_buffer
        if loaded.action_dim != present.action_dim:
            self.replay_buffer = present
            raise ConfigError(
                f"replay buffer {path}: has {loaded.action_dim} numbers for each action, must have"
                f" {present.action_dim}; where bc_coef is above 0, the expert's are among them"
            )

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "SACBC",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """Train for ``total_timesteps``; all arguments are those of SB3's ``SAC.learn``.

        :raises ExpertError: no expert where one is needed, or one that does not fit.
        """
        if self.will_clone():
            self._check_expert()
        return super().learn(
            total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar
        )

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[AnyArray, AnyArray]:
        # Label before the step: an expert that reads the true state must see the present one.
        if self._clones:
            assert self.env is not None
            labels = self._labels(self.env)
            shape = self.action_space.shape
            scaled: Any = self.policy.scale_action(labels.reshape(n_envs, *shape))
            self._scaled_labels = scaled.reshape(n_envs, -1)
        return super()._sample_action(learning_starts, action_noise, n_envs)

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: AnyArray,
        new_obs: Any,
        reward: AnyArray,
        dones: AnyArray,
        infos: list[StrDict],
    ) -> None:
        if self._scaled_labels is not None:
            flown = buffer_action.reshape(self._scaled_labels.shape)
            buffer_action = np.hstack([flown, self._scaled_labels])
        self._last_episode_starts = dones
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)

    @staticmethod
    def _least_q(critic: Any, observations: Any, actions: th.Tensor) -> th.Tensor:
        """Return the smallest of the critics' values, (b, 1)."""
        return th.cat(critic(observations, actions), dim=1).min(dim=1, keepdim=True).values

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """Update on the replay buffer as SAC does. Additions are marked with ``+``.

        Kept in one piece and in SB3's order, so that the two can be compared line by line.
        """
        assert self.replay_buffer is not None
        self.policy.set_training_mode(True)
        optimizers = [self.actor.optimizer, self.critic.optimizer]
        if self.ent_coef_optimizer is not None:
            optimizers += [self.ent_coef_optimizer]
        self._update_learning_rate(optimizers)
        # + Weight of the cloning term in this update
        bc_coef = self.bc_coef(max(self._current_progress_remaining, 0.0))
        if bc_coef > 0.0 and not self._clones:
            raise ConfigError(
                f"bc_coef {bc_coef:g}: this model was built without cloning, and its replay buffer"
                " holds no expert actions; build or load it with a bc_coef above 0"
            )
        # The terms of each gradient step, by name
        history: History = {}

        def log(name: str, value: th.Tensor) -> None:
            history.setdefault(name, []).append(value.item())

        for gradient_step in range(gradient_steps):
            # Sample the replay buffer, + with the expert's actions if there are any
            data: Any = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)
            actions, *labels = data.actions.split(get_action_dim(self.action_space), dim=1)
            discounts = data.discounts if data.discounts is not None else self.gamma
            if self.use_sde:
                self.actor.reset_noise()

            actions_pi, log_prob = self.actor.action_log_prob(data.observations)
            log_prob = log_prob.reshape(-1, 1)
            # + The deterministic actions, before the distribution is replaced by that of the next
            # states
            mean = self.actor.action_dist.mode() if bc_coef > 0.0 else None
            warming_up = self._n_updates + gradient_step < self.critic_warmup  # +

            if self.ent_coef_optimizer is not None and self.log_ent_coef is not None:
                # This step uses the coefficient from before its update.
                ent_coef = th.exp(self.log_ent_coef.detach())
                assert isinstance(self.target_entropy, float)
                ent_coef_loss = -(
                    self.log_ent_coef * (log_prob + self.target_entropy).detach()
                ).mean()
                log("ent_coef_loss", ent_coef_loss)
                if not warming_up:
                    self.ent_coef_optimizer.zero_grad()
                    ent_coef_loss.backward()  # type: ignore[no-untyped-call]
                    self.ent_coef_optimizer.step()
            else:
                ent_coef = self.ent_coef_tensor
            log("ent_coef", ent_coef)

            # The Bellman backup: entropy of the next action included
            with th.no_grad():
                next_actions, next_log_prob = self.actor.action_log_prob(data.next_observations)
                next_q = self._least_q(self.critic_target, data.next_observations, next_actions)
                next_values = next_q - ent_coef * next_log_prob.reshape(-1, 1)
                targets = data.rewards + (1 - data.dones) * discounts * next_values

            # Critic loss
            current = self.critic(data.observations, actions)
            critic_loss: Any = 0.5 * sum(F.mse_loss(q, targets) for q in current)
            log("critic_loss", critic_loss)
            if not np.isfinite(history["critic_loss"][-1]):  # +
                raise self._diverged({"critic_loss": math.nan})
            self.critic.optimizer.zero_grad()
            critic_loss.backward()
            self.critic.optimizer.step()

            # Actor loss, + unless only the critic learns
            if not warming_up:
                q_pi = self._least_q(self.critic, data.observations, actions_pi)
                actor_loss = (ent_coef * log_prob - q_pi).mean()
                log("actor_loss", actor_loss)
                if mean is not None and labels:  # +
                    bc_loss, bc_share = self._bc_loss(data.observations, mean, labels[0])
                    actor_loss = actor_loss + bc_coef * q_pi.detach().abs().mean() * bc_loss
                    log("bc_loss", bc_loss)
                    log("bc_share", bc_share)
                self.actor.optimizer.zero_grad()
                # + The critic needs no gradient of this loss.
                actor_loss.backward(inputs=[*self.actor.parameters()])  # type: ignore[no-untyped-call]
                self.actor.optimizer.step()

            # Update target networks
            if gradient_step % self.target_update_interval == 0:
                polyak_update(self.critic.parameters(), self.critic_target.parameters(), self.tau)
                polyak_update(self.batch_norm_stats, self.batch_norm_stats_target, 1.0)

        self._n_updates += gradient_steps
        self._log_update(history)
        if self._clones:  # +
            self.logger.record("train/bc_coef", bc_coef)

    def _bc_loss(
        self, observations: Any, mean: th.Tensor, labels: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        """Return the cloning term over the mini-batch, and the share of its rows that are cloned.

        Rows that are not cloned count as zero.

        :param mean: the policy's mean actions, (b, action_dim).
        :param labels: the expert's, likewise.
        """
        # None of the losses that SACBC allows reads log_std, so that any tensor will do.
        errors = cloning_errors(self.bc_loss, mean, mean, labels)
        kept = th.ones_like(errors, dtype=th.bool)
        with th.no_grad():
            if self.bc_filter == "q":
                q_expert = self._least_q(self.critic, observations, labels)
                q_policy = self._least_q(self.critic, observations, mean)
                kept = (q_expert > q_policy).flatten()
            elif self.bc_filter == "agreement":
                kept = agree(mean, labels)
        return (errors * kept).mean(), kept.float().mean()


def _normalise_layers(critic: Any) -> None:
    """Normalise the inputs of each activation over its layer.

    The normalisation has no parameters, so the names in a zip stay SAC's.
    """
    for network in critic.q_networks:
        for i, layer in enumerate([*network][:-1]):
            if isinstance(layer, nn.Linear):
                normal = nn.LayerNorm(layer.out_features, elementwise_affine=False)
                network[i + 1] = nn.Sequential(normal, network[i + 1])
