"""DAgger, data aggregation, as a Stable-Baselines3 algorithm (thesis 3.1.2, 4.2.1, Algorithm 3)."""

import secrets
from typing import Any

import numpy as np
import numpy.typing as npt
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.distributions import DiagGaussianDistribution
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from stable_baselines3.common.utils import FloatSchedule, explained_variance
from stable_baselines3.common.vec_env import VecEnv

from sb3_quad.algorithms.buffers import AggregatedDataset, sample_rows
from sb3_quad.algorithms.common import ExpertMixin, arguments_of, parameters_of_both
from sb3_quad.algorithms.networks.gradients import (
    Batch,
    gradients,
    mean_actions,
    network_of,
    state_values,
)
from sb3_quad.algorithms.networks.losses import CLONING_LOSSES, CloningLoss, Loss
from sb3_quad.base.arrays import Float32Array
from sb3_quad.base.errors import ConfigError, TrainingError, unknown
from sb3_quad.controllers.controller import Controller, true_state_of
from sb3_quad.simulation.unobserved import UNOBSERVED, unobserved

_VALUE_CHUNK = 16384  # observations that the critic evaluates at once after a rollout


class DAgger(ExpertMixin, OnPolicyAlgorithm):  # type: ignore[misc]
    """Data aggregation (DAgger): the agent flies, the expert says what it would have done, the
    agent learns that.

    In every control step and every environment, independently, the expert's action flies with
    probability β, else the agent's sampled action. Each visited observation joins a bounded dataset
    together with the expert's action for the state *before* the step. The actor learns from
    mini-batches of the dataset, the critic from the GAE returns of the rollout just flown. The loss
    is Eq. 4.3, with the sign of its entropy term put right (it prints +c_H H in a loss that is
    minimised; entropy is to be encouraged)::

        L_BC + l2_coef * 1/2 Σw² - ent_coef * H + vf_coef * value loss (Eq. 3.8)

    with Σw² over the weight matrices of both networks, without biases and log_std.

    For any environment with a Box action space and observations that are not a Dict. Papers:
    https://arxiv.org/abs/1011.0686 (DAgger); the study thesis STUD-512 (this form of it).

    A run is a function of its ``seed``: β, the agent's sampling and the mini-batches come from
    generators that are seeded by it and by the updates made so far, so a resumed run continues
    exactly as the uninterrupted one would have.

    Arguments that are not listed here mean what they mean in :class:`stable_baselines3.PPO`.
    ``learning_rate`` and ``clip_range_vf`` can be functions of the remaining progress (from 1 to
    0).

    :param policy: The policy model to use (MlpPolicy, CnnPolicy, ...). Unless ``policy_kwargs``
        holds ``log_std_init``, it begins at -2: sampled actions fly, and SB3's own 0 spreads them
        over the whole action space
    :param env: The environment to learn from (if registered in Gym, can be str)
    :param expert: Whose actions are learnt: an object with ``actions(state)`` such as
        ``GeometricExpert``, another SB3 model, or a function from observations to actions;
        :class:`~sb3_quad.controllers.controller.Controller` says what each is shown. Or a name as
        YAML takes it, such as ``"pid"``. It is never saved: give it to ``load`` again, or call
        :meth:`set_expert`, before learning continues
    :param batch_size: Minibatch size, in pairs of the dataset
    :param n_epochs: Passes of the critic over each rollout; and of the actor, over as many pairs as
        a rollout holds, unless ``gradient_steps`` says otherwise
    :param clip_range_vf: ε of the clipped value loss (Eq. 3.8). None: plain mean squared error
    :param ent_coef: Entropy coefficient c_H
    :param max_grad_norm: The maximum value for the gradient clipping, of actor and critic each by
        itself, so that a large error of the critic does not hold up the actor. None: no clipping
    :param gradient_steps: Optimiser steps after each rollout, at most one for each row of
        ``n_epochs`` passes over it. Each takes ``batch_size`` pairs of the dataset. None:
        ``n_epochs * ceil(n_steps * n_envs / batch_size)``, as in PPO. The critic takes part in as
        many of them as that, or in all if there are fewer, each with an equal share of its passes
    :param beta: β of the first rollout, from 0 to 1
    :param beta_decay: What β loses with every rollout
    :param beta_final: Where β stops falling
    :param bc_loss: ``"nll"``, Eq. 3.12, learns the standard deviation too; ``"mse"``, on the mean
        alone, leaves it to ``log_std_init`` and ``ent_coef``; so do ``"huber"``, squared up to 0.05
        and linear beyond, which is more exact where the expert is smooth, and ``"huber_mse"``, that
        and three times the squared error
    :param log_std_min: log_std never falls below this: under ``"nll"`` alone it collapses
    :param l2_coef: c_L2
    :param aux_coef: Weight of an auxiliary loss, "huber_mse": the first units of the last hidden
        layer but one learn, by tanh, to say what no observation shows,
        :data:`~sb3_quad.simulation.unobserved.UNOBSERVED`. 0: none
    :param dataset_capacity: Most pairs kept, the oldest leave first. 0: the current rollout only,
        as the thesis trains
    :param shuffle: whether mini-batches are random. False: consecutive in time, as the thesis
        prepares them ("chronologically", 4.2.3)
    :raises ConfigError: an argument out of range, or observations that are a Dict
    :raises ExpertError: an expert that does not fit the environment
    """

    policy_aliases = PPO.policy_aliases

    def __init__(
        self,
        policy: str | type[ActorCriticPolicy],
        env: GymEnv | str,
        expert: Any = None,
        learning_rate: float | Schedule = 1e-3,
        n_steps: int = 250,
        batch_size: int = 8192,
        n_epochs: int = 10,
        gamma: float = 0.998,
        gae_lambda: float = 0.95,
        clip_range_vf: float | Schedule | None = None,
        ent_coef: float = 0.0,
        vf_coef: float = 0.5,
        max_grad_norm: float | None = 0.5,
        gradient_steps: int | None = None,
        beta: float = 0.5,
        beta_decay: float = 0.001,
        beta_final: float = 0.3,
        bc_loss: CloningLoss = "mse",
        log_std_min: float = -3.0,
        l2_coef: float = 0.0,
        aux_coef: float = 0.0,
        dataset_capacity: int = 1_500_000,
        shuffle: bool = True,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ):
        given = {**locals(), "policy_kwargs": {"log_std_init": -2.0, **(policy_kwargs or {})}}
        fixed: dict[str, Any] = {
            "use_sde": False,
            "sde_sample_freq": -1,
            "supported_action_spaces": (spaces.Box,),
        }
        super().__init__(**arguments_of(OnPolicyAlgorithm, given), **fixed, _init_setup_model=False)
        self.batch_size = batch_size
        self.n_epochs = n_epochs
        self.gradient_steps = gradient_steps
        self.clip_range_vf = clip_range_vf
        self.beta = beta
        self.beta_decay = beta_decay
        self.beta_final = beta_final
        self.bc_loss: CloningLoss = bc_loss
        self.log_std_min = log_std_min
        self.l2_coef = l2_coef
        self.aux_coef = aux_coef
        self.dataset_capacity = dataset_capacity
        self.shuffle = shuffle
        self.expert: Any = None
        self._n_rollouts = 0
        self._entropy = secrets.randbits(63)  # what seeds the generators where no seed is given

        if expert is not None:
            self.set_expert(expert)
        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        if not 0.0 <= self.beta_final <= self.beta <= 1.0:
            raise ConfigError(
                f"beta {self.beta}: a probability, from beta_final {self.beta_final} to 1"
            )
        if self.bc_loss not in CLONING_LOSSES:
            raise ConfigError(unknown("bc_loss", self.bc_loss, CLONING_LOSSES))
        rollout = self.n_steps * self.n_envs
        if self.dataset_capacity != 0 and self.dataset_capacity < rollout:
            raise ConfigError(
                f"dataset_capacity {self.dataset_capacity}: must be 0 or at least n_steps * n_envs = {rollout}"
            )
        if self.gradient_steps is not None and self.gradient_steps < 1:
            raise ConfigError(f"gradient_steps {self.gradient_steps}: must be at least 1, or None")
        self._refuse_dict_observations()
        super()._setup_model()
        if not isinstance(self.policy.action_dist, DiagGaussianDistribution):
            raise ConfigError(
                f"policy {self.policy_class.__name__}: DAgger needs a diagonal Gaussian policy"
            )
        if self.clip_range_vf is not None:
            self.clip_range_vf = FloatSchedule(self.clip_range_vf)
        self._aux_layer = len(self.policy.mlp_extractor.policy_net) // 2 - 1 if self.aux_coef else 0
        if self.aux_coef and self._aux_layer < 1:
            raise ConfigError(f"aux_coef {self.aux_coef:g}: needs at least two hidden layers")
        dtype = self.rollout_buffer.observations.dtype
        self.dataset = AggregatedDataset(
            self.dataset_capacity or rollout,
            self.rollout_buffer.obs_shape,
            self.rollout_buffer.action_dim + (len(UNOBSERVED) if self._aux_layer else 0),
            np.float32 if np.issubdtype(dtype, np.floating) else dtype,
        )

    def set_expert(self, expert: Any) -> None:
        """Learn from ``expert`` from now on.

        :raises ExpertError: an expert that does not fit the environment
        """
        if self.env is not None:
            self._labeller = Controller.for_env(expert, self.env, self._labeller)
        self.expert = expert

    @property
    def current_beta(self) -> float:
        """β of the present rollout k: max(β_0 - k Δβ, β_final), Algorithm 3 line 8."""
        return max(self.beta - self.beta_decay * self._n_rollouts, self.beta_final)

    def set_beta(self, beta: float) -> None:
        """Let the expert fly with probability ``beta`` from the next rollout on, whatever
        ``beta_decay`` says.

        :raises ConfigError: a number below 0 or above 1
        """
        if not 0.0 <= beta <= 1.0:
            raise ConfigError(f"beta {beta}: a probability, from 0 to 1")
        self.beta = self.beta_final = float(beta)

    def _generator(self, purpose: int) -> np.random.Generator:
        """Random numbers for this rollout (0) or update (1): no state to save, and the same again
        after a resume.
        """
        return np.random.default_rng(
            [self._entropy if self.seed is None else self.seed, purpose, self._n_updates]
        )

    def collect_rollouts(
        self,
        env: VecEnv,
        callback: BaseCallback,
        rollout_buffer: RolloutBuffer,
        n_rollout_steps: int,
    ) -> bool:
        """Fly ``n_rollout_steps`` steps by the mixture of expert and agent, and add what was seen
        to the dataset.

        Fills ``rollout_buffer`` as SB3 does, but for ``log_probs``, which no loss here needs. The
        critic evaluates the whole rollout at the end, since it does not change before.
        """
        self.policy.set_training_mode(False)
        self._labeller = labeller = Controller.for_env(self.expert, env, self._labeller)  # +
        network, rng, beta = network_of(self.policy), self._generator(0), self.current_beta  # +
        n_envs, action_dim = env.num_envs, rollout_buffer.action_dim
        low, high = self.action_space.low.reshape(-1), self.action_space.high.reshape(-1)  # type: ignore[attr-defined]
        std = np.exp(self.policy.log_std.detach().cpu().numpy())
        labels = np.empty((n_rollout_steps, n_envs, action_dim), dtype=np.float32)  # +
        said: list[Float32Array] = []  # + what the auxiliary loss teaches
        true_state = true_state_of(env) if self._aux_layer else None
        not_yet = th.zeros(n_envs)  # the values, until the rollout is complete
        timeouts: list[
            tuple[int, int, npt.NDArray[Any]]
        ] = []  # step, environment, last observation
        n_by_expert = 0

        rollout_buffer.reset()
        callback.on_rollout_start()

        for step in range(n_rollout_steps):
            observations: Any = self._last_obs
            labels[step] = labeller.labels(
                observations, self._last_episode_starts
            )  # + of the state before the step
            said += [unobserved(true_state and true_state())] if self._aux_layer else []  # +
            means = mean_actions(network, observations)
            sampled = means + std * rng.standard_normal(means.shape, dtype=np.float32)
            by_expert = rng.random(n_envs) < beta  # +
            actions = np.where(by_expert[:, None], labels[step], sampled)
            clipped_actions = np.clip(actions, low, high).reshape(n_envs, *self.action_space.shape)  # type: ignore[misc]

            new_obs, rewards, dones, infos = env.step(clipped_actions)

            self.num_timesteps += n_envs
            n_by_expert += int(by_expert.sum())
            callback.update_locals(locals())
            if not callback.on_step():
                return False

            ended = np.flatnonzero(dones)
            self._update_info_buffer([infos[row] for row in ended], dones[ended])
            for row in ended:
                if (
                    infos[row].get("TimeLimit.truncated")
                    and infos[row].get("terminal_observation") is not None
                ):
                    timeouts.append((step, int(row), infos[row]["terminal_observation"]))

            rollout_buffer.add(
                observations, actions, rewards, self._last_episode_starts, not_yet, not_yet
            )  # type: ignore[arg-type]
            self._last_obs = new_obs  # type: ignore[assignment]
            self._last_episode_starts = dones

        flown = rollout_buffer.observations.reshape(-1, *rollout_buffer.obs_shape)
        chunks = (
            flown[first : first + _VALUE_CHUNK] for first in range(0, len(flown), _VALUE_CHUNK)
        )
        values = np.concatenate([state_values(network, chunk) for chunk in chunks])
        rollout_buffer.values = values.reshape(rollout_buffer.values.shape)
        # A time limit is no failure: what would have followed is worth V of the last observation
        if timeouts:
            steps, rows, last = zip(*timeouts, strict=True)
            rollout_buffer.rewards[list(steps), list(rows)] += self.gamma * state_values(
                network, np.stack(last)
            )
        last_values = th.from_numpy(state_values(network, new_obs))  # type: ignore[arg-type]
        rollout_buffer.compute_returns_and_advantage(last_values=last_values, dones=dones)

        if self.dataset_capacity == 0:  # +
            self.dataset.clear()
        targets = np.concatenate([labels, said], axis=2) if said else labels  # +
        self.dataset.add(flown, targets.reshape(len(flown), -1))  # +
        self._n_rollouts += 1

        self.logger.record("dagger/beta", beta)
        self.logger.record("dagger/dataset_size", len(self.dataset))
        self.logger.record("rollout/expert_fraction", n_by_expert / (n_rollout_steps * n_envs))
        callback.update_locals(locals())
        callback.on_rollout_end()
        return True

    def train(self) -> None:
        """Update the actor on the dataset and the critic on the rollout just flown.

        It is PPO's loop over mini-batches, with two of them in a step, and what differs marked by
        ``+``.

        :raises TrainingError: a loss or gradient that is not finite; the parameters stay those of
            the last good step
        """
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        clip_range_vf = (
            self.clip_range_vf(self._current_progress_remaining)
            if callable(self.clip_range_vf)
            else None
        )
        # + The loss of Eq. 4.3.
        loss = Loss(
            bc_coef=1.0,
            bc_loss=CLONING_LOSSES.index(self.bc_loss),
            vf_coef=self.vf_coef,
            clip_range_vf=np.inf if clip_range_vf is None else clip_range_vf,
            ent_coef=self.ent_coef,
            l2_coef=self.l2_coef,
            aux_coef=self.aux_coef,
            aux_layer=self._aux_layer,
        )
        network, (actor, critic) = network_of(self.policy), parameters_of_both(self.policy)

        # + Rows of the dataset for the actor, and of the rollout for the critic, which takes part
        # in every so many steps.
        buffer, rng = self.rollout_buffer, self._generator(1)
        n_rows = buffer.buffer_size * buffer.n_envs
        n_batches = self.gradient_steps or self.n_epochs * -(-n_rows // self.batch_size)
        n_batches = min(n_batches, self.n_epochs * n_rows)
        n_critic = min(self.n_epochs * -(-n_rows // self.batch_size), n_batches)
        actor_rows = sample_rows(
            len(self.dataset), n_batches * self.batch_size, rng, self.shuffle
        ).reshape(n_batches, -1)
        critic_rows = iter(
            np.array_split(sample_rows(n_rows, self.n_epochs * n_rows, rng, self.shuffle), n_critic)
        )
        flown = buffer.observations.reshape(n_rows, *buffer.obs_shape)
        targets = np.stack([buffer.values.reshape(-1), buffer.returns.reshape(-1)], axis=1)
        limit = float("inf") if self.max_grad_norm is None else self.max_grad_norm
        monitored: dict[str, list[float]] = {}  # by name: the term of each step

        for i, rows in enumerate(actor_rows):
            due = (i + 1) * n_critic // n_batches > i * n_critic // n_batches
            for_critic = Batch(next(critic_rows), flown, targets) if due else None
            terms = gradients(network, loss, self.dataset.batch(rows), for_critic)
            if not due:
                for parameter in critic:
                    parameter.grad = None
            # Clip grad norm, + of actor and critic each by itself
            norms = [
                th.nn.utils.clip_grad_norm_(group, limit)
                for group in ((actor, critic) if due else (actor,))
            ]
            if not np.isfinite([*terms.values(), *map(float, norms)]).all():  # +
                self.policy.optimizer.zero_grad()
                raise TrainingError(
                    f"training diverged at {self.num_timesteps} timesteps (cloning loss {terms['bc_loss']:.3g}, value loss "
                    f"{terms.get('value_loss', 0.0):.3g}); lower learning_rate, or look for rewards and observations that are "
                    "not finite"
                )
            self.policy.optimizer.step()
            self.policy.log_std.data.clamp_(min=self.log_std_min)  # +
            self._n_updates += 1
            for name, term in terms.items():
                monitored.setdefault(name, []).append(term)

        for name, values in monitored.items():
            self.logger.record(f"train/{name}", float(np.mean(values)))
        self.logger.record("train/std", th.exp(self.policy.log_std).mean().item())
        self.logger.record(
            "train/explained_variance",
            explained_variance(buffer.values.flatten(), buffer.returns.flatten()),
        )
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        if clip_range_vf is not None:
            self.logger.record("train/clip_range_vf", clip_range_vf)

    def _prepare_to_learn(self, anew: bool) -> None:
        self.set_expert(self.expert)
        if anew:  # β begins anew; the dataset stays until ``dataset.clear()``
            self._n_rollouts = 0

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "dataset", "_aux_layer"]
