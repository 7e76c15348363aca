"""Scales of an agent's features with which it arrives at targets as its teacher does.

An agent that learns from noisy observations of vehicles whose parameters it does not know learns
the mean of its teacher's actions. That answers to each feature less than the teacher does
(regression dilution): it brakes late, overshoots and comes back. The thesis divides the position's
σ by an α found by trial (Eq. 4.10). Here each of GROUPS has an α, found by the cross-entropy method
in the agent's own flights: candidates fly the same episodes, and the next ones are sampled around
the best. The α are folded into the actor's first layer, since W (s - μ) / (α σ) =
(W / α) (s - μ) / σ: the zip stays stock.
"""

from fnmatch import fnmatchcase
from functools import partial
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_quad.algorithms.networks.gradients import mean_actions, network_of
from sb3_quad.algorithms.offset_correction import Correction, first_layer, scaling
from sb3_quad.base.seeds import row_seeds
from sb3_quad.base.types import FloatArray
from sb3_quad.evaluation.flights import NEAR, fly_settings
from sb3_quad.simulation.observation import FEATURE_NAMES, OBSERVATION_SIZE
from sb3_quad.simulation.settings import FlightSettings

GROUPS = (
    "position_[xy]",
    "position_z",
    "rotation_*",
    "velocity_[xy]",
    "velocity_z",
    "body_rate_[xy]",
)
# (groups, features): 1 where a feature belongs to a group.
_MEMBERS = np.array(
    [[fnmatchcase(name, group) for name in FEATURE_NAMES] for group in GROUPS], dtype=np.float64
)
# The cross-entropy method.
ROUNDS = 8
CANDIDATES = 16
BEST = 4
# Standard deviation of log α in the first round.
FIRST_SPREAD = 0.08
# Share of the last round's mean in the next one.
KEPT = 0.3
# Flights of a candidate to targets; half of them are its recoveries.
N_FLIGHTS = 120
# Flights of the agent before and after.
N_CHECKED = 480
# Costs of a flight in seconds: for leaving its target after reaching it, for not succeeding, and
# for crashing or flying out of range, which costs that of not succeeding, too.
OVERSHOOT_COST = 0.25
MISS_COST = 0.2
CRASH_COST = 10.0
# Flights, with the weight of their settling time.
_Sets = list[tuple[FlightSettings, float]]


def correct_arrival(
    model: BaseAlgorithm,
    seed: int,
    settings: FlightSettings,
    trained: FlightSettings,
    overshoot_cost: float = OVERSHOOT_COST,
) -> Correction:
    """Find the scales of an agent and fold them into its first layer.

    They are not kept where they make the agent worse in fresh flights.

    :param seed: of the flights.
    :param settings: how evaluations fly it.
    :param trained: how it was trained, or with other vehicles and disturbances that are to count.
    :param overshoot_cost: cost in s of leaving a target after reaching it.
    :return: the cost before and after, s: the mean settling time within 0.1 m of targets 10 m away,
        0.3 times the same with the randomized dynamics of the training, and the costs of leaving a
        target, missing it and crashing, also in twice as many recoveries.
    :raises ConfigError: an agent whose first layer does not read these observations.
    """
    layer = first_layer(model, settings.size)
    rng = np.random.default_rng(seed)
    agent: Any = model
    if isinstance(model.policy, ActorCriticPolicy):
        agent = partial(mean_actions, network_of(model.policy))
    undisturbed = settings.with_changes(
        task="target_tracking", task_kwargs=None, max_episode_steps=500
    )
    randomized = trained.with_changes(
        position_integral=settings.position_integral, task_kwargs=None
    )
    targets = randomized.with_changes(task="target_tracking", max_episode_steps=600)
    recoveries = randomized.with_changes(task="state_recovery", max_episode_steps=500)
    # The recoveries are there twice, each with episodes of its own.
    sets = [(undisturbed, 1.0), (targets, 0.3), (recoveries, 0.0), (recoveries, 0.0)]
    mean = np.zeros(len(GROUPS))
    spread = np.full(len(GROUPS), FIRST_SPREAD)
    for round_seed in row_seeds(seed, ROUNDS):
        candidates = mean + spread * rng.standard_normal((CANDIDATES, len(GROUPS)))
        costs = _costs(agent, candidates, sets, round_seed, N_FLIGHTS, overshoot_cost)
        best = candidates[np.argsort(costs)[:BEST]]
        mean = KEPT * mean + (1 - KEPT) * best.mean(axis=0)
        spread = (spread + best.std(axis=0)) / 2
    # Other flights than those of the search decide whether the scales are kept.
    compared = np.stack([np.zeros_like(mean), mean])
    before, after = _costs(agent, compared, sets, seed, N_CHECKED, overshoot_cost)
    if after < before:
        # Features beyond the 18, such as the last action, keep their scale; each age of a history
        # has a frame.
        frame = np.append(np.exp(mean @ _MEMBERS), np.ones(settings.frame_size - OBSERVATION_SIZE))
        scales = np.tile(frame, len(settings.ages))
        with th.no_grad():
            layer.weight.div_(th.as_tensor(scales).to(layer.weight))
    return Correction(float(before), float(min(after, before)))


def _costs(
    agent: Any, log_scales: FloatArray, sets: _Sets, seed: int, n: int, overshoot_cost: float
) -> FloatArray:
    """Return the mean cost in s of each of m candidates, which fly the same n flights of each set.

    :param log_scales: (m, groups).
    :return: (m,).
    """
    m = len(log_scales)
    scales = np.repeat(np.exp(log_scales @ _MEMBERS), n, axis=0)
    total = np.zeros(m * n)
    for (settings, weight), episodes in zip(sets, row_seeds(seed, len(sets)), strict=True):
        scaled = settings.with_changes(observation_std=scaling(settings)[1] * scales)
        seeds = row_seeds(episodes, n) * m
        flights = fly_settings(agent, scaled, seeds, tolerances=(NEAR,))
        # A flight that never settles counts as twice the longest.
        settling_time = np.nan_to_num(flights.settling_time[NEAR], nan=2.0 * flights.flown.max())
        overshot = overshoot_cost * (flights.time_to[NEAR] < settling_time)
        crashed = CRASH_COST * ~flights.survival
        missed = MISS_COST * ~flights.success
        total += weight * (settling_time + overshot) + crashed + missed
    return np.asarray(total.reshape(m, n).mean(axis=1))
