"""PPO with behavioural cloning towards an expert: stage two of the thesis (4.2.2, Eq. 4.4)."""

import math
from typing import cast

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback
from stable_baselines3.common.utils import FloatSchedule, LinearSchedule
from stable_baselines3.common.vec_env import VecEnv
from torch.nn import functional as F
from typing_extensions import Self

from sb3_quad.algorithms.buffers import ExpertRolloutBuffer
from sb3_quad.algorithms.common import (
    ExpertMixin,
    History,
    RateOrSchedule,
    WeightOrSchedule,
    actor_and_critic_parameters,
    model_of,
    policy_arguments,
)
from sb3_quad.algorithms.labelling import ExpertLike, LabellingVecEnv, refuse_wide_actions
from sb3_quad.algorithms.losses import (
    CloningFilter,
    CloningLoss,
    Loss,
    agree,
    cloning_errors,
    l2_loss,
    max_clipped_value_loss,
)
from sb3_quad.algorithms.networks import Network, network_of
from sb3_quad.base.errors import ConfigError, ExpertError
from sb3_quad.base.types import StrDict, StrPath
from sb3_quad.base.validate import Count, Natural, Share, Weight, check

# By default a rollout is split into this many mini-batches, but none gets fewer than this many
# rows.
N_MINIBATCHES = 16
LEAST_ROWS = 64


class PPOBC(ExpertMixin, PPO):
    """Proximal Policy Optimization with a weighted behavioural-cloning loss (PPO+BC).

    The minimised loss is Eq. 4.4 of the thesis: PPO-clip + c_v · value loss + c_L2 · ½Σw² − c_H ·
    entropy + c_BC · L_BC. The thesis has three misprints here; they are implemented as they are
    meant: Eq. 3.5 prints the probability ratio as a difference of logs (the ratio is its
    exponential); Eq. 3.6 is a maximised objective; Eq. 4.4 prints + c_H H, while entropy is
    encouraged.

    The arguments of :class:`stable_baselines3.PPO` keep their meaning, but for the rollout buffer,
    which is ours, and ``clip_range_vf``. The defaults are those that we recommend for hundreds of
    quadcopters at once and an expert that is good near its target but not everywhere, such as the
    PID. Table A.3 of the thesis is ``zoo_configs/thesis/ppo_bc.yml``. With few environments, give
    ``n_steps`` and ``learning_rate`` as for PPO (SB3's are 2048 and 3e-4).

    An update that adds nothing (a cloning weight and an ``l2_coef`` of 0, no ``critic_warmup``, no
    ``clip_range_vf``) is PPO's, bit for bit. Any other equals PPO's to rounding, plus the
    additions, and is computed faster (docs/ppo_bc.md). A saved model loads with ``PPO.load``, even
    where this package is not installed.

    To clone, the actions must lie within [-1, 1]: wrap other environments in
    ``gymnasium.wrappers.RescaleAction``.

    :param batch_size: rows of a mini-batch. None: a 16th of the rollout, at least 64.
    :param clip_range_vf: ε of the clipped value loss (Eq. 3.8), the larger of the clipped and the
        unclipped error. None: no clipping.
    :param policy_kwargs: ``log_std_init`` is -0.916, ln 0.4, unless it is given here. With an
        initial policy it is that policy's; give -0.916 to let it explore again.
    :param expert: what labels the visited states: an object with ``actions(state)`` on the true
        state of our environments, an SB3 model, or a callable from observations to actions; or a
        name, as in YAML, such as ``"pid"``. Needed when learning starts with a cloning weight.
    :param initial_policy: the agent to start from: a model, the path of a zip, or the name of a
        shipped agent. Its policy and critic are copied; so are its ``net_arch``, ``activation_fn``
        and features extractor unless ``policy_kwargs`` gives them.
    :param bc_coef: c_BC, the weight of the cloning term: a float or a schedule of the remaining
        progress (SB3's ``LinearSchedule(0.1, 0.0, 0.5)`` falls from 0.1 to 0 over the first half).
    :param bc_loss: ``"nll"``, the negative log-likelihood of the expert's action (Eq. 3.12), a sum
        over the action's dimensions; ``"mse"``, the squared error of the policy's mean action,
        which leaves the deviation alone; ``"huber_mse"``, three times that, plus an error that is
        quadratic up to 0.05 and linear beyond.
    :param bc_filter: where to clone: ``"none"``, everywhere; ``"agreement"``, where expert and
        policy differ by less than 0.3 (root mean square over the action). An expert for small
        angles, such as the PID, then guides the agent on its way to the target, but not where the
        agent has learnt to recover and the expert would crash.
    :param l2_coef: c_L2, weight of ½Σw² over the weight matrices (Eq. 2.25); biases and ``log_std``
        are excluded.
    :param critic_warmup: for this many rollouts only the critic learns. A critic that comes from
        another task, or from another policy, would otherwise spoil the actor with its first
        advantages.
    :param shuffle: whether mini-batches are random. False: consecutive in time, as the thesis
        prepares them ("chronologically", 4.2.3).
    :param check_expert: whether to refuse an expert whose labels the environment's wrappers would
        falsify (docs/experts.md). False: train all the same.
    :raises ConfigError: on construction: a value out of range, an unknown name, or a space that is
        not supported.
    :raises ExpertError: when learning starts, or at the latest in the first rollout to be cloned:
        no expert, or one whose labels do not fit.
    :raises TrainingError: a loss or gradient that is not finite; the parameters remain those of the
        step before.
    """

    def __init__(
        self,
        policy: str | type[ActorCriticPolicy],
        env: GymEnv | str,
        learning_rate: RateOrSchedule = LinearSchedule(5e-4, 1e-5, 1.0),  # noqa: B008
        n_steps: Count = 125,
        batch_size: Count | None = None,
        n_epochs: Count = 6,
        gamma: Share = 0.995,
        gae_lambda: Share = 0.98,
        clip_range: WeightOrSchedule = 0.2,
        clip_range_vf: WeightOrSchedule | None = None,
        normalize_advantage: bool = True,
        ent_coef: float = 0.0001,
        vf_coef: Weight = 0.5,
        max_grad_norm: Weight = 0.5,
        use_sde: bool = False,
        sde_sample_freq: int = -1,
        target_kl: Weight | None = None,
        stats_window_size: Count = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: StrDict | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        *,
        expert: ExpertLike | None = None,
        initial_policy: BaseAlgorithm | StrPath | None = None,
        bc_coef: WeightOrSchedule = 0.1,
        bc_loss: CloningLoss = "mse",
        bc_filter: CloningFilter = "agreement",
        l2_coef: Weight = 0.0,
        critic_warmup: Natural = 4,
        shuffle: bool = True,
        check_expert: bool = True,
        _init_setup_model: bool = True,
    ):
        initial = model_of(initial_policy)
        super().__init__(
            policy,
            env,
            learning_rate,
            n_steps=n_steps,
            # The default depends on the environments. PPO warns if it does not divide the rollout.
            batch_size=batch_size or max(n_steps, 2),
            n_epochs=n_epochs,
            gamma=gamma,
            gae_lambda=gae_lambda,
            clip_range=clip_range,
            clip_range_vf=clip_range_vf,
            normalize_advantage=normalize_advantage,
            ent_coef=ent_coef,
            vf_coef=vf_coef,
            max_grad_norm=max_grad_norm,
            use_sde=use_sde,
            sde_sample_freq=sde_sample_freq,
            target_kl=target_kl,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_arguments(policy_kwargs, initial, -0.916),
            verbose=verbose,
            seed=seed,
            device=device,
            _init_setup_model=False,
        )
        self.batch_size = batch_size
        self.expert = expert
        self.bc_coef = bc_coef
        self.bc_loss = bc_loss
        self.bc_filter = bc_filter
        self.l2_coef = l2_coef
        self.critic_warmup = critic_warmup
        self.shuffle = shuffle
        self.check_expert = check_expert
        self._n_rollouts_trained = 0

        if _init_setup_model:
            self._set_up(initial)

    def _setup_model(self) -> None:
        self._refuse_dict_observations()
        # SB3's own buffer, which a zip of PPO names, has no labels.
        self.rollout_buffer_class = ExpertRolloutBuffer
        if self.batch_size is None:
            n_rows = self.n_steps * self.n_envs
            n_minibatches = min(N_MINIBATCHES, max(n_rows // LEAST_ROWS, 1))
            self.batch_size = math.ceil(n_rows / n_minibatches)
        super()._setup_model()
        if not isinstance(self.action_space, spaces.Box) and self.expert is not None:
            raise ConfigError(
                "PPOBC clones into a Box action space only, this environment has"
                f" {self.action_space}"
            )
        if self.expert is not None and self.will_clone():
            self._check_cloning()

    @property
    def policy_is_idle(self) -> bool:
        """Whether only the critic has learnt so far (``critic_warmup``)."""
        return 0 < self.critic_warmup >= self._n_rollouts_trained

    def set_bc_coef(self, bc_coef: float) -> None:
        """Weight the cloning term with ``bc_coef`` from the next rollout on.

        It replaces the schedule. A rollout in progress keeps its weight, which decided whether its
        states are labelled.

        :raises ConfigError: a weight that is negative or not finite.
        :raises ExpertError: a weight above 0 without an expert.
        """
        check(Weight, bc_coef, "bc_coef")
        if bc_coef > 0.0:
            self._check_cloning()
        self.bc_coef = FloatSchedule(float(bc_coef))

    def _check_cloning(self) -> None:
        if self.expert is None:
            raise ExpertError(
                "PPOBC needs an expert to clone: PPOBC(..., expert='geometric'),"
                " model.set_expert(...), or bc_coef=0"
            )
        refuse_wide_actions(self.action_space)
        if self.use_sde and self.bc_loss == "nll":
            raise ConfigError(
                "use_sde: bc_loss 'nll' needs a diagonal Gaussian policy; use bc_loss='mse', for"
                " example"
            )

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1,
        tb_log_name: str = "PPOBC",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """Train for ``total_timesteps``; all arguments are those of SB3's ``PPO.learn``.

        :raises ExpertError: no expert where one is needed, or one that does not fit.
        """
        if self.will_clone():
            self._check_cloning()
        return super().learn(
            total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar
        )

    def collect_rollouts(
        self,
        env: VecEnv,
        callback: BaseCallback,
        rollout_buffer: RolloutBuffer,
        n_rollout_steps: int,
    ) -> bool:
        """Fly a rollout with PPO's loop, and label its states if the update will clone."""
        # The update follows this rollout, and uses the weight that the schedule has by then.
        buffer = cast(ExpertRolloutBuffer, rollout_buffer)
        end = self.num_timesteps + n_rollout_steps * env.num_envs
        # The last rollout may end after the last timestep.
        buffer.bc_coef = self.bc_coef(max(1.0 - end / self._total_timesteps, 0.0))
        if buffer.bc_coef == 0.0:
            # A recurrent expert misses this rollout, so it starts afresh in the next one.
            self._labeller = None
            return super().collect_rollouts(env, callback, buffer, n_rollout_steps)

        def label() -> None:
            # SB3 adds the step to the buffer after it.
            buffer.expert_actions[buffer.pos] = self._labels(env)

        labelling = LabellingVecEnv(env, label, self._look)
        with network_of(self.policy).acting():
            return super().collect_rollouts(labelling, callback, buffer, n_rollout_steps)

    def train(self) -> None:
        """Update the policy on the rollout just flown, as PPO does. Additions are marked ``+``.

        Kept in one piece and in SB3's order, so that the two can be compared line by line.
        """
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        clip_range = self.clip_range(self._current_progress_remaining)  # type: ignore[operator]
        clip_range_vf = None
        if self.clip_range_vf is not None:
            clip_range_vf = self.clip_range_vf(self._current_progress_remaining)  # type: ignore[operator]

        # + While the critic warms up, no term moves the actor's weights.
        buffer: ExpertRolloutBuffer = self.rollout_buffer
        bc_coef = buffer.bc_coef
        warming_up = self._n_rollouts_trained < self.critic_warmup
        ent_coef = self.ent_coef
        l2_coef = self.l2_coef
        if warming_up:
            ent_coef = l2_coef = 0.0
        actor_parameters, _ = actor_and_critic_parameters(self.policy)

        # + An accelerator computes the same gradients faster, to rounding. Without additions
        # PyTorch computes them, so that the update is PPO's bit for bit.
        adds = bc_coef != 0.0 or self.l2_coef > 0.0 or clip_range_vf is not None or warming_up
        network = network_of(self.policy) if adds else Network(self.policy)
        whole_loss = Loss(
            policy_coef=1.0,
            clip_range=clip_range,
            normalize_advantage=self.normalize_advantage,
            bc_coef=bc_coef,
            bc_loss=self.bc_loss,
            bc_filter=self.bc_filter,
            vf_coef=self.vf_coef,
            clip_range_vf=math.inf if clip_range_vf is None else clip_range_vf,
            ent_coef=ent_coef,
            l2_coef=l2_coef,
        )

        # The terms of each mini-batch, by name
        history: History = {}
        continue_training = True

        # train for n_epochs epochs
        for epoch in range(self.n_epochs):
            approx_kl_divs = []
            # Do a complete pass on the rollout buffer
            for rows in buffer.minibatches(self.batch_size, self.shuffle):  # +
                terms = network.gradients(whole_loss, *buffer.batches(rows))  # +
                if terms is None:  # by PyTorch
                    rollout_data = buffer.samples(rows)
                    actions = rollout_data.actions
                    if isinstance(self.action_space, spaces.Discrete):
                        # Convert discrete action from float to long
                        actions = rollout_data.actions.long().flatten()

                    try:
                        values, log_prob, entropy = self.policy.evaluate_actions(
                            rollout_data.observations, actions
                        )
                    except ValueError as error:  # + the mean of the distribution is not finite
                        raise self._diverged({"mean action": math.nan}) from error
                    values = values.flatten()
                    # Normalize advantage
                    advantages = rollout_data.advantages
                    # Normalization does not make sense if mini batchsize == 1
                    if self.normalize_advantage and len(advantages) > 1:
                        advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)

                    # ratio between old and new policy, should be one at the first iteration
                    log_ratio = log_prob - rollout_data.old_log_prob
                    ratio = th.exp(log_ratio)

                    # clipped surrogate loss
                    policy_loss_1 = advantages * ratio
                    policy_loss_2 = advantages * th.clamp(ratio, 1 - clip_range, 1 + clip_range)
                    policy_loss = -th.min(policy_loss_1, policy_loss_2).mean()

                    # Value loss using the TD(gae_lambda) target
                    returns = rollout_data.returns
                    if clip_range_vf is None:
                        # No clipping
                        value_loss = F.mse_loss(returns, values)
                    else:  # + Eq. 3.8
                        value_loss = max_clipped_value_loss(
                            values, rollout_data.old_values, returns, clip_range_vf
                        )

                    # Entropy loss favor exploration
                    if entropy is None:
                        # Approximate entropy when no analytical form
                        entropy_loss = -th.mean(-log_prob)
                    else:
                        entropy_loss = -th.mean(entropy)

                    loss = policy_loss + ent_coef * entropy_loss + self.vf_coef * value_loss
                    losses = {
                        "policy_gradient_loss": policy_loss,
                        "value_loss": value_loss,
                        "entropy_loss": entropy_loss,
                    }
                    # + The cloning term L_BC; rows that are not cloned count as 0
                    if bc_coef != 0.0:
                        mean = self.policy.action_dist.mode()
                        labels = rollout_data.expert_actions
                        errors = cloning_errors(self.bc_loss, mean, self.policy.log_std, labels)
                        if self.bc_filter == "agreement":
                            errors = errors * agree(mean, labels)
                        losses["bc_loss"] = errors.mean()
                        loss = loss + bc_coef * losses["bc_loss"]
                    # + Weight decay as a term of the loss (Eq. 2.25)
                    if l2_coef != 0.0:
                        parameters = dict(self.policy.named_parameters())
                        # With gSDE log_std is a matrix, too.
                        parameters.pop("log_std", None)
                        losses["l2_loss"] = l2_loss([*parameters.values()])
                        loss = loss + l2_coef * losses["l2_loss"]

                    # Calculate approximate form of reverse KL Divergence for early stopping
                    with th.no_grad():
                        losses["approx_kl"] = th.mean((ratio - 1) - log_ratio)
                        losses["clip_fraction"] = th.mean((th.abs(ratio - 1) > clip_range).float())

                    self.policy.optimizer.zero_grad()
                    loss.backward()  # type: ignore[no-untyped-call]
                    losses["loss"] = loss
                    terms = {name: term.item() for name, term in losses.items()}

                # Logging
                for name, term in terms.items():
                    history.setdefault(name, []).append(term)
                approx_kl_divs.append(terms["approx_kl"])

                if self.target_kl is not None and terms["approx_kl"] > 1.5 * self.target_kl:
                    continue_training = False
                    if self.verbose >= 1:
                        print(
                            f"Early stopping at step {epoch} due to reaching max kl:"
                            f" {terms['approx_kl']:.2f}"
                        )
                    break

                # Optimization step
                if warming_up:  # + only the critic learns
                    for parameter in actor_parameters:
                        parameter.grad = None
                # Clip grad norm
                norm = th.nn.utils.clip_grad_norm_(self.policy.parameters(), self.max_grad_norm)
                if not np.isfinite([terms["loss"], float(norm)]).all():  # +
                    raise self._diverged(terms | {"gradient": float(norm)})
                self.policy.optimizer.step()

            self._n_updates += 1
            if not continue_training:
                break

        self._n_rollouts_trained += 1  # +
        # Logs
        history["approx_kl"] = approx_kl_divs
        history["loss"] = history["loss"][-1:]
        self._log_update(history)
        self._log_rollout(buffer, clip_range_vf)
        self.logger.record("train/clip_range", clip_range)
        self.logger.record("train/bc_coef", bc_coef)  # +
