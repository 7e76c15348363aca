"""Scales of an agent's features, found in its own flights, so that it arrives at targets as its
teacher does.

An agent that learns from noisy observations of vehicles that it is not told learns the mean of its
teacher's actions. That answers to each feature less than the teacher does (regression dilution): it
brakes late, overshoots and comes back. The thesis divides the position's σ by an α found by trial
(Eq. 4.10). Here each of GROUPS has an α, found by the cross-entropy method: candidates fly the same
episodes, and the next ones are sampled around the best. The α go into the actor's first layer,
since W (s - μ) / (α σ) = (W / α) (s - μ) / σ: the zip stays stock.
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
from sb3_quad.base.arrays import FloatArray
from sb3_quad.base.seeds import row_seeds
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
_MEMBERS = np.array(
    [[fnmatchcase(name, group) for name in FEATURE_NAMES] for group in GROUPS], dtype=np.float64
)
ROUNDS, CANDIDATES, BEST = 8, 16, 4
FIRST_SPREAD, KEPT = 0.08, 0.3  # of log α at first; share of the last round's mean in the next
N_FLIGHTS, N_CHECKED = (
    120,
    480,
)  # of a candidate to targets, half of its recoveries; of the agent before and after
LEFT, FAILED, LOST = (
    0.25,
    0.2,
    10.0,
)  # s that a flight costs that leaves its target again, fails, or is lost (fails, too)
_Sets = list[tuple[FlightSettings, float]]  # of flights, with the weight of their time


def correct_arrival(
    model: BaseAlgorithm,
    seed: int,
    settings: FlightSettings,
    trained: FlightSettings,
    left: float = LEFT,
) -> Correction:
    """Find the scales of an agent and fold them into its first layer, unless fresh flights say that
    they make it worse.

    :param seed: of the flights.
    :param settings: how evaluations fly it.
    :param trained: how it was trained, or what else is to count: vehicles and disturbances.
    :param left: s that it costs to leave a target again.
    :return: the cost before and after, s: the mean time to stay within 0.1 m of targets 10 m away,
        0.3 times the same in the worlds of the training, and what it costs to leave a target, to
        fail and to be lost, also in twice as many recoveries.
    :raises ConfigError: an agent whose first layer does not read these observations.
    """
    layer, rng = first_layer(model, settings.size), np.random.default_rng(seed)
    agent: Any = (
        partial(mean_actions, network_of(model.policy))
        if isinstance(model.policy, ActorCriticPolicy)
        else model
    )
    worlds = trained.with_changes(position_integral=settings.position_integral, task_kwargs=None)
    sets = [
        (
            settings.with_changes(task="target_tracking", task_kwargs=None, max_episode_steps=500),
            1.0,
        ),
        (worlds.with_changes(task="target_tracking", max_episode_steps=600), 0.3),
        *[(worlds.with_changes(task="state_recovery", max_episode_steps=500), 0.0)] * 2,
    ]
    mean, spread = np.zeros(len(GROUPS)), np.full(len(GROUPS), FIRST_SPREAD)
    for each in row_seeds(seed, ROUNDS):
        tried = mean + spread * rng.standard_normal((CANDIDATES, len(GROUPS)))
        best = tried[np.argsort(_costs(agent, tried, sets, each, N_FLIGHTS, left))[:BEST]]
        mean, spread = KEPT * mean + (1 - KEPT) * best.mean(axis=0), (spread + best.std(axis=0)) / 2
    before, after = _costs(agent, np.stack([0.0 * mean, mean]), sets, seed, N_CHECKED, left)
    if after < before:
        frame = np.append(np.exp(mean @ _MEMBERS), np.ones(settings.frame_size - OBSERVATION_SIZE))
        with th.no_grad():
            layer.weight.div_(th.as_tensor(np.tile(frame, len(settings.ages))).to(layer.weight))
    return Correction(float(before), float(min(after, before)))


def _costs(
    agent: Any, log_scales: FloatArray, sets: _Sets, seed: int, n: int, left: float
) -> FloatArray:
    """What :func:`correct_arrival` minimises for each of m candidates, on the same n flights of each
    set, (m,).
    """
    scales = np.repeat(np.exp(log_scales @ _MEMBERS), n, axis=0)
    total = np.zeros(len(scales))
    for (settings, weight), episodes in zip(sets, row_seeds(seed, len(sets)), strict=True):
        scaled = settings.with_changes(observation_std=scaling(settings)[1] * scales)
        flights = fly_settings(
            agent, scaled, row_seeds(episodes, n) * len(log_scales), tolerances=(NEAR,)
        )
        stay = np.nan_to_num(flights.settling_time[NEAR], nan=2.0 * flights.flown.max())
        total += (
            weight * (stay + left * (flights.time_to[NEAR] < stay))
            + LOST * ~flights.survival
            + FAILED * ~flights.success
        )
    return np.asarray(total.reshape(len(log_scales), n).mean(axis=1))
