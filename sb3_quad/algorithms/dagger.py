"""DAgger, data aggregation, as a Stable-Baselines3 algorithm (thesis 3.1.2, 4.2.1, Algorithm 3)."""

import math
import secrets
from typing import Any, cast

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.distributions import DiagGaussianDistribution
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback
from stable_baselines3.common.utils import FloatSchedule, LinearSchedule
from stable_baselines3.common.vec_env import VecEnv
from torch.nn import functional as F
from typing_extensions import Self

from sb3_quad.algorithms.buffers import (
    AggregatedDataset,
    Batch,
    ExpertRolloutBuffer,
    sample_rows,
)
from sb3_quad.algorithms.chain import limits_of, statistics_of
from sb3_quad.algorithms.common import (
    ExpertMixin,
    History,
    RateOrSchedule,
    WeightOrSchedule,
    actor_and_critic_parameters,
    model_of,
    policy_arguments,
)
from sb3_quad.algorithms.labelling import ExpertLike, refuse_wide_actions
from sb3_quad.algorithms.losses import (
    CloningLoss,
    Loss,
    cloning_errors,
    l2_loss,
    max_clipped_value_loss,
)
from sb3_quad.algorithms.networks import network_of
from sb3_quad.base.errors import ConfigError, ExpertError
from sb3_quad.base.types import StrDict, StrPath
from sb3_quad.base.validate import Count, Natural, Share, Weight, check

# Observations that the critic evaluates at once after a rollout
_VALUE_CHUNK = 16384
# log_std never falls below this; with bc_loss="nll" alone it would collapse.
LOG_STD_MIN = -3.0


class DAgger(ExpertMixin, OnPolicyAlgorithm):
    """Data aggregation (DAgger): the agent flies, and learns what the expert would have done.

    In every control step, each environment independently flies the expert's action with probability
    β, and otherwise an action sampled from the agent's policy. Each visited observation joins a
    bounded dataset together with the expert's action for the state *before* the step. The actor
    learns from mini-batches of the dataset, the critic from the GAE returns of the rollout just
    flown. The loss is Eq. 4.3, with the sign of its entropy term corrected (the thesis prints +c_H
    H in a loss that is minimised, although entropy is to be encouraged)::

        L_BC + l2_coef * 1/2 Σw² - ent_coef * H + vf_coef * value loss (Eq. 3.8)

    with Σw² over the weight matrices of both networks, without biases and log_std.

    For any environment with actions in a Box within [-1, 1] and observations that are not a Dict;
    wrap others in ``gymnasium.wrappers.RescaleAction``. Papers: https://arxiv.org/abs/1011.0686
    (DAgger); the study thesis STUD-512 (this variant).

    A run is determined by its ``seed``: the choice of who flies, the agent's samples and the
    mini-batches come from generators seeded with it and with the number of updates made so far. A
    resumed run therefore continues exactly as the uninterrupted one would have.

    The defaults are those that we recommend for hundreds of quadcopters at once; Table A.4 of the
    thesis is ``zoo_configs/thesis/dagger.yml``. Arguments that are not listed here mean what they
    mean in :class:`stable_baselines3.PPO`. ``learning_rate`` and ``clip_range_vf`` can be functions
    of the remaining progress (from 1 to 0).

    :param policy: The policy model to use (MlpPolicy, CnnPolicy, ...). ``log_std`` begins at -2,
        or at the initial policy's, unless ``policy_kwargs`` has a ``log_std_init``: the agent flies
        sampled actions, which SB3's default of 0 would spread over the whole action space
    :param env: The environment to learn from (if registered in Gym, can be str)
    :param batch_size: Minibatch size, in pairs of the dataset; the whole dataset while it is
        smaller
    :param n_epochs: Passes of the critic over each rollout; and of the actor, over as many pairs as
        a rollout holds, unless ``gradient_steps`` says otherwise
    :param clip_range_vf: ε of the clipped value loss (Eq. 3.8). None: plain mean squared error
    :param ent_coef: Entropy coefficient c_H
    :param max_grad_norm: The maximum norm of the gradient, clipped separately for actor and critic,
        so that a large error of the critic does not slow down the actor
    :param expert: What labels the states: an object with ``actions(state)`` such as
        ``GeometricExpert``, another SB3 model, or a function from observations to actions;
        :class:`~sb3_quad.algorithms.controller.Controller` says what each of them sees. Or a name,
        as in YAML, such as ``"pid"``. It is never saved: give it to ``load`` again, or call
        :meth:`set_expert`, before learning continues
    :param initial_policy: The agent to start from: a model, the path of a zip, or the name of a
        shipped agent. Its policy and critic are copied; so are its ``net_arch``, ``activation_fn``
        and features extractor unless ``policy_kwargs`` gives them
    :param gradient_steps: Optimiser steps after each rollout, at most one for each row of
        ``n_epochs`` passes over it. Each takes ``batch_size`` pairs of the dataset. None:
        ``n_epochs * ceil(n_steps * n_envs / batch_size)``, as in PPO. The critic is updated in that
        many of them, or in all if there are fewer, each time on an equal share of its passes
    :param beta: β of the first rollout, from 0 to 1
    :param beta_decay: How much β loses with every rollout
    :param beta_final: Where β stops falling
    :param bc_loss: ``"nll"`` (Eq. 3.12) also learns the standard deviation. The others compare mean
        actions only, and leave the deviation to ``log_std_init`` and ``ent_coef``: ``"mse"``, the
        squared error; ``"huber_mse"``, three times that, plus an error that is quadratic up to 0.05
        and linear beyond, which is more exact where the expert is smooth
    :param l2_coef: c_L2
    :param dataset_capacity: Maximum number of pairs; the oldest are dropped first. 0: the current
        rollout only, as the thesis trains
    :param shuffle: whether mini-batches are random. False: consecutive in time, as the thesis
        prepares them ("chronologically", 4.2.3)
    :param check_expert: whether to refuse an expert whose labels the environment's wrappers would
        falsify (docs/experts.md). False: train all the same
    :param demonstrations: a file of recorded flights that the dataset begins with, in a format that
        ``dataset.load`` reads. With ``beta=0`` no expert is needed: the agent clones these flights
        alone, and its own flights train the critic
    :raises ConfigError: an argument out of range, or observations that are a Dict
    :raises ExpertError: an expert that does not fit the environment
    """

    policy_aliases = PPO.policy_aliases
    _not_saved = ("dataset", "_raw")
    # The latest observations, and what VecNormalize has made them of.
    _raw: tuple[Any, Any] = (None, None)

    def __init__(
        self,
        policy: str | type[ActorCriticPolicy],
        env: GymEnv | str,
        learning_rate: RateOrSchedule = LinearSchedule(4e-3, 2e-4, 1.0),  # noqa: B008
        n_steps: Count = 250,
        batch_size: Count = 4096,
        n_epochs: Count = 2,
        gamma: Share = 0.998,
        gae_lambda: Share = 0.95,
        clip_range_vf: WeightOrSchedule | None = None,
        ent_coef: float = 0.0,
        vf_coef: Weight = 0.5,
        max_grad_norm: Weight = 0.5,
        stats_window_size: Count = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: StrDict | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        *,
        expert: ExpertLike | None = None,
        initial_policy: BaseAlgorithm | StrPath | None = None,
        gradient_steps: Count | None = 60,
        beta: Share = 0.5,
        beta_decay: Weight = 0.001,
        beta_final: Share = 0.3,
        bc_loss: CloningLoss = "mse",
        l2_coef: Weight = 0.0,
        dataset_capacity: Natural = 500_000,
        shuffle: bool = True,
        check_expert: bool = True,
        demonstrations: StrPath | None = None,
        _init_setup_model: bool = True,
    ):
        initial = model_of(initial_policy)
        super().__init__(
            policy,
            env,
            learning_rate,
            n_steps=n_steps,
            gamma=gamma,
            gae_lambda=gae_lambda,
            ent_coef=ent_coef,
            vf_coef=vf_coef,
            max_grad_norm=max_grad_norm,
            use_sde=False,
            sde_sample_freq=-1,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_arguments(policy_kwargs, initial, -2.0),
            verbose=verbose,
            seed=seed,
            device=device,
            supported_action_spaces=(spaces.Box,),
            rollout_buffer_class=ExpertRolloutBuffer,
            _init_setup_model=False,
        )
        self.batch_size = batch_size
        self.n_epochs = n_epochs
        self.gradient_steps = gradient_steps
        self.clip_range_vf = clip_range_vf
        self.beta = beta
        self.beta_decay = beta_decay
        self.beta_final = beta_final
        self.bc_loss = bc_loss
        self.l2_coef = l2_coef
        self.dataset_capacity = dataset_capacity
        self.shuffle = shuffle
        self.check_expert = check_expert
        self.expert = None
        self._n_rollouts = 0
        # Seeds the generators if no ``seed`` is given.
        self._entropy = secrets.randbits(63)

        if expert is not None:
            self.set_expert(expert)
        if _init_setup_model:
            self._set_up(initial)
            if demonstrations is not None:
                if expert is not None and dataset_capacity == 0:
                    raise ConfigError(
                        "demonstrations: with dataset_capacity=0 the expert's first labels would"
                        " replace them; remove one of the two, or give a capacity"
                    )
                self.dataset.load(demonstrations)

    def _setup_model(self) -> None:
        self._refuse_dict_observations()
        refuse_wide_actions(self.action_space)
        # A zip of PPO names PPO's buffer class.
        self.rollout_buffer_class = ExpertRolloutBuffer
        super()._setup_model()
        if self.beta == 0.0:
            self.beta_final = 0.0
        if self.beta < self.beta_final:
            raise ConfigError(f"beta {self.beta}: must be at least beta_final, {self.beta_final}")
        rollout = self.n_steps * self.n_envs
        least = max(rollout, self.batch_size)
        if 0 < self.dataset_capacity < least:
            raise ConfigError(
                f"dataset_capacity {self.dataset_capacity}: must be 0 or at least {least}, which is"
                " n_steps * n_envs or batch_size"
            )
        if not isinstance(self.policy.action_dist, DiagGaussianDistribution):
            raise ConfigError(
                f"policy {self.policy_class.__name__}: DAgger needs a diagonal Gaussian policy"
            )
        if self.clip_range_vf is not None:
            self.clip_range_vf = FloatSchedule(self.clip_range_vf)
        dtype = self.rollout_buffer.observations.dtype
        if np.issubdtype(dtype, np.floating):
            dtype = np.dtype(np.float32)
        self.dataset = AggregatedDataset(
            self.dataset_capacity or rollout,
            self.rollout_buffer.obs_shape,
            self.rollout_buffer.action_dim,
            dtype,
        )
        self.dataset.action_range = limits_of(self.action_space)

    def will_clone(self) -> bool:
        """Return whether learning needs the expert; otherwise it clones recorded flights."""
        return self.expert is not None or self.beta > 0.0 or len(self.dataset) == 0

    @property
    def current_beta(self) -> float:
        """β of the current rollout k: max(β_0 - k Δβ, β_final), Algorithm 3 line 8."""
        return max(self.beta - self.beta_decay * self._n_rollouts, self.beta_final)

    def _shows_in_returns(self) -> bool:
        """Return whether the agent flies at least half of the steps."""
        return self.current_beta <= 0.5

    def set_beta(self, beta: float) -> None:
        """Let the expert fly with probability ``beta`` from the next rollout on.

        β then stays constant, whatever ``beta_decay`` is.

        :raises ConfigError: a number below 0 or above 1
        """
        check(Share, beta, "beta")
        self.beta = float(beta)
        self.beta_final = self.beta

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1,
        tb_log_name: str = "DAgger",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """Train for ``total_timesteps``; all arguments are those of SB3's ``learn``.

        With ``reset_num_timesteps`` β starts over. The dataset is kept until ``dataset.clear()``.
        Without an expert, the agent clones the pairs in the dataset, which requires β = 0.

        :raises ExpertError: no expert, or one that does not fit the environment
        """
        if reset_num_timesteps:
            self._n_rollouts = 0
        return super().learn(
            total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar
        )

    def _generator(self, purpose: int) -> np.random.Generator:
        """Return random numbers for this rollout (0) or update (1).

        There is no state to save: a resumed run draws the same numbers.
        """
        seed = self._entropy if self.seed is None else self.seed
        return np.random.default_rng([seed, purpose, self._n_updates])

    def collect_rollouts(
        self,
        env: VecEnv,
        callback: BaseCallback,
        rollout_buffer: RolloutBuffer,
        n_rollout_steps: int,
    ) -> bool:
        """Fly ``n_rollout_steps`` steps with the mixture of expert and agent, and keep the labels.

        It fills ``rollout_buffer`` as SB3 does, except for ``log_probs``, which no loss here needs.
        """
        self.policy.set_training_mode(False)
        buffer = cast(ExpertRolloutBuffer, rollout_buffer)
        network = network_of(self.policy)
        rng = self._generator(0)
        beta = self.current_beta  # +
        if beta > 0.0 and self.expert is None:
            raise ExpertError(f"beta {beta:g}: no expert to fly; call set_expert, or set_beta(0)")
        # + The dataset stores raw observations: the statistics of VecNormalize keep changing.
        normalize = statistics_of(self)
        std = np.exp(self.policy.log_std.detach().cpu().numpy())
        by_expert = np.empty((n_rollout_steps, env.num_envs), dtype=np.bool_)
        not_yet = th.zeros(env.num_envs)

        buffer.reset()
        raw = np.empty_like(buffer.observations) if normalize else buffer.observations
        callback.on_rollout_start()

        for step in range(n_rollout_steps):
            # + Label the state before the step.
            if self.expert is not None:
                buffer.expert_actions[step] = self._labels(env)
            labels = buffer.expert_actions[step]

            # + Fly the expert's action with probability β, otherwise a sample of the agent's
            # policy.
            observations = self._last_obs
            if normalize:
                latest, known = self._raw
                raw[step] = known if latest is observations else normalize.get_original_obs()
            means = network.means(observations)
            sampled = means + std * rng.standard_normal(means.shape, dtype=np.float32)
            by_expert[step] = rng.random(env.num_envs) < beta
            actions = np.where(by_expert[step, :, None], labels, sampled)
            shaped = actions.reshape(-1, *self.action_space.shape)
            clipped_actions = shaped.clip(self.action_space.low, self.action_space.high)

            new_obs, rewards, dones, infos = env.step(clipped_actions)
            # + A callback may change what it sees of the environment.
            if normalize:
                self._raw = (new_obs, normalize.get_original_obs())
            self._look(new_obs, dones, infos)

            self.num_timesteps += env.num_envs
            callback.update_locals(locals())
            if not callback.on_step():
                return False

            self._update_info_buffer(infos, dones)
            # Truncation is not failure: bootstrap with V of the last observation.
            for row in np.flatnonzero(dones):
                last = infos[row].get("terminal_observation")
                if last is not None and infos[row].get("TimeLimit.truncated"):
                    # It is as the environment returned it, perhaps an int or a tuple.
                    last = np.asarray(last, observations.dtype)[None]
                    rewards[row] += self.gamma * network.values(last)[0]

            buffer.add(observations, actions, rewards, self._last_episode_starts, not_yet, not_yet)
            self._last_obs = new_obs
            self._last_episode_starts = dones

        # + The critic does not change during a rollout, so it can evaluate many states at once.
        flown = buffer.observations.reshape(-1, *buffer.obs_shape)
        parts = np.array_split(flown, math.ceil(len(flown) / _VALUE_CHUNK))
        values = np.concatenate([network.values(part) for part in parts])
        buffer.values = values.reshape(buffer.values.shape)
        last_values = th.from_numpy(network.values(new_obs))  # type: ignore[arg-type]
        buffer.compute_returns_and_advantage(last_values=last_values, dones=dones)

        # + Add the labels to the dataset. Without an expert, it keeps the loaded flights.
        if self.expert is not None:
            if self.dataset_capacity == 0:
                self.dataset.clear()
            labels = buffer.expert_actions.reshape(len(flown), -1)
            self.dataset.add(raw.reshape(flown.shape), labels)
        self._n_rollouts += 1

        self.logger.record("dagger/beta", beta)
        self.logger.record("dagger/dataset_size", len(self.dataset))
        self.logger.record("rollout/expert_fraction", by_expert.mean())
        callback.update_locals(locals())
        callback.on_rollout_end()
        return True

    def train(self) -> None:
        """Update the actor on the dataset and the critic on the rollout just flown.

        This is PPO's loop over mini-batches, with two of them per step, kept in one piece as in
        SB3. Additions are marked with ``+``.

        :raises TrainingError: a loss or gradient that is not finite; the parameters remain those of
            the last good step
        """
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        clip_range_vf = None
        if callable(self.clip_range_vf):
            clip_range_vf = self.clip_range_vf(self._current_progress_remaining)

        # + An accelerator computes the same gradients in less time, to rounding.
        network = network_of(self.policy)
        whole_loss = Loss(
            bc_coef=1.0,
            bc_loss=self.bc_loss,
            vf_coef=self.vf_coef,
            clip_range_vf=math.inf if clip_range_vf is None else clip_range_vf,
            ent_coef=self.ent_coef,
            l2_coef=self.l2_coef,
        )
        actor_parameters, critic_parameters = actor_and_critic_parameters(self.policy)

        # + Normalised observations, and rows of the dataset for the actor
        seen = self.dataset.filled["observations"]
        normalize = statistics_of(self)
        if normalize:
            seen = normalize.normalize_obs(seen)
        buffer = self.rollout_buffer
        rng = self._generator(1)
        n_rows = buffer.buffer_size * buffer.n_envs
        batch_size = min(self.batch_size, len(self.dataset))
        n_passes = self.n_epochs * math.ceil(n_rows / self.batch_size)
        n_batches = min(self.gradient_steps or n_passes, self.n_epochs * n_rows)
        actor_rows = sample_rows(len(self.dataset), n_batches * batch_size, rng, self.shuffle)
        # + Rows of the rollout for the critic, which is updated in some of the steps
        n_critic = min(n_passes, n_batches)
        critic_rows = sample_rows(n_rows, self.n_epochs * n_rows, rng, self.shuffle)
        critic_batches = iter(np.array_split(critic_rows, n_critic))
        flown = buffer.observations.reshape(n_rows, *buffer.obs_shape)
        targets = np.stack([buffer.values.reshape(-1), buffer.returns.reshape(-1)], axis=1)
        # The terms of each step, by name
        history: History = {}

        for i, rows in enumerate(actor_rows.reshape(n_batches, batch_size)):
            actor_batch = self.dataset.batch(rows)._replace(observations=seen)
            critic_batch = None
            # Spread the critic's steps evenly.
            if (i + 1) * n_critic // n_batches > i * n_critic // n_batches:
                critic_batch = Batch(next(critic_batches), flown, targets)

            terms = network.gradients(whole_loss, actor_batch, critic_batch)  # +
            if terms is None:  # by PyTorch
                observations, experts = actor_batch.tensors(self.device)
                try:
                    entropy: Any = self.policy.get_distribution(observations).entropy()
                except ValueError as error:  # the mean of the distribution is not finite
                    raise self._diverged({"bc_loss": math.nan}) from error
                # + The cloning term L_BC (Eq. 3.12)
                mean = self.policy.action_dist.mode()
                errors = cloning_errors(self.bc_loss, mean, self.policy.log_std, experts)
                losses = {"bc_loss": errors.mean()}
                loss = losses["bc_loss"]

                # Value loss using the TD(gae_lambda) target
                if critic_batch is not None:
                    observations, value_targets = critic_batch.tensors(self.device)
                    old_values, returns = value_targets.T
                    values = self.policy.predict_values(observations).flatten()
                    if clip_range_vf is None:
                        losses["value_loss"] = F.mse_loss(returns, values)
                    else:  # + Eq. 3.8
                        losses["value_loss"] = max_clipped_value_loss(
                            values, old_values, returns, clip_range_vf
                        )
                    loss = loss + self.vf_coef * losses["value_loss"]

                # Entropy loss favor exploration
                losses["entropy_loss"] = -th.mean(entropy)
                loss = loss + self.ent_coef * losses["entropy_loss"]
                if self.l2_coef > 0.0:  # + Eq. 2.25
                    losses["l2_loss"] = l2_loss([*self.policy.parameters()])
                    loss = loss + self.l2_coef * losses["l2_loss"]

                self.policy.optimizer.zero_grad()
                loss.backward()  # type: ignore[no-untyped-call]
                losses["loss"] = loss
                terms = {name: term.item() for name, term in losses.items()}

            # + In a step without a critic batch, the critic does not move.
            if critic_batch is None:
                for parameter in critic_parameters:
                    parameter.grad = None
            # Clip grad norm, + separately for actor and critic
            norm = th.nn.utils.clip_grad_norm_(actor_parameters, self.max_grad_norm)
            critic_norm = th.nn.utils.clip_grad_norm_(critic_parameters, self.max_grad_norm)
            if not np.isfinite([*terms.values(), float(norm), float(critic_norm)]).all():  # +
                raise self._diverged(terms)
            self.policy.optimizer.step()
            self.policy.log_std.data.clamp_(min=LOG_STD_MIN)  # +
            self._n_updates += 1
            for name, term in terms.items():
                history.setdefault(name, []).append(term)

        self._log_update(history)
        self._log_rollout(buffer, clip_range_vf)
