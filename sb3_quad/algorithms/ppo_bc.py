"""PPO with a weighted behavioural-cloning loss towards an expert: stage two of the thesis (4.2.2,
Eq. 4.4).
"""

import math
from typing import Any, cast

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from stable_baselines3.common.utils import FloatSchedule, explained_variance, obs_as_tensor
from stable_baselines3.common.vec_env import VecEnv

from sb3_quad.algorithms.buffers import ExpertRolloutBuffer
from sb3_quad.algorithms.common import (
    ExpertMixin,
    arguments_of,
    is_ever_nonzero,
    parameters_of_both,
)
from sb3_quad.algorithms.networks.gradients import act, gradients, network_of
from sb3_quad.algorithms.networks.losses import BC_FILTERS, CLONING_LOSSES, CloningLoss, Loss
from sb3_quad.base.errors import ConfigError, ExpertError, TrainingError, unknown
from sb3_quad.controllers.controller import Controller


class PPOBC(ExpertMixin, PPO):  # type: ignore[misc]
    """Proximal Policy Optimization with a weighted behavioural-cloning loss (PPO+BC).

    The minimised loss is Eq. 4.4 of the thesis: PPO-clip + c_v · value loss + c_L2 · ½Σw² − c_H ·
    entropy + c_BC · L_BC. The thesis has three errata here, followed as they are meant: Eq. 3.5
    prints the probability ratio as a difference of logs (the ratio is its exponential); Eq. 3.6 is
    a maximised objective; Eq. 4.4 prints + c_H H, while entropy is encouraged.

    All arguments of :class:`stable_baselines3.PPO` keep their meaning and defaults. An update that
    adds nothing (a cloning weight and an ``l2_coef`` of 0, no ``critic_warmup``, and either no
    ``clip_range_vf`` or ``max_clipped_value=False``) is PPO's, bit for bit; any other is equal to
    PPO's to rounding, plus what is added, in less time (docs/ppo_bc.md). A saved model loads with
    ``PPO.load``, even where this package is not installed.

    :param expert: who labels the visited states: an object with ``actions(state)`` on the true
        state of our environments, an SB3 model, or a callable from observations to actions; or a
        name as YAML takes it, such as ``"pid"``. Needed when learning starts with a cloning weight.
    :param bc_coef: c_BC, the weight of the cloning term: a float or a schedule of the remaining
        progress (SB3's ``LinearSchedule(0.1, 0.0, 0.5)`` falls from 0.1 to 0 over the first half).
    :param bc_loss: ``"nll"``, the negative log-likelihood of the expert's action (Eq. 3.12), a sum
        over the action's dimensions; ``"mse"``, the squared error of the policy's mean action,
        which leaves the deviation alone; ``"huber"``, that is linear beyond 0.05; or
        ``"huber_mse"``, that and three times the squared error.
    :param bc_filter: where to clone: ``"none"``, everywhere; ``"agreement"``, where expert and
        policy differ by less than 0.3 (root mean square over the action): an expert for small
        angles, such as the PID, then holds the agent on its way to the target and has no say where
        the agent has learnt to recover and the expert would crash.
    :param l2_coef: c_L2, weight of ½Σw² over the weight matrices (Eq. 2.25); biases and ``log_std``
        are left out.
    :param max_clipped_value: the value loss of Eq. 3.8, the larger of the clipped and the unclipped
        error, where ``clip_range_vf`` is given; False for stock PPO's clipped error.
    :param critic_warmup: for this many rollouts only the critic learns. A critic that comes from
        another task, or from another policy, would otherwise spoil the actor with its first
        advantages.
    :param shuffle: whether mini-batches are random. False: consecutive in time, as the thesis
        prepares them ("chronologically", 4.2.3).
    :raises ConfigError: a value out of range, a name that is not known, or a space that is not
        supported, when built.
    :raises ExpertError: when learning starts, or at the latest with the first rollout that is to be
        cloned: no expert, or one whose labels do not fit.
    :raises TrainingError: a loss or gradient that is not finite; the parameters are those of the
        step before.
    """

    _rollout_bc_coef = 0.0  # the weight of the cloning term in the update on the present rollout

    def __init__(
        self,
        policy: str | type[ActorCriticPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 3e-4,
        n_steps: int = 2048,
        batch_size: int = 64,
        n_epochs: int = 10,
        gamma: float = 0.99,
        gae_lambda: float = 0.95,
        clip_range: float | Schedule = 0.2,
        clip_range_vf: float | Schedule | None = None,
        normalize_advantage: bool = True,
        ent_coef: float = 0.0,
        vf_coef: float = 0.5,
        max_grad_norm: float = 0.5,
        use_sde: bool = False,
        sde_sample_freq: int = -1,
        rollout_buffer_class: type[RolloutBuffer] | None = None,
        rollout_buffer_kwargs: dict[str, Any] | None = None,
        target_kl: float | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        expert: Any = None,
        bc_coef: float | Schedule = 0.005,
        bc_loss: CloningLoss = "nll",
        bc_filter: str = "none",
        l2_coef: float = 0.0,
        max_clipped_value: bool = True,
        critic_warmup: int = 0,
        shuffle: bool = True,
        _init_setup_model: bool = True,
    ):
        stock = {**locals(), "rollout_buffer_class": rollout_buffer_class or ExpertRolloutBuffer}
        super().__init__(**arguments_of(PPO, stock), _init_setup_model=False)
        if bc_loss not in CLONING_LOSSES:
            raise ConfigError(unknown("bc_loss", bc_loss, CLONING_LOSSES))
        if bc_filter not in BC_FILTERS:
            raise ConfigError(unknown("bc_filter", bc_filter, BC_FILTERS))
        self.expert = expert
        self.bc_coef = bc_coef
        self.bc_loss: CloningLoss = bc_loss
        self.bc_filter = bc_filter
        self.l2_coef = l2_coef
        self.max_clipped_value = max_clipped_value
        self.critic_warmup = critic_warmup
        self.shuffle = shuffle
        self._n_rollouts_trained = 0

        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        self._refuse_dict_observations()
        if not issubclass(self.rollout_buffer_class or RolloutBuffer, ExpertRolloutBuffer):
            raise ConfigError(
                f"rollout_buffer_class {self.rollout_buffer_class}: must be an ExpertRolloutBuffer"
            )
        super()._setup_model()
        if not isinstance(self.action_space, spaces.Box) and self.expert is not None:
            raise ConfigError(
                f"PPOBC clones into a Box action space only, this environment has {self.action_space}"
            )
        self.bc_coef = FloatSchedule(self.bc_coef)
        if self.expert is not None and self.will_clone():
            self._check_cloning()

    def _excluded_save_params(self) -> list[str]:
        return [
            *super()._excluded_save_params(),
            "rollout_buffer_class",
            "rollout_buffer_kwargs",
            "_rollout_bc_coef",
        ]

    @property
    def policy_is_idle(self) -> bool:
        """Whether the policy is still the one that it began with, since only the critic has learnt
        (``critic_warmup``).
        """
        return 0 < self.critic_warmup >= self._n_rollouts_trained

    def set_bc_coef(self, bc_coef: float) -> None:
        """Weigh the cloning term with ``bc_coef`` from the next rollout on, instead of the schedule
        given before.

        :raises ConfigError: a weight that is negative or not finite.
        :raises ExpertError: a weight, and no expert.
        """
        if not 0.0 <= bc_coef < float("inf"):
            raise ConfigError(f"bc_coef is {bc_coef}, must be finite and at least 0")
        if bc_coef > 0.0:
            self._check_cloning()
        self.bc_coef = FloatSchedule(
            bc_coef
        )  # a rollout under way keeps the weight by which it was labelled, or not

    def will_clone(self) -> bool:
        """Whether the schedule gives the cloning term a weight anywhere, as far as a hundred
        samples of it tell.
        """
        return is_ever_nonzero(self.bc_coef)  # type: ignore[arg-type]

    def _check_cloning(self) -> None:
        if self.expert is None:
            raise ExpertError(
                "PPOBC needs an expert to clone: PPOBC(..., expert='geometric'), model.set_expert(...), or bc_coef=0"
            )
        if self.use_sde and self.bc_loss == "nll":
            raise ConfigError(
                "use_sde: bc_loss 'nll' needs a diagonal Gaussian policy; use bc_loss='mse', for example"
            )

    def _prepare_to_learn(self, anew: bool) -> None:
        if self.will_clone():
            self._check_cloning()

    def collect_rollouts(
        self,
        env: VecEnv,
        callback: BaseCallback,
        rollout_buffer: RolloutBuffer,
        n_rollout_steps: int,
    ) -> bool:
        """Fly a rollout: PPO's loop, with what is added to it marked by ``+``."""
        assert self._last_obs is not None, "No previous observation was provided"
        self.policy.set_training_mode(False)

        # + The update on this rollout comes at its end, and with the weight of that time: that
        # weight decides about labels.
        buffer = cast(ExpertRolloutBuffer, rollout_buffer)
        end = self.num_timesteps + n_rollout_steps * env.num_envs
        self._rollout_bc_coef = float(self.bc_coef(1.0 - float(end) / float(self._total_timesteps)))  # type: ignore[operator]
        clones = buffer.labelled = self._rollout_bc_coef != 0.0
        # + An expert that has not seen a rollout begins anew.
        self._labeller = Controller.for_env(self.expert, env, self._labeller) if clones else None
        network = (
            network_of(self.policy) if clones else self.policy
        )  # + without additions as PPO, bit for bit

        n_steps = 0
        rollout_buffer.reset()
        if self.use_sde:
            self.policy.reset_noise(env.num_envs)

        callback.on_rollout_start()

        while n_steps < n_rollout_steps:
            if self.use_sde and self.sde_sample_freq > 0 and n_steps % self.sde_sample_freq == 0:
                self.policy.reset_noise(env.num_envs)

            with th.no_grad():
                obs_tensor: Any = obs_as_tensor(self._last_obs, self.device)  # type: ignore[arg-type]
                actions_tensor, values, log_probs = act(network, obs_tensor)  # +
            actions = actions_tensor.cpu().numpy()

            clipped_actions = actions
            if isinstance(self.action_space, spaces.Box):
                if self.policy.squash_output:
                    clipped_actions = self.policy.unscale_action(clipped_actions)
                else:
                    clipped_actions = np.clip(
                        actions, self.action_space.low, self.action_space.high
                    )

            if self._labeller is not None:  # + of the state before the step
                observations: Any = self._last_obs
                buffer.expert_actions[buffer.pos] = self._labeller.labels(
                    observations, self._last_episode_starts
                )

            new_obs, rewards, dones, infos = env.step(clipped_actions)

            self.num_timesteps += env.num_envs
            callback.update_locals(locals())
            if not callback.on_step():
                return False

            self._update_info_buffer(infos, dones)
            n_steps += 1

            if isinstance(self.action_space, spaces.Discrete):
                actions = actions.reshape(-1, 1)

            # Handle timeout by bootstrapping with value function
            for idx in np.flatnonzero(dones):
                if infos[idx].get("terminal_observation") is not None and infos[idx].get(
                    "TimeLimit.truncated", False
                ):
                    terminal_obs = self.policy.obs_to_tensor(infos[idx]["terminal_observation"])[0]
                    with th.no_grad():
                        rewards[idx] += self.gamma * self.policy.predict_values(terminal_obs)[0]

            rollout_buffer.add(
                self._last_obs, actions, rewards, self._last_episode_starts, values, log_probs
            )  # type: ignore[arg-type]
            self._last_obs = new_obs  # type: ignore[assignment]
            self._last_episode_starts = dones

        with th.no_grad():
            values = self.policy.predict_values(obs_as_tensor(new_obs, self.device))  # type: ignore[arg-type]
        rollout_buffer.compute_returns_and_advantage(last_values=values, dones=dones)

        callback.update_locals(locals())
        callback.on_rollout_end()
        return True

    def train(self) -> None:
        """One update on the rollout just flown: PPO's loop, with what is added to it marked by
        ``+``.
        """
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        progress = self._current_progress_remaining
        clip_range = self.clip_range(progress)  # type: ignore[operator]
        clip_range_vf = None if self.clip_range_vf is None else self.clip_range_vf(progress)  # type: ignore[operator]

        # + The loss of Eq. 4.4. Without additions it is PPO's, and its gradients come from
        # PyTorch's layers, as PPO's do.
        buffer = cast(ExpertRolloutBuffer, self.rollout_buffer)
        warming_up = self._n_rollouts_trained < self.critic_warmup
        loss = Loss(
            policy_coef=1.0,
            clip_range=clip_range,
            normalize_advantage=self.normalize_advantage,
            bc_coef=self._rollout_bc_coef,
            bc_loss=CLONING_LOSSES.index(self.bc_loss),
            bc_filter=BC_FILTERS.index(self.bc_filter),
            vf_coef=self.vf_coef,
            clip_range_vf=math.inf if clip_range_vf is None else clip_range_vf,
            max_clipped_value=self.max_clipped_value,
            ent_coef=0.0 if warming_up else self.ent_coef,
            l2_coef=0.0 if warming_up else self.l2_coef,
        )
        own_value_loss = clip_range_vf is not None and self.max_clipped_value
        adds = self._rollout_bc_coef != 0.0 or self.l2_coef > 0.0 or own_value_loss or warming_up
        network, (actor, _) = (
            network_of(self.policy) if adds else self.policy,
            parameters_of_both(self.policy),
        )

        monitored: dict[str, list[float]] = {}  # by name: the term of each mini-batch
        continue_training = True

        for epoch in range(self.n_epochs):
            approx_kl_divs = []
            for batch, for_critic in buffer.get(self.batch_size, self.shuffle):
                terms = gradients(network, loss, batch, for_critic)
                for name, term in terms.items():
                    monitored.setdefault(name, []).append(term)
                approx_kl_divs.append(terms["approx_kl"])

                if self.target_kl is not None and terms["approx_kl"] > 1.5 * self.target_kl:
                    continue_training = False
                    if self.verbose >= 1:
                        print(
                            f"Early stopping at step {epoch} due to reaching max kl: {terms['approx_kl']:.2f}"
                        )
                    break

                for parameter in actor if warming_up else ():  # + only the critic learns
                    parameter.grad = None
                norm = th.nn.utils.clip_grad_norm_(self.policy.parameters(), self.max_grad_norm)
                if not np.isfinite([terms["loss"], float(norm)]).all():  # +
                    parts = ", ".join(
                        f"{name} {term:.3g}"
                        for name, term in (terms | {"gradient": float(norm)}).items()
                    )
                    raise TrainingError(
                        f"the loss is not finite after {self.num_timesteps} timesteps ({parts}): try a smaller learning_rate "
                        "or bc_coef, and check the expert's actions"
                    )
                self.policy.optimizer.step()

            self._n_updates += 1
            if not continue_training:
                break

        self._n_rollouts_trained += 1
        explained_var = explained_variance(
            self.rollout_buffer.values.flatten(), self.rollout_buffer.returns.flatten()
        )

        averages = {name: float(np.mean(values)) for name, values in monitored.items()}
        averages |= {
            "approx_kl": float(np.mean(approx_kl_divs)),
            "loss": terms["loss"],
            "explained_variance": explained_var,
        }
        for name, average in averages.items():
            self.logger.record(f"train/{name}", average)
        if hasattr(self.policy, "log_std"):
            self.logger.record("train/std", th.exp(self.policy.log_std).mean().item())
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/clip_range", clip_range)
        if clip_range_vf is not None:
            self.logger.record("train/clip_range_vf", clip_range_vf)
        self.logger.record("train/bc_coef", self._rollout_bc_coef)  # +
