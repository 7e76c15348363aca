"""PPO with a weighted behavioural-cloning loss towards an expert: stage two of the thesis (4.2.2, Eq. 4.4)."""

import functools
from collections.abc import Callable, Mapping
from typing import Any, cast
from unittest.mock import patch

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import MaybeCallback, Schedule
from stable_baselines3.common.utils import FloatSchedule, explained_variance
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn
from torch.nn import functional as F
from typing_extensions import Self

from sb3_quad.algorithms import common
from sb3_quad.algorithms.buffer import ExpertRolloutBuffer
from sb3_quad.algorithms.networks import shared_out
from sb3_quad.base.arrays import Float32Array, FloatArray, IntArray
from sb3_quad.base.errors import ConfigError, ExpertError, TrainingError, unknown
from sb3_quad.controllers.controller import Controller

BC_FILTERS = ("none", "negative_advantage", "agreement")


class PPOBC(common.Taught, PPO):
    """Proximal Policy Optimization with a weighted behavioural-cloning loss (PPO+BC).

    The minimised loss is Eq. 4.4 of the thesis: PPO-clip + c_v · value loss + c_L2 · ½Σw² − c_H · entropy + c_BC · L_BC.
    The thesis has three errata here, followed as they are meant: Eq. 3.5 prints the probability ratio as a difference of logs
    (the ratio is its exponential); Eq. 3.6 is a maximised objective; Eq. 4.4 prints + c_H H, while entropy is encouraged.

    All arguments of :class:`stable_baselines3.PPO` keep their meaning and defaults. An update that adds nothing (a cloning
    weight and an ``l2_coef`` of 0, no ``critic_warmup``, and either no ``clip_range_vf`` or ``max_clipped_value=False``) is
    PPO's, bit for bit; any other is equal to PPO's to rounding, plus what is added, in less time (docs/results.md). A saved
    model loads with ``PPO.load``, even where this package is not installed.

    :param expert: who labels the visited states: an object with ``actions(state)`` on the true state of our environments,
        an SB3 model, or a callable from observations to actions. Needed when learning starts with a cloning weight.
    :param bc_coef: c_BC, the weight of the cloning term: a float or a schedule of the remaining progress (SB3's
        ``LinearSchedule(0.1, 0.0, 0.5)`` falls from 0.1 to 0 over the first half).
    :param bc_loss: ``"nll"``, the negative log-likelihood of the expert's action (Eq. 3.12), a sum over the action's
        dimensions; ``"mse"``, the squared error of the policy's mean action, which leaves the deviation alone;
        ``"huber"``, that is linear beyond 0.05; or ``"huber_mse"``, that and three times the squared error.
    :param bc_filter: where to clone: ``"none"``, everywhere; ``"negative_advantage"``, where the flown action did worse than
        the critic expected; ``"agreement"``, where expert and policy differ by less than 0.3 (root mean square over the
        action): an expert for small angles, such as the PID, then holds the agent on its way to the target and has no say
        where the agent has learnt to recover and the expert would crash.
    :param l2_coef: c_L2, weight of ½Σw² over the weight matrices (Eq. 2.25); biases and ``log_std`` are left out.
    :param max_clipped_value: the value loss of Eq. 3.8, the larger of the clipped and the unclipped error, where
        ``clip_range_vf`` is given; False for stock PPO's clipped error.
    :param critic_warmup: for this many rollouts only the critic learns. A critic that comes from another task, or from another
        policy, would otherwise spoil the actor with its first advantages.
    :param shuffle: whether mini-batches are random. False: consecutive in time, as the thesis prepares them
        ("chronologically", 4.2.3).
    :raises ConfigError: a value out of range, a name that is not known, or a space that is not supported, when built.
    :raises ExpertError: when learning starts, or at the latest with the first rollout that is to be cloned: no expert, or
        one whose labels do not fit.
    :raises TrainingError: a loss or gradient that is not finite; the parameters are those of the step before.
    """

    def __init__(
        self,
        *args: Any,
        expert: Any = None,
        bc_coef: float | Schedule = 0.005,
        bc_loss: common.CloningLoss = "nll",
        bc_filter: str = "none",
        l2_coef: float = 0.0,
        max_clipped_value: bool = True,
        critic_warmup: int = 0,
        shuffle: bool = True,
        _init_setup_model: bool = True,
        **kwargs: Any,
    ):
        super().__init__(*args, _init_setup_model=False, **kwargs)  # type: ignore[misc]
        if bc_loss not in common.CLONING_LOSSES:
            raise ConfigError(unknown("bc_loss", bc_loss, common.CLONING_LOSSES))
        if bc_filter not in BC_FILTERS:
            raise ConfigError(unknown("bc_filter", bc_filter, BC_FILTERS))
        if not l2_coef >= 0:
            raise ConfigError(f"l2_coef is {l2_coef}, must be at least 0")
        if critic_warmup < 0:
            raise ConfigError(f"critic_warmup is {critic_warmup} rollouts, must be at least 0")
        self.expert = expert
        self.bc_coef = bc_coef
        self.bc_loss: common.CloningLoss = bc_loss
        self.bc_filter = bc_filter
        self.l2_coef = l2_coef
        self.max_clipped_value = max_clipped_value
        self.critic_warmup = critic_warmup
        self.shuffle = shuffle
        self._n_rollouts_trained = 0
        self._rollout_bc_coef = 0.0  # the weight in the update on the present rollout, which is labelled if there is one

        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        if isinstance(self.observation_space, spaces.Dict):
            raise ConfigError(
                f"observation space {self.observation_space}: PPOBC does not support Dict; wrap the environment in "
                "gymnasium.wrappers.FlattenObservation"
            )
        if self.rollout_buffer_class is None:
            self.rollout_buffer_class = ExpertRolloutBuffer
        super()._setup_model()
        if not isinstance(self.action_space, spaces.Box) and self.expert is not None:
            raise ConfigError(f"PPOBC clones into a Box action space only, this environment has {self.action_space}")
        self.bc_coef = FloatSchedule(self.bc_coef)
        if self.expert is not None and self.will_clone():
            self._check_cloning()

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "rollout_buffer_class", "rollout_buffer_kwargs"]

    @property
    def policy_is_idle(self) -> bool:
        """Whether the policy is still the one that it began with, since only the critic has learnt (``critic_warmup``)."""
        return 0 < self.critic_warmup >= self._n_rollouts_trained

    def set_bc_coef(self, bc_coef: float) -> None:
        """Weigh the cloning term with ``bc_coef`` from the next rollout on, instead of the schedule given before.

        :raises ConfigError: a weight that is negative or not finite.
        :raises ExpertError: a weight, and no expert.
        """
        if not 0.0 <= bc_coef < float("inf"):
            raise ConfigError(f"bc_coef is {bc_coef}, must be finite and at least 0")
        if bc_coef > 0.0:
            self._check_cloning()
        self.bc_coef = FloatSchedule(bc_coef)  # a rollout under way keeps the weight by which it was labelled, or not

    def will_clone(self) -> bool:
        """Whether the schedule gives the cloning term a weight anywhere, as far as a hundred samples of it tell."""
        return common.is_ever_nonzero(self.bc_coef)  # type: ignore[arg-type]

    def _check_cloning(self) -> None:
        if self.expert is None:
            raise ExpertError(
                "PPOBC needs an expert to clone: PPOBC(..., expert=GeometricExpert()), model.set_expert(...), or bc_coef=0"
            )
        if self.use_sde and self.bc_loss == "nll":
            raise ConfigError("use_sde: bc_loss 'nll' needs a diagonal Gaussian policy; use bc_loss='mse', for example")

    def collect_rollouts(
        self, env: VecEnv, callback: BaseCallback, rollout_buffer: RolloutBuffer, n_rollout_steps: int
    ) -> bool:
        # The update on this rollout comes at its end, and with the weight of that time: that weight decides about labels.
        end = self.num_timesteps + n_rollout_steps * env.num_envs
        self._rollout_bc_coef = float(self.bc_coef(1.0 - float(end) / float(self._total_timesteps)))  # type: ignore[operator]
        if self._rollout_bc_coef == 0.0:
            self._labeller = None  # an expert that has not seen a rollout remembers nothing
        else:
            self._labeller = labeller = Controller.for_env(self.expert, env, self._labeller)
            buffer = cast(ExpertRolloutBuffer, rollout_buffer)

            def label() -> None:
                observation: Any = self._last_obs
                buffer.expert_actions[buffer.pos] = labeller.labels(observation, self._last_episode_starts)

            env = _BeforeStep(env, label)
        networks = common.perceptrons(self.policy) if self._rollout_bc_coef != 0.0 else None  # else as PPO, bit for bit
        if networks is None:
            return super().collect_rollouts(env, callback, rollout_buffer, n_rollout_steps)
        with patch.object(self.policy, "forward", functools.partial(common.act, networks, self.policy)):
            return super().collect_rollouts(env, callback, rollout_buffer, n_rollout_steps)

    def train(self) -> None:
        """One update on the rollout just flown: PPO's loop, with what is added to it marked by ``+``."""
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        progress = self._current_progress_remaining
        clip_range = self.clip_range(progress)  # type: ignore[operator]
        clip_range_vf = None if self.clip_range_vf is None else self.clip_range_vf(progress)  # type: ignore[operator]
        # + What is added, if anything is.
        bc_coef, warming_up = self._rollout_bc_coef, self._n_rollouts_trained < self.critic_warmup
        own_value_loss = clip_range_vf is not None and self.max_clipped_value
        adds = bc_coef != 0.0 or self.l2_coef > 0.0 or own_value_loss or warming_up

        # + Perceptrons get most gradients from compiled code, which takes half the time of PyTorch's layers.
        buffer = cast(ExpertRolloutBuffer, self.rollout_buffer)
        networks = common.perceptrons(self.policy) if adds and type(buffer) is ExpertRolloutBuffer else None
        targets: tuple[Float32Array, Float32Array, Float32Array] | None = None

        parameters = list(self.policy.parameters())
        monitored: list[dict[str, th.Tensor]] = []  # by mini-batch: scalars for the logger, under SB3's names
        grad_norms: dict[str, float] = {}
        continue_training = True

        for epoch in range(self.n_epochs):
            first = len(monitored)
            for index in buffer.indices(self.batch_size, self.shuffle):
                if networks is not None:  # +
                    targets = targets or buffer.targets(labelled=bc_coef != 0.0)
                    coefs = (bc_coef, clip_range, clip_range_vf)
                    norms = None if monitored else grad_norms
                    monitored.append(self._compiled_gradients(networks, targets, index, *coefs, warming_up, norms))
                    if not self._take_step(monitored[-1], parameters, epoch):
                        continue_training = False
                        break
                    continue
                samples, expert_actions = buffer.samples(index)
                actions = samples.actions
                if isinstance(self.action_space, spaces.Discrete):
                    actions = actions.long().flatten()

                entropy: th.Tensor | None
                if adds:  # + in less time, and with the mean action
                    values, log_prob, entropy, mean = common.evaluate_actions(self.policy, samples.observations, actions)
                else:
                    try:
                        values, log_prob, entropy = self.policy.evaluate_actions(samples.observations, actions)
                    except ValueError as error:  # + of a distribution whose mean is not finite
                        raise self._diverged("the policy is no longer finite") from error
                    values = values.flatten()

                advantages = samples.advantages
                if self.normalize_advantage and len(advantages) > 1:
                    advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)

                # The clipped surrogate loss; the ratio of new and old policy is one at first.
                log_ratio = log_prob - samples.old_log_prob
                ratio = log_ratio.exp()
                clipped = ratio.clamp(1 - clip_range, 1 + clip_range)
                policy_loss = -th.min(advantages * ratio, advantages * clipped).mean()

                if clip_range_vf is None:
                    value_loss = F.mse_loss(samples.returns, values)
                elif self.max_clipped_value:  # + Eq. 3.8
                    value_loss = common.value_loss(values, samples.old_values, samples.returns, clip_range_vf)
                else:
                    change = (values - samples.old_values).clamp(-clip_range_vf, clip_range_vf)
                    value_loss = F.mse_loss(samples.returns, samples.old_values + change)

                entropy_loss = log_prob.mean() if entropy is None else -entropy.mean()

                terms = {"policy": policy_loss, "value": self.vf_coef * value_loss}
                if self.ent_coef != 0.0:
                    terms["entropy"] = self.ent_coef * entropy_loss
                with th.no_grad():
                    approx_kl = (ratio - 1 - log_ratio).mean()
                    clip_fraction = ((ratio - 1).abs() > clip_range).float().mean()
                logged = {
                    "policy_gradient_loss": policy_loss,
                    "value_loss": value_loss,
                    "entropy_loss": entropy_loss,
                    "approx_kl": approx_kl,
                    "clip_fraction": clip_fraction,
                }
                if bc_coef != 0.0:  # +
                    logged["bc_loss"] = self._bc_loss(mean, expert_actions, samples.advantages)
                    terms["bc"] = bc_coef * logged["bc_loss"]
                if self.l2_coef > 0.0:  # +
                    logged["l2_loss"] = common.l2_loss(self.policy)
                    terms["l2"] = self.l2_coef * logged["l2_loss"]
                loss = terms["value"] if warming_up else th.stack(list(terms.values())).sum()  # + warming_up
                monitored.append({name: value.detach() for name, value in {"loss": loss, **logged}.items()})
                if adds and not grad_norms:  # +
                    grad_norms = _gradient_norms(terms, parameters)

                self.policy.optimizer.zero_grad()
                loss.backward()  # type: ignore[no-untyped-call]
                if not self._take_step(monitored[-1], parameters, epoch):
                    continue_training = False
                    break

            self._n_updates += 1
            if not continue_training:
                break

        self._n_rollouts_trained += 1
        for name in monitored[0]:  # as in PPO, approx_kl is of the last epoch and loss of the last mini-batch
            rows = monitored[-1:] if name == "loss" else monitored[first:] if name == "approx_kl" else monitored
            self.logger.record(f"train/{name}", th.stack([row[name] for row in rows]).mean().item())
        old_values, returns = self.rollout_buffer.values.flatten(), self.rollout_buffer.returns.flatten()
        self.logger.record("train/explained_variance", explained_variance(old_values, returns))
        if hasattr(self.policy, "log_std"):
            self.logger.record("train/std", th.exp(self.policy.log_std).mean().item())
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/clip_range", clip_range)
        if clip_range_vf is not None:
            self.logger.record("train/clip_range_vf", clip_range_vf)
        self.logger.record("train/bc_coef", bc_coef)  # +
        for name, value in grad_norms.items():  # +
            self.logger.record(f"train/grad_norm_{name}", value)

    def _take_step(self, monitored: Mapping[str, th.Tensor], parameters: list[th.nn.Parameter], epoch: int) -> bool:
        """Clip the gradients and let the optimiser take its step, unless ``target_kl`` ends the update; whether it goes on."""
        if self.target_kl is not None and monitored["approx_kl"] > 1.5 * self.target_kl:
            if self.verbose >= 1:
                print(f"Early stopping at step {epoch} due to reaching max kl: {monitored['approx_kl']:.2f}")
            return False
        norm = th.nn.utils.clip_grad_norm_(parameters, self.max_grad_norm)
        if not (th.isfinite(monitored["loss"]) and th.isfinite(norm)):  # +
            policy, value = (monitored[name].item() for name in ("policy_gradient_loss", "value_loss"))
            parts = f"policy {policy:.3g}, value {value:.3g}, gradient {norm.item():.3g}"
            raise self._diverged(f"the loss is {monitored['loss'].item():.3g} ({parts})")
        self.policy.optimizer.step()
        return True

    def _compiled_gradients(
        self,
        networks: common.Perceptrons,
        targets: tuple[Float32Array, Float32Array, Float32Array],
        index: IntArray,
        bc_coef: float,
        clip_range: float,
        clip_range_vf: float | None,
        warming_up: bool,
        norms: dict[str, float] | None,
    ) -> dict[str, th.Tensor]:
        """Set the gradients of Eq. 4.4 for rows of the rollout, by compiled code; returns what the logger gets.

        :param targets: see :meth:`ExpertRolloutBuffer.targets`.
        :param norms: gets the norm of each term's own gradient, as :func:`_gradient_norms` gives it.
        """
        observations, for_actor, for_critic = targets
        shift, scale = 0.0, 1.0
        if self.normalize_advantage and len(index) > 1:
            advantages = for_actor[index, -1]
            shift, scale = float(advantages.mean()), 1.0 / (float(advantages.std(ddof=1)) + 1e-8)
        rows: dict[str, float] = {"clip_range": clip_range, "shift": shift, "scale": scale}
        rows |= {"filter": BC_FILTERS.index(self.bc_filter), "agreement": common.AGREEMENT}

        def of_actor(cloning: float, policy: float) -> FloatArray:
            terms = common.actor_terms(self.bc_loss, cloning, policy=policy, labelled=bc_coef != 0.0, **rows)
            return networks.actor.gradient(observations, index, for_actor, terms, networks.log_std) / len(index)

        own = [*networks.actor.parameters(), networks.log_std]
        if norms is not None:
            for name, weights in {"policy": (0.0, 1.0), "bc": (bc_coef, 0.0)}.items():
                if any(weights):
                    of_actor(*weights)
                    norms[name] = _norm(own)
        sums = of_actor(bc_coef, 1.0)
        critic = common.critic_terms(self.vf_coef, clip_range_vf, self.max_clipped_value)
        value = networks.critic.gradient(observations, index, for_critic, critic)[0] / len(index)
        if norms is not None:
            norms["value"] = _norm([*networks.critic.parameters()])
        if warming_up:
            for parameter in own:
                parameter.grad = None
        entropy, l2 = common.add_penalties(
            self.policy, 0.0 if warming_up else self.ent_coef, 0.0 if warming_up else self.l2_coef
        )
        if norms is not None and self.ent_coef != 0.0:
            norms["entropy"] = abs(self.ent_coef) * len(networks.log_std) ** 0.5
        if norms is not None and self.l2_coef > 0.0:
            norms["l2"] = self.l2_coef * (2.0 * l2) ** 0.5
        bc, policy, kl, clipped = sums[:4]
        logged = {"policy_gradient_loss": policy, "value_loss": value, "entropy_loss": entropy}
        logged |= {"approx_kl": kl, "clip_fraction": clipped}
        loss = self.vf_coef * value
        if bc_coef != 0.0:
            logged["bc_loss"] = bc
        if self.l2_coef > 0.0:
            logged["l2_loss"] = l2
        if not warming_up:
            loss += policy + self.ent_coef * entropy + bc_coef * bc + self.l2_coef * l2
        return {name: th.tensor(number, dtype=th.float32) for name, number in {"loss": loss, **logged}.items()}

    def _diverged(self, what: str) -> TrainingError:
        advice = "try a smaller learning_rate or bc_coef, and check the expert's actions"
        return TrainingError(f"{what} after {self.num_timesteps} timesteps: {advice}")

    def _bc_loss(self, mean: th.Tensor, expert_actions: th.Tensor, advantages: th.Tensor) -> th.Tensor:
        """L_BC of Eq. 3.12 over the mini-batch, a scalar; rows that the filter leaves out count as zero.

        :param mean: the policy's mean actions, (batch_size, action_dim), as the expert's.
        :param advantages: (batch_size,), before they are normalised.
        """
        errors = common.cloning_errors(self.bc_loss, mean, self.policy.log_std, expert_actions)
        if self.bc_filter == "negative_advantage":
            errors = errors * (advantages < 0)
        elif self.bc_filter == "agreement":
            errors = errors * common.agree(mean, expert_actions)
        return errors.mean()

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1,
        tb_log_name: str = "PPOBC",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """As ``PPO.learn``; see the class for what it raises."""
        if self.will_clone():
            self._check_cloning()
        with shared_out(common.perceptrons(self.policy) is not None):
            return super().learn(
                total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar=progress_bar
            )


class _BeforeStep(VecEnvWrapper):
    """Calls a function before each step: where an expert can still see the state that the step leaves."""

    def __init__(self, env: VecEnv, call: Callable[[], None]) -> None:
        super().__init__(env)
        self._call = call

    def reset(self) -> VecEnvObs:
        return self.venv.reset()

    def step_async(self, actions: np.ndarray) -> None:
        self._call()
        self.venv.step_async(actions)

    def step_wait(self) -> VecEnvStepReturn:
        return self.venv.step_wait()


def _gradient_norms(terms: Mapping[str, th.Tensor], parameters: list[th.nn.Parameter]) -> dict[str, float]:
    """The norm of each term's own gradient over all parameters; the graph stays for the real backward pass.

    PPO's gradient clip is joint: these numbers show which term pulls how hard, and whether one starves the others.
    """
    norms = {}
    for name, term in terms.items():
        gradients = th.autograd.grad(term, parameters, retain_graph=True, allow_unused=True)
        squares = [gradient.square().sum() for gradient in gradients if gradient is not None]
        norms[name] = float(th.stack(squares).sum().sqrt()) if squares else 0.0
    return norms


def _norm(parameters: list[th.nn.Parameter]) -> float:
    return float(th.stack([each.grad.norm() for each in parameters if each.grad is not None]).norm())


PPOBC.__init__.__signature__ = common.full_signature(PPO, PPOBC)  # type: ignore[attr-defined]
