"""Soft actor-critic that also learns from an expert: a value-based stage two."""

from typing import Any

import numpy as np
import numpy.typing as npt
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.type_aliases import GymEnv, ReplayBufferSamples, Schedule
from stable_baselines3.common.utils import FloatSchedule, polyak_update
from stable_baselines3.sac.policies import SACPolicy
from torch import nn
from torch.nn import functional as F

from sb3_quad.algorithms.buffers import ExpertNStepReplayBuffer, ExpertReplayBuffer, ExpertReplaySamples
from sb3_quad.algorithms.common import ExpertMixin, is_ever_nonzero
from sb3_quad.algorithms.networks.losses import CloningLoss, agree, cloning_errors
from sb3_quad.base.arrays import Arrays, BoolArray, Float32Array
from sb3_quad.base.errors import ConfigError, ExpertError, TrainingError, unknown
from sb3_quad.controllers.controller import Controller

BC_LOSSES: tuple[CloningLoss, ...] = ("mse", "huber", "huber_mse")
BC_FILTERS = ("none", "q", "agreement")
LABELS = "labels"  # in the state of the expert: its actions for the present states


class SACBC(ExpertMixin, SAC):  # type: ignore[misc]
    """Soft Actor-Critic with an expert (SAC+BC): its transitions, its actions and its proposals, each a switch of its own.

    All arguments of :class:`stable_baselines3.SAC` keep their meaning and defaults. With the additions at their defaults it is
    SAC, bit for bit. A saved model loads with ``SAC.load``, even where this package is not installed. For any environment with
    a Box action space; with an addition, observations that are no Dict.

    What is added, with its source:

    =====================  ============================================================================================
    ``expert_fraction``    a share of each mini-batch from the expert's own flights: RLPD, https://arxiv.org/abs/2302.02948
    ``critic_layer_norm``  layer-normalised critics, which overestimate unseen actions less: RLPD
    ``bc_coef``            a cloning term in the actor's loss: Nair et al., https://arxiv.org/abs/1709.10089; weighed by
                           the mean absolute Q as in TD3+BC, https://arxiv.org/abs/2106.06860. The expert labels every
                           state that is visited, as in DAgger, not its own flights alone
    ``bc_filter="q"``      only where the critic prefers the expert's action: the Q filter of Nair et al.
    ``expert_proposal``    the expert's action and the agent's are both proposed, and the one of greater Q is flown, and
                           bootstrapped from: IBRL, https://arxiv.org/abs/2311.02198
    =====================  ============================================================================================

    :param expert: who flies first, labels and proposes: an object with ``actions(state)`` on the true state of our
        environments, an SB3 model, or a function from observations to actions. It is never saved. Needed when learning starts
        with any of the additions.
    :param expert_timesteps: the first timesteps of the training, over all environments, which the expert flies; nothing is
        learnt meanwhile. They are kept in a buffer of their own, ``expert_buffer``. Random actions follow only if
        ``learning_starts`` is more than that.
    :param expert_fraction: the share of each mini-batch that comes from ``expert_buffer``, 0 to 1 (RLPD: a half).
    :param bc_coef: weight of the cloning term in units of the mean absolute Q: a float, or a schedule of the remaining
        progress.
    :param bc_loss: error of the policy's mean action: ``"mse"``, squared; ``"huber"``, linear beyond 0.05;
        ``"huber_mse"``, that and three times the squared error. Actions are those of the policy, within -1 and 1.
    :param bc_filter: where to clone: ``"none"``, everywhere; ``"q"``, where Q of the expert's action is greater than Q of the
        policy's mean action; ``"agreement"``, where both differ by less than 0.3, as of :class:`PPOBC`.
    :param expert_proposal: whether the expert's action is proposed beside the agent's. Needs ``n_steps=1``.
    :param critic_warmup: for this many gradient steps only the critic learns, so that an actor that comes from imitation is
        not moved by a critic that has learnt nothing yet.
    :param critic_layer_norm: whether the critics normalise the inputs of their activations, without parameters: in stock
        ``SAC`` the zip loads and its actor is the same, but its critics do not normalise.
    :raises ConfigError: a value out of range, a name that is not known, or a space that is not supported, when built.
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
        expert_timesteps: int = 0,
        expert_fraction: float = 0.0,
        bc_coef: float | Schedule = 0.0,
        bc_loss: CloningLoss = "mse",
        bc_filter: str = "none",
        expert_proposal: bool = False,
        critic_warmup: int = 0,
        critic_layer_norm: bool = False,
        _init_setup_model: bool = True,
    ):
        super().__init__(
            policy,
            env,
            learning_rate=learning_rate,
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
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            seed=seed,
            device=device,
            _init_setup_model=False,
        )
        for name, value, valid in (("bc_loss", bc_loss, BC_LOSSES), ("bc_filter", bc_filter, BC_FILTERS)):
            if value not in valid:
                raise ConfigError(unknown(name, value, valid))
        if not 0.0 <= expert_fraction <= 1.0:
            raise ConfigError(f"expert_fraction is {expert_fraction}, must be from 0 to 1")
        if expert_fraction > 0.0 and expert_timesteps == 0:
            raise ConfigError(f"expert_fraction is {expert_fraction}, but expert_timesteps is 0: the expert has flown nothing")
        self.expert = expert
        self.expert_timesteps = expert_timesteps
        self.expert_fraction = expert_fraction
        self.bc_coef = bc_coef
        self.bc_loss: CloningLoss = bc_loss
        self.bc_filter = bc_filter
        self.expert_proposal = expert_proposal
        self.critic_warmup = critic_warmup
        self.critic_layer_norm = critic_layer_norm
        self._clones = False
        self.expert_buffer: ReplayBuffer | None = None
        self._labels: Float32Array | None = None  # (n_envs, action_dim): its scaled actions for the present states

        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        self.bc_coef = FloatSchedule(self.bc_coef)
        self._clones = is_ever_nonzero(self.bc_coef)
        if self.will_clone():
            self._refuse_dict_observations()
        if self.expert_proposal and self.n_steps != 1:
            raise ConfigError(f"expert_proposal needs n_steps 1, not {self.n_steps}: it proposes for the next state")
        if self._clones or self.expert_proposal:
            if self.replay_buffer_class not in (None, ReplayBuffer, NStepReplayBuffer):
                raise ConfigError(f"replay_buffer_class {self.replay_buffer_class}: has no room for the expert's actions")
            self.replay_buffer = self._new_buffer(self.buffer_size)
        super()._setup_model()
        if self.critic_layer_norm:
            _normalise_layers(self.critic)
            _normalise_layers(self.critic_target)
        if self.expert_timesteps > 0:
            self.expert_buffer = self._new_buffer(-(-self.expert_timesteps // self.n_envs) * self.n_envs)

    def _new_buffer(self, size: int) -> ReplayBuffer:
        """SB3's replay buffer, with the expert's actions beside those flown where they are used."""
        kind, keywords = self.replay_buffer_class or ReplayBuffer, {**self.replay_buffer_kwargs}
        if self._clones or self.expert_proposal:
            kind = ExpertReplayBuffer if self.n_steps == 1 else ExpertNStepReplayBuffer
            keywords |= {} if self.n_steps == 1 else {"n_steps": self.n_steps, "gamma": self.gamma}
        arguments = size, self.observation_space, self.action_space, self.device, self.n_envs, self.optimize_memory_usage
        return kind(*arguments, **keywords)

    @property
    def expert_flies(self) -> bool:
        """Whether the training is still in its first ``expert_timesteps``."""
        return self.expert_buffer is not None and not self.expert_buffer.full

    @property
    def policy_is_idle(self) -> bool:
        """Whether the policy is still the one that it began with, since only the critic has learnt (``critic_warmup``)."""
        return 0 < self.critic_warmup >= self._n_updates

    def will_clone(self) -> bool:
        """Whether the expert is needed at all, for whichever of the additions."""
        return self._clones or self.expert_proposal or self.expert_timesteps > 0

    @property
    def _needs_labels(self) -> bool:
        """Whether the expert is asked about the present states."""
        return self._clones or self.expert_proposal or self.expert_flies

    def _ask(self, observation: Any, episode_start: BoolArray | None) -> Float32Array:
        """The expert's actions for the present states, scaled to -1 to 1 as a replay buffer holds actions: (n_envs, dim)."""
        assert self.env is not None
        self._labeller = Controller.for_env(self.expert, self.env, self._labeller)
        labels = self._labeller.labels(observation, episode_start)
        scaled = self.policy.scale_action(labels.reshape(-1, *self.action_space.shape))  # type: ignore[misc]
        return np.asarray(scaled, dtype=np.float32).reshape(len(labels), -1)

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
        shape = (n_envs, *self.action_space.shape)  # type: ignore[misc]
        if self._labels is None and self._needs_labels:
            self._labels = self._ask(self._last_obs, None)
        if self.expert_flies:
            assert self._labels is not None
            scaled = self._labels.reshape(shape)
            return self.policy.unscale_action(scaled), scaled
        action, scaled = super()._sample_action(learning_starts, action_noise, n_envs)
        if not self.expert_proposal or self.num_timesteps < learning_starts:
            return action, scaled
        assert self._labels is not None
        own, theirs = (th.as_tensor(each.reshape(n_envs, -1), device=self.device) for each in (scaled, self._labels))
        with th.no_grad():
            observations, _ = self.policy.obs_to_tensor(self._last_obs)  # type: ignore[arg-type]
            better = self._least_q(self.critic_target, observations, theirs) > self._least_q(
                self.critic_target, observations, own
            )
        chosen = th.where(better, theirs, own).cpu().numpy().reshape(shape)
        self.logger.record_mean("rollout/expert_fraction", float(better.float().mean()))
        return self.policy.unscale_action(chosen), chosen

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: npt.NDArray[Any],
        new_obs: Any,
        reward: npt.NDArray[Any],
        dones: npt.NDArray[Any],
        infos: list[dict[str, Any]],
    ) -> None:
        buffer = self.expert_buffer if self.expert_flies and self.expert_buffer is not None else replay_buffer
        if self._labels is not None:
            following = self._ask(new_obs, dones)
            if isinstance(buffer, ExpertReplayBuffer):
                buffer.label(self._labels, following, ~dones)  # the expert cannot see the state in which an episode has ended
            self._labels = following
        super()._store_transition(buffer, buffer_action, new_obs, reward, dones, infos)
        if not self._needs_labels:
            self._labels = None

    def _sample(self, batch_size: int) -> ReplayBufferSamples | ExpertReplaySamples:
        """A mini-batch, of which ``expert_fraction`` comes from the expert's own flights."""
        n_expert = round(batch_size * self.expert_fraction)
        buffers = [(self.replay_buffer, batch_size - n_expert), (self.expert_buffer, n_expert)]
        parts = [buffer.sample(n, env=self._vec_normalize_env) for buffer, n in buffers if buffer is not None and n > 0]
        joined: list[Any] = [None if column[0] is None else th.cat(column) for column in zip(*parts, strict=True)]
        return parts[0] if len(parts) == 1 else type(parts[0])(*joined)

    @staticmethod
    def _least_q(critic: Any, observations: Any, actions: th.Tensor) -> th.Tensor:
        """The least of the critics' values, (b, 1)."""
        return th.cat(critic(observations, actions), dim=1).min(dim=1, keepdim=True).values

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """Updates on the replay buffer: SAC's loop, with what is added to it marked by ``+``."""
        if self.replay_buffer is None or self.replay_buffer.size() == 0:  # + the expert flies
            return
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
            data = self._sample(batch_size)  # + from both buffers, with the expert's actions
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
                ent_coef_loss = -(self.log_ent_coef * (log_prob + self.target_entropy).detach()).mean()
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
                if self.expert_proposal and isinstance(data, ExpertReplaySamples):  # + where there is one and it is better
                    proposed = self._least_q(self.critic_target, data.next_observations, data.next_expert_actions)
                    next_values = th.where(data.next_is_labelled & (proposed > next_q), proposed, next_values)
                targets = data.rewards + (1 - data.dones) * discounts * next_values

            current = self.critic(data.observations, data.actions)
            critic_loss: Any = 0.5 * sum(F.mse_loss(q, targets) for q in current)
            monitor(critic_loss=critic_loss)
            if not np.isfinite(monitored["critic_loss"][-1]):  # +
                advice = "lower learning_rate, or look for rewards and observations that are not finite"
                raise TrainingError(f"the critic's loss is not finite after {self.num_timesteps} timesteps: {advice}")
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

    def _bc_loss(self, observations: Any, mean: th.Tensor, labels: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """The cloning term over the mini-batch, and the share of its rows that are cloned; the others count as zero.

        :param mean: the policy's mean actions, (b, dim), as ``labels`` the expert's.
        """
        errors = cloning_errors(self.bc_loss, mean, mean, labels)  # no kind of error here needs log_std
        kept = th.ones_like(errors, dtype=th.bool)
        with th.no_grad():
            if self.bc_filter == "q":
                theirs, own = (self._least_q(self.critic, observations, each) for each in (labels, mean))
                kept = (theirs > own).flatten()
            elif self.bc_filter == "agreement":
                kept = agree(mean, labels)
        return (errors * kept).mean(), kept.float().mean()

    def _prepare_to_learn(self, anew: bool) -> None:
        if self.will_clone() and self.expert is None:
            raise ExpertError("SACBC needs an expert: SACBC(..., expert=GeometricExpert()) or model.set_expert(...)")
        if anew or self._last_obs is None:  # the environments begin anew
            self._labels = self._labeller = None

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "expert_buffer", "_labels"]

    def expert_state(self) -> Arrays:
        """As of any algorithm with an expert, and its actions for the present states."""
        return super().expert_state() | ({} if self._labels is None else {LABELS: self._labels})

    def restore_expert_state(self, state: Arrays) -> None:
        self._labels = state.get(LABELS)
        super().restore_expert_state({name: array for name, array in state.items() if name != LABELS})


def _normalise_layers(critic: ContinuousCritic) -> None:
    """Normalise what goes into each activation over its layer; nothing is learnt there, so a zip's names stay those of SAC."""
    networks: list[Any] = critic.q_networks
    for network in networks:
        for i, layer in enumerate([*network][:-1]):
            if isinstance(layer, nn.Linear):
                normal = nn.LayerNorm(layer.out_features, elementwise_affine=False)
                network[i + 1] = nn.Sequential(normal, network[i + 1])
