"""PPO with a weighted behavioural-cloning loss towards an expert: stage two of the thesis (4.2.2, Eq. 4.4)."""

from __future__ import annotations

from typing import Any, TypeVar, cast

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import FloatSchedule, explained_variance
from stable_baselines3.common.vec_env import VecEnv

from sb3_quad.base.errors import ConfigError, ExpertError, TrainingError, unknown
from sb3_quad.common.losses import CLONING_LOSSES, CloningLoss
from sb3_quad.experts.controller import ExpertLabeller
from sb3_quad.ppo_bc.buffer import ExpertRolloutBuffer, ExpertRolloutBufferSamples
from sb3_quad.ppo_bc.gradients import gradient_norms
from sb3_quad.ppo_bc.loss import BC_FILTERS, LossTerms, Weights, loss_terms

SelfPPOBC = TypeVar("SelfPPOBC", bound="PPOBC")


class PPOBC(PPO):
    """Proximal Policy Optimization with a weighted behavioural-cloning loss (PPO+BC).

    The minimised loss is Eq. 4.4 of the thesis: PPO-clip + c_v · value loss + c_L2 · ½Σw² − c_H · entropy + c_BC · L_BC.
    Errata of the thesis, followed in their meant sense: Eq. 3.5 prints the probability ratio as a difference of logs (the
    ratio is its exponential); Eq. 3.6 is a maximised objective; Eq. 4.4 prints + c_H H, while entropy is encouraged.

    All arguments of :class:`stable_baselines3.PPO` keep their meaning and defaults. With ``bc_coef=0``, ``l2_coef=0`` and
    ``critic_warmup=0`` (and either no ``clip_range_vf`` or ``max_clipped_value=False``) training is PPO's, bit for bit; with
    any of them it is equal to PPO's to rounding, plus what is added, by an update that takes two thirds of the time. A saved
    model loads with ``PPO.load``, also where this package is not installed.

    :param expert: who labels the visited states: an object with ``actions(state)`` on the true state of our environments,
        an SB3 model, or a callable from observations to actions. Needed when learning starts with a cloning weight.
    :param bc_coef: c_BC, the weight of the cloning term: a float or a schedule of the remaining progress (SB3's
        ``LinearSchedule(0.1, 0.0, 0.5)`` falls from 0.1 to 0 over the first half).
    :param bc_loss: ``"nll"``, the negative log-likelihood of the expert's action (Eq. 3.12), a mean over the action's
        dimensions; ``"mse"``, the squared error of the policy's mean action, which leaves the deviation alone;
        ``"huber"``, that is linear beyond 0.05; or ``"huber_mse"``, that and three times the squared error.
    :param bc_filter: where to clone: ``"none"``, everywhere; ``"negative_advantage"``, where the flown action did worse than
        the critic expected; ``"agreement"``, where expert and policy differ by less than 0.3 (root mean square over the
        action): an expert for small angles, such as the PID, then holds the agent on its way to the target and has no say
        where the agent has learnt to recover and the expert would crash.
    :param l2_coef: c_L2, weight of ½Σw² over the weight matrices (Eq. 2.25); biases and ``log_std`` are left out.
    :param max_clipped_value: the value loss of Eq. 3.8, the larger of the clipped and the unclipped error, where
        ``clip_range_vf`` is given; False for stock PPO's clipped error.
    :param critic_warmup: for this many rollouts only the critic learns: a critic that comes from another task, or from
        another policy, would else spoil the actor with its first advantages.
    :raises ConfigError: a value out of range, a name that is not known, or a space that is not supported, when built.
    :raises ExpertError: when learning starts: no expert, or one whose labels do not fit.
    :raises TrainingError: a loss that is not finite; the parameters are those of the step before.
    """

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
        _init_setup_model: bool = True,
    ):
        super().__init__(
            policy,
            env,
            learning_rate=learning_rate,
            n_steps=n_steps,
            batch_size=batch_size,
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
            rollout_buffer_class=rollout_buffer_class or ExpertRolloutBuffer,
            rollout_buffer_kwargs=rollout_buffer_kwargs,
            target_kl=target_kl,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            seed=seed,
            device=device,
            _init_setup_model=False,
        )
        if bc_loss not in CLONING_LOSSES:
            raise ConfigError(unknown("bc_loss", bc_loss, CLONING_LOSSES))
        if bc_filter not in BC_FILTERS:
            raise ConfigError(unknown("bc_filter", bc_filter, BC_FILTERS))
        if not l2_coef >= 0:
            raise ConfigError(f"l2_coef is {l2_coef}, must be at least 0")
        if critic_warmup < 0:
            raise ConfigError(f"critic_warmup is {critic_warmup} rollouts, must be at least 0")
        self.expert = expert
        self.bc_coef = bc_coef
        self.bc_loss = bc_loss
        self.bc_filter = bc_filter
        self.l2_coef = l2_coef
        self.max_clipped_value = max_clipped_value
        self.critic_warmup = critic_warmup
        self._n_rollouts_trained = 0
        self._next_bc_coef: float | None = None
        self._labeller: ExpertLabeller | None = None
        self._labels: Any = None

        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        if isinstance(self.observation_space, spaces.Dict):
            raise ConfigError(
                f"observation space {self.observation_space}: PPOBC does not support Dict; wrap the environment in "
                "gymnasium.wrappers.FlattenObservation"
            )
        super()._setup_model()
        if not isinstance(self.action_space, spaces.Box) and self.expert is not None:
            raise ConfigError(f"PPOBC clones into a Box action space only, this environment has {self.action_space}")
        if self.use_sde and self.bc_loss == "nll" and self._ever_clones():
            raise ConfigError("use_sde: bc_loss 'nll' needs a diagonal Gaussian policy; use bc_loss='mse', for example")
        self.bc_coef = FloatSchedule(self.bc_coef)

    def _excluded_save_params(self) -> list[str]:
        own = ["expert", "_labeller", "_labels", "rollout_buffer_class", "rollout_buffer_kwargs"]
        return [*super()._excluded_save_params(), *own]

    def set_expert(self, expert: Any) -> None:
        """Give the expert to a model that was loaded without one."""
        self.expert = expert
        self._labeller = None

    def set_bc_coef(self, bc_coef: float) -> None:
        """Weigh the cloning term with ``bc_coef`` from the next rollout on, instead of the schedule given before.

        :raises ConfigError: a weight that is negative or not finite.
        :raises ExpertError: a weight, and no expert.
        """
        if not 0.0 <= bc_coef < float("inf"):
            raise ConfigError(f"bc_coef is {bc_coef}, must be finite and at least 0")
        if bc_coef > 0.0 and self.expert is None:
            raise ExpertError(f"bc_coef {bc_coef}: PPOBC needs an expert to clone, PPOBC(..., expert=PIDExpert())")
        self._next_bc_coef = float(bc_coef)  # not now: the rollout that is under way was labelled, or not, by the old one

    def _current_bc_coef(self) -> float:
        return float(self.bc_coef(self._current_progress_remaining))  # type: ignore[operator]

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, BaseCallback]:
        if self.expert is None and self._ever_clones():
            raise ExpertError(
                "PPOBC needs an expert to clone: PPOBC(..., expert=PIDExpert()), model.set_expert(...), or bc_coef=0"
            )
        result = super()._setup_learn(*args, **kwargs)
        if self.expert is not None:
            assert self.env is not None
            self._labeller = ExpertLabeller(self.expert, self.env)
        return result

    def collect_rollouts(
        self, env: VecEnv, callback: BaseCallback, rollout_buffer: RolloutBuffer, n_rollout_steps: int
    ) -> bool:
        if self._next_bc_coef is not None:
            self.bc_coef, self._next_bc_coef = FloatSchedule(self._next_bc_coef), None
        if self._labelling and self._labeller is not None and self._labeller.needs_state:
            observation: Any = self._last_obs
            self._labels = self._labeller.labels(observation)  # the first step's state, before it
        return super().collect_rollouts(env, callback, rollout_buffer, n_rollout_steps)

    @property
    def _labelling(self) -> bool:
        return self._labeller is not None and self._current_bc_coef() != 0.0

    def _update_info_buffer(self, infos: list[dict[str, Any]], dones: np.ndarray | None = None) -> None:
        """Called by ``collect_rollouts`` after ``env.step`` and before ``rollout_buffer.add``: writes the step's labels.

        They belong to the state before the step: an expert on observations is asked now, since ``_last_obs`` is still that
        observation; an expert on the true state was asked before the step, and now for the step to come.
        """
        super()._update_info_buffer(infos, dones)
        if not self._labelling:
            return
        assert self._labeller is not None and isinstance(self.rollout_buffer, ExpertRolloutBuffer)
        observation: Any = self._last_obs
        if self._labeller.needs_state:
            self.rollout_buffer.expert_actions[self.rollout_buffer.pos] = self._labels
            self._labels = self._labeller.labels(observation)
        else:
            self.rollout_buffer.expert_actions[self.rollout_buffer.pos] = self._labeller.labels(observation)

    @property
    def _adds_nothing(self) -> bool:
        """Whether the loss is PPO's own, from the first update to the last."""
        cloning = self._labeller is not None and self._ever_clones()
        own_value_loss = self.clip_range_vf is not None and self.max_clipped_value
        return not (cloning or own_value_loss or self.l2_coef > 0.0 or self.critic_warmup > 0)

    def _ever_clones(self) -> bool:
        return any(FloatSchedule(self.bc_coef)(progress) for progress in (1.0, 0.5, 0.0))

    def train(self) -> None:
        """One update on the current rollout; without any addition, ``PPO.train`` itself."""
        if self._adds_nothing:
            self._train_as_ppo()
            return
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        weights = self._weights()
        warming_up = self._n_rollouts_trained < self.critic_warmup
        parameters = list(self.policy.parameters())
        grad_norms: dict[str, float] = {}
        monitored: list[dict[str, th.Tensor]] = []
        stopped = False

        for epoch in range(self.n_epochs):
            first = len(monitored)
            for samples in self.rollout_buffer.get(self.batch_size):
                terms = loss_terms(self.policy, cast(ExpertRolloutBufferSamples, samples), weights)
                loss = terms.weighted["value"] if warming_up else th.stack(list(terms.weighted.values())).sum()
                monitored.append({"loss": loss.detach(), **terms.monitored})
                self._check_finite(loss, terms)
                if not grad_norms:
                    grad_norms = gradient_norms(terms.weighted, parameters)
                kl = terms.monitored["approx_kl"]
                if self.target_kl is not None and kl > 1.5 * self.target_kl:
                    stopped = True
                    if self.verbose >= 1:
                        print(f"Early stopping at step {epoch} due to reaching max kl: {kl:.2f}")
                    break
                self.policy.optimizer.zero_grad()
                loss.backward()  # type: ignore[no-untyped-call]
                th.nn.utils.clip_grad_norm_(parameters, self.max_grad_norm)
                self.policy.optimizer.step()
            self._n_updates += 1
            if stopped:
                break
        self._n_rollouts_trained += 1
        self._record(monitored, first, weights, grad_norms)

    def _train_as_ppo(self) -> None:
        """``PPO.train``, which goes on after a loss that is not finite: the parameters from before it are put back then."""
        before = [parameter.detach().clone() for parameter in self.policy.parameters()]
        try:
            super().train()
        except ValueError:  # of a distribution whose parameters are NaN
            finite = False
        else:
            finite = all(bool(th.isfinite(parameter).all()) for parameter in self.policy.parameters())
        if not finite:
            with th.no_grad():
                for parameter, old in zip(self.policy.parameters(), before, strict=True):
                    parameter.copy_(old)
            raise TrainingError(f"the loss is not finite after {self.num_timesteps} steps: try a smaller learning_rate")

    def _weights(self) -> Weights:
        progress = self._current_progress_remaining
        return Weights(
            clip_range=self.clip_range(progress),  # type: ignore[operator]
            clip_range_vf=None if self.clip_range_vf is None else self.clip_range_vf(progress),  # type: ignore[operator]
            max_clipped_value=self.max_clipped_value,
            normalize_advantage=self.normalize_advantage,
            vf_coef=self.vf_coef,
            ent_coef=self.ent_coef,
            bc_coef=self._current_bc_coef() if self._labeller is not None else 0.0,
            bc_loss=self.bc_loss,
            bc_filter=self.bc_filter,
            l2_coef=self.l2_coef,
        )

    def _check_finite(self, loss: th.Tensor, terms: LossTerms) -> None:
        if not th.isfinite(loss):
            raise TrainingError(
                f"the loss is {loss.item()} after {self.num_timesteps} steps (policy "
                f"{terms.monitored['policy_gradient_loss'].item():.3g}, value {terms.monitored['value_loss'].item():.3g}): "
                "try a smaller learning_rate or bc_coef, and check the expert's actions"
            )

    def _record(
        self, monitored: list[dict[str, th.Tensor]], first: int, weights: Weights, grad_norms: dict[str, float]
    ) -> None:
        """Log an update under PPO's names. As there, ``approx_kl`` is of the last epoch, which began at row ``first``."""
        for name in monitored[0]:
            rows = monitored[-1:] if name == "loss" else monitored[first:] if name == "approx_kl" else monitored
            self.logger.record(f"train/{name}", th.stack([row[name] for row in rows]).mean().item())
        values, returns = self.rollout_buffer.values.flatten(), self.rollout_buffer.returns.flatten()
        self.logger.record("train/explained_variance", explained_variance(values, returns))
        if hasattr(self.policy, "log_std"):
            self.logger.record("train/std", th.exp(self.policy.log_std).mean().item())
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/clip_range", weights.clip_range)
        if weights.clip_range_vf is not None:
            self.logger.record("train/clip_range_vf", weights.clip_range_vf)
        self.logger.record("train/bc_coef", weights.bc_coef)
        for name, norm in grad_norms.items():
            self.logger.record(f"train/grad_norm_{name}", norm)

    def learn(
        self: SelfPPOBC,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1,
        tb_log_name: str = "PPOBC",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfPPOBC:
        """As ``PPO.learn``; see the class for what it raises."""
        return super().learn(
            total_timesteps=total_timesteps,
            callback=callback,
            log_interval=log_interval,
            tb_log_name=tb_log_name,
            reset_num_timesteps=reset_num_timesteps,
            progress_bar=progress_bar,
        )
