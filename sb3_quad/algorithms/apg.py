"""Analytic policy gradient: an agent learns from the exact gradient of its flights' cost."""

import math
import warnings
from collections import deque
from collections.abc import Callable
from typing import Annotated, Any, Protocol

import numpy as np
import torch as th
from gymnasium import spaces
from pydantic import Field
from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv, VecMonitor
from typing_extensions import Self

from sb3_quad.algorithms.common import (
    ExpertMixin,
    History,
    RateOrSchedule,
    model_of,
    policy_arguments,
)
from sb3_quad.algorithms.networks import network_of
from sb3_quad.algorithms.soap import SOAP
from sb3_quad.base.compiled import compiled
from sb3_quad.base.errors import ConfigError, TrainingError, raised_as
from sb3_quad.base.types import BoolArray, Float32Array, FloatArray, StrDict, StrPath
from sb3_quad.base.validate import Count, Weight

# An update is undone if its cost lies this many usual changes above the least so far, or if its
# step moves the mean actions further than this. In ordinary trainings 4.2 was reached, and 0.02.
COST_RISE = 8.0
ACTION_CHANGE = 0.2
# What the usual change of the cost between two updates begins with, and what it is at least, as
# shares of the cost
FIRST_CHANGE = 0.05
LEAST_CHANGE = 0.02
# Share of the least cost that an update forgets, since each one has other starts
FORGOTTEN = 0.02
# The mean actions are compared at every so many recorded steps.
COMPARED = 32


class Tape(Protocol):
    """Records flights of n environments, and carries gradients back through their steps.

    An environment that ``APG`` can train on has ``record(n_steps, substeps)``, which returns one.
    Where ``APG`` is given a ``cost``, a ``calm_coef`` or ``end_at_ground=False``, ``record`` gets
    it by that keyword.
    To record, call :meth:`reset`, then :meth:`step` once for each step. For the backward pass, call
    :meth:`begin`, then :meth:`backward` once for each step, the last one first.
    """

    def reset(self, continue_flights: bool) -> Float32Array:
        """Begin a recording; return the observations, (n, ...).

        :param continue_flights: whether to continue the flights of the last recording where
            possible.
        """

    def step(self, actions: Float32Array) -> Float32Array:
        """Take a step with actions (n, a); return the observations after it, (n, ...)."""

    def episodes(self) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Return each flight's sum of rewards, its length, and whether it was lost, (n,) each."""

    def begin(self) -> float:
        """Begin the backward pass; return the mean cost of a step."""

    def backward(self, step: int, grad_observation: Float32Array) -> FloatArray:
        """Return the gradient of the mean cost with respect to the actions of a step, (n, a).

        It includes the effect of these actions on later steps, which the tape tracks.

        :param grad_observation: the gradient with respect to the observations after the step, (n,
            ...). It arises from the actions that the policy computed from them.
        """


class APG(ExpertMixin, OnPolicyAlgorithm):
    """Analytic policy gradient (APG): differentiate whole flights, and descend.

    The equations of motion are known and smooth, so the gradient of a flight's cost with respect to
    the policy's weights can be computed exactly: the flight is recorded, then the derivative is
    carried back through policy, observation, delay, rotors and rigid body. There is no critic,
    no exploration and no teacher. Related methods are backpropagation through time (Werbos, 1990),
    SHAC (Xu et al., 2022), which adds a critic to short windows, and Heeg, Song and Scaramuzza,
    "Learning Quadrotor Control From Visual Features Using Differentiable Simulation" (2024).

    In each update every environment flies ``n_steps`` control steps with the mean action of the
    policy. The optimiser then takes one step along the gradient of the mean cost. It is
    :class:`~sb3_quad.algorithms.soap.SOAP`, unless ``policy_kwargs`` has an ``optimizer_class``.
    Only the actor learns; the critic stays as it is.

    An update is undone if its cost lies far above the least so far (by more than 8 times the usual
    change between two updates), or if its step moves the mean actions over the recorded
    observations by more than 0.2 (root mean square). A warning says so, the best weights come back,
    and the optimiser begins again at half the learning rate. The least cost is forgotten slowly,
    since each update has other starts. If the best weights then fly as badly, the task has become
    harder, and the rate is what it was. With ``continue_flights`` the cost depends on where the
    windows begin, so only the step is judged.

    ``env`` must be differentiable: a :class:`~sb3_quad.envs.vec_env.QuadcopterVecEnv` with any of
    its settings, or an environment of your own whose ``record(n_steps, substeps)`` returns a
    :class:`Tape`; docs/apg.md shows one.
    A saved model loads with ``PPO.load``, even where this package is not installed.

    Arguments that are not listed here mean what they mean in :class:`stable_baselines3.PPO`.

    :param learning_rate: A rate, or a schedule of the remaining progress. The default falls to
        a fiftieth.
    :param n_steps: Control steps of each flight in an update. A whole flight takes about 300.
    :param max_grad_norm: The gradient is scaled down to this norm if it is larger.
    :param max_row_ratio: At each step, the gradient with respect to the actions of each environment
        is limited to this many times the median norm over all environments, since a few flights on
        the verge of chaos would otherwise outweigh all others. Where each episode has another
        vehicle, 3 is a good value. None: no limit.
    :param stats_window_size: Number of flights that the values of ``rollout/`` average over; at
        least all flights of an update.
    :param initial_policy: The agent to start from: a model, the path of a zip, or the name of a
        shipped agent. Learning whole flights from scratch works badly: clone an expert first
        (DAgger), or fly short windows with ``continue_flights`` at a rate such as 6e-3.
    :param continue_flights: Let each update continue the flights of the one before. A flight that
        crashed or reached its time limit begins again.
    :param end_at_ground: Whether a flight that crashes ends there. It then has no gradient that
        says how to save it. False: it counts as lost, but the recording continues below the ground,
        where the cost grows with the depth; for vehicles that need most of their height to recover.
    :param cost: The cost of each control step, (steps, n), as a function of what the environment
        records, in PyTorch; in ours, of :class:`~sb3_quad.envs.flight_cost.FlownStates`. It is not
        saved: give it to ``load`` as well. None: the environment's own, which is
        :func:`~sb3_quad.envs.flight_cost.flight_cost` in ours.
    :param calm_coef: Weight of :func:`~sb3_quad.envs.flight_cost.calm_cost`, which is added to the
        cost: for agents that swing or buzz at the target, such as with slow motors or long delays.
    :param substeps: Physics steps per control step during training; None: the vehicle's.
    :raises ConfigError: an argument out of range, or an environment that cannot be differentiated.
    :raises TrainingError: a non-finite gradient, even in a single environment.
    """

    policy_aliases = PPO.policy_aliases
    # If they were saved, algorithms with a critic would adopt these placeholders.
    _not_saved = (
        *("cost", "_tape", "_network", "_recorded_policy", "_compared"),
        *("gamma", "gae_lambda", "ent_coef", "vf_coef"),
    )
    _tape: Tape
    # Observations of some recorded steps, and the mean actions there
    _compared: list[tuple[Float32Array, Float32Array]]
    # The least cost so far, whose weights are in the optimiser's state; None: the next one
    _least_cost: float | None = None
    _last_cost = 0.0
    _usual_change = 0.0
    # If the best weights cost more than this when they are back, they are not to blame.
    _blamed_cost = np.inf
    _n_undone = 0

    def __init__(
        self,
        policy: str | type[ActorCriticPolicy],
        env: GymEnv | str,
        learning_rate: RateOrSchedule = LinearSchedule(2e-4, 4e-6, 1.0),  # noqa: B008
        n_steps: Count = 300,
        max_grad_norm: Weight = 1.0,
        stats_window_size: Count = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: StrDict | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        *,
        initial_policy: BaseAlgorithm | StrPath | None = None,
        max_row_ratio: Annotated[float, Field(ge=1.0)] | None = 10.0,
        continue_flights: bool = False,
        end_at_ground: bool = True,
        cost: Callable[[Any], th.Tensor] | None = None,
        calm_coef: Weight = 0.0,
        substeps: Count | None = 2,
        _init_setup_model: bool = True,
    ):
        initial = model_of(initial_policy)
        super().__init__(
            policy,
            env,
            learning_rate,
            n_steps=n_steps,
            gamma=1.0,
            gae_lambda=1.0,
            ent_coef=0.0,
            vf_coef=0.0,
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
            _init_setup_model=False,
        )
        self.max_row_ratio = max_row_ratio
        self.continue_flights = continue_flights
        self.end_at_ground = end_at_ground
        self.cost = cost
        self.own_cost = False
        self.calm_coef = calm_coef
        self.substeps = substeps

        if _init_setup_model:
            self._set_up(initial)

    def _setup_model(self) -> None:
        if self.cost is not None and not callable(self.cost):
            raise ConfigError(
                f"cost {self.cost!r}: must be a function; leave it out for the default"
            )
        # A zip may have set this already, for a cost that it does not contain.
        self.own_cost |= self.cost is not None
        super()._setup_model()
        # SOAP stays out of policy_kwargs, so that a zip loads where this package is missing.
        if "optimizer_class" not in self.policy_kwargs:
            policy = self.policy
            rate = self.lr_schedule(1.0)
            unfit = "optimizer_kwargs: SOAP takes betas and eps; give an optimizer_class for others"
            with raised_as(ConfigError, unfit):
                policy.optimizer = SOAP(policy.parameters(), rate, **policy.optimizer_kwargs)

    def will_clone(self) -> bool:
        """Return False: the gradient needs no expert."""
        return False

    def _shows_in_returns(self) -> bool:
        """Return whether the reward says what the cost says."""
        return not self.own_cost

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 10,
        tb_log_name: str = "APG",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """Train for ``total_timesteps``; all arguments are those of SB3's ``learn``.

        :raises ConfigError: an environment that cannot be differentiated.
        """
        assert self.env is not None
        env: Any = self.env
        # The statistics of episodes come from the tape.
        if isinstance(env, VecMonitor):
            if env.results_writer is not None:
                raise ConfigError(
                    "VecMonitor: APG's flights bypass it, so its file would stay empty;"
                    " remove filename"
                )
            env = env.venv
        if env is not env.unwrapped:
            raise ConfigError(
                f"{type(env).__name__}: APG differentiates the environment below its wrappers, so"
                " this one would have no effect; remove it, and give a reward of your own as a cost"
            )
        if not hasattr(env, "record"):
            raise ConfigError(
                f"{type(env).__name__}: APG differentiates flights, and this environment has no"
                " record(n_steps, substeps); use QuadcopterVecEnv, or see docs/apg.md"
            )
        if self.own_cost and self.cost is None:
            raise ConfigError(
                "cost: this agent was trained with a cost of your own, which no zip holds; give it"
                " to APG.load(..., cost=...), or own_cost=False for the default"
            )
        self.own_cost = self.cost is not None
        if self.expert is not None:
            raise ConfigError("expert: APG asks none; give it to DAgger or PPOBC")
        options: StrDict = {}
        if self.cost is not None:
            options["cost"] = self.cost
        if self.calm_coef:
            options["calm_coef"] = self.calm_coef
        if not self.end_at_ground:
            options["end_at_ground"] = False
        # The user's own environment may know none of them.
        unfit = f"{type(env).__name__}: does not record with {[*options]}"
        with raised_as(ConfigError, unfit):
            self._tape = env.record(self.n_steps, self.substeps, **options)
        self._network = network_of(self.policy)
        self._recorded_policy = self._network.recorded(self.n_steps, self.n_envs)
        if reset_num_timesteps:
            self._least_cost = None
            self._usual_change = 0.0
            self._n_undone = 0
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
        """Fly ``n_rollout_steps`` steps with the mean action of the policy, and record them."""
        self.policy.set_training_mode(False)
        callback.on_rollout_start()
        observations = self._tape.reset(self.continue_flights)
        infos: list[StrDict] = [{} for _ in range(env.num_envs)]
        self._compared = []
        # To callbacks, every flight ends with the recording.
        dones = np.zeros(env.num_envs, np.bool_)
        for step in range(n_rollout_steps):
            actions = self._recorded_policy.forward(step, observations)
            if step % COMPARED == 0:
                # A tape may write the next step's observations into the same array.
                self._compared.append((observations.copy(), actions))
            observations = self._tape.step(actions)
            self.num_timesteps += env.num_envs
            if step == n_rollout_steps - 1:
                dones = np.ones(env.num_envs, np.bool_)
                for info, reward, length, is_lost in zip(
                    infos, *self._tape.episodes(), strict=True
                ):
                    info["episode"] = {"r": float(reward), "l": int(length), "t": 0.0}
                    info["is_success"] = not is_lost
                # All flights end at once, and the averages must include each of them.
                window = max(self._stats_window_size, env.num_envs)
                self.ep_info_buffer = deque(self.ep_info_buffer or (), window)
                self.ep_success_buffer = deque(self.ep_success_buffer or (), window)
                self._update_info_buffer(infos, dones)
            callback.update_locals(locals())
            if not callback.on_step():
                return False
        callback.on_rollout_end()
        return True

    def train(self) -> None:
        """Carry the gradient of the mean cost back through the recorded flights, and descend.

        :raises TrainingError: the gradient of a row is not finite; the parameters are left
            unchanged.
        """
        # Layers such as dropout must act as they did in the recorded flight.
        self.policy.set_training_mode(False)
        optimizer = self.policy.optimizer
        self._update_learning_rate(optimizer)
        for group in optimizer.param_groups:
            group["lr"] *= 0.5**self._n_undone
        cost = self._tape.begin()
        rise = self._cost_rise(cost)
        history: History = {"cost": [cost], "cost_rise": [rise]}
        if COST_RISE < rise < np.inf:
            self._undo(f"the cost of {cost:.3g} is far above the least so far", history)
            return

        # Autograd adds to gradients that the critic or an earlier update has left.
        optimizer.zero_grad()
        # The observation after the last step leads to no action.
        grad_observations = np.zeros_like(self._last_obs)
        for step in reversed(range(self.n_steps)):
            grad_actions = self._tape.backward(step, grad_observations)
            if self.max_row_ratio is not None:
                grad_actions = _limited(grad_actions, float(self.max_row_ratio))
            grad_observations = self._recorded_policy.backward(step, grad_actions)

        norm = th.nn.utils.clip_grad_norm_(self.policy.parameters(), self.max_grad_norm)
        if not (np.isfinite(cost) and th.isfinite(norm)):
            raise TrainingError(
                f"the gradient is not finite after {self.num_timesteps} timesteps (cost"
                f" {cost:.3g}): try a smaller learning_rate or shorter flights (n_steps)"
            )
        learnt = [weights for weights in self.policy.parameters() if weights.grad is not None]
        before = [weights.detach().clone() for weights in learnt]
        optimizer.step()
        self._n_updates += 1
        if rise <= 0.0:
            # As part of the optimiser's state they are in zips and snapshots.
            for weights, best in zip(learnt, before, strict=True):
                optimizer.state[weights]["best"] = best
        change = self._action_change()
        history |= {"gradient_norm": [float(norm)], "action_change": [change]}
        if change > ACTION_CHANGE:
            self._undo(f"a step changed the mean actions by {change:.3g}", history)
        else:
            self._log_update(history | {"n_undone": [self._n_undone]})

    def _cost_rise(self, cost: float) -> float:
        """Return how far an update's cost lies above the least so far, in usual changes.

        A flight that is lost costs nothing more, so costs are those of a step in flight.
        """
        cost *= self.n_steps / float(np.mean(self._tape.episodes()[1]))
        if self._least_cost is None or self.continue_flights:
            self._n_undone -= cost > self._blamed_cost
            self._blamed_cost = np.inf
            self._least_cost = self._last_cost = cost
            self._usual_change = max(self._usual_change, FIRST_CHANGE * abs(cost))
            return 0.0
        above = cost - self._least_cost
        usual = max(self._usual_change, LEAST_CHANGE * abs(self._least_cost), 1e-12)
        if above > COST_RISE * usual:
            self._blamed_cost = cost - 0.5 * above
        else:
            change = abs(cost - self._last_cost)
            self._usual_change += 0.1 * (change - self._usual_change)
            self._least_cost += above if above < 0.0 else FORGOTTEN * above
            self._last_cost = cost
        return above / usual

    def _action_change(self) -> float:
        """Return how far the last step moved the mean actions, as a root mean square."""
        observations, actions = map(np.concatenate, zip(*self._compared, strict=True))
        change = self._network.means(observations) - actions
        return float(np.sqrt(np.square(change).mean()))

    def _undo(self, reason: str, history: History) -> None:
        """Bring the best weights back, and let the optimiser begin again at half the rate."""
        state = self.policy.optimizer.state
        with th.no_grad():
            for weights, kept in state.items():
                weights.copy_(kept.get("best", weights))
        state.clear()
        # The next update measures these weights again, in case that the task has changed.
        self._least_cost = None
        self._n_undone += 1
        self._log_update(history | {"n_undone": [self._n_undone]})
        warnings.warn(
            f"APG after {self.num_timesteps:,} timesteps: {reason}; the best weights are back, and"
            " the learning rate is halved",
            stacklevel=3,
        )


@compiled
def _limited(gradients, max_ratio):  # type: ignore[no-untyped-def]
    """Return gradients (n, a), their norms limited to ``max_ratio`` times the median."""
    lengths = np.zeros(len(gradients))
    for row in range(len(gradients)):
        for number in gradients[row]:
            lengths[row] += number * number
        lengths[row] = math.sqrt(lengths[row])
    # Rows whose flight was lost have zero gradients.
    present = lengths[lengths != 0.0]
    result = gradients.copy()
    if present.size > 0:
        limit = max_ratio * np.median(present)
        for row in range(len(gradients)):
            if not lengths[row] <= limit:
                result[row] *= limit / lengths[row]
    return result
