"""Correcting an agent in place: its own weights cancel its steady offset from the target.

This is what the thesis does (4.3.1). An agent that PPO has trained hovers next to its target,
offset by the same vector wherever the target is. The thesis cancels that in the scaling of the
observation (Eq. 3.16): the measured offset goes into the position components of μ. To make an agent
quicker near its target, σ is multiplied by an α below 1 (Eq. 4.10). Here α is a constant, so that
both can go into the actor's first layer, since W (s - μ) / (α σ) + b = (W / α) s / σ + (b - W μ /
(α σ)): the agent flies without any wrapper, and its zip stays stock. An α well below 1 costs
recoveries and far targets; further training by PPO wins them back.
"""

import copy
from typing import Any, NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_quad.agents.agent_settings import settings_of_model
from sb3_quad.algorithms.chain import statistics_of
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.seeds import row_seeds
from sb3_quad.base.types import FloatArray
from sb3_quad.envs.simulation.observation import GROUPS, OBSERVATION_SIZE
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.evaluation.flights import fly

_POSITION = GROUPS["position"]
# The offset is the mean final offset of this many flights to random targets. It is measured again
# after each correction.
N_OFFSETS = 120
ROUNDS = 3


class Correction(NamedTuple):
    """The effect of a correction.

    :param before: length of the steady offset, m.
    :param after: the same, after the correction.
    """

    before: float
    after: float


def correct_offset(
    model: BaseAlgorithm, seed: int = 0, settings: FlightSettings | None = None, scale: float = 1.0
) -> Correction:
    """Find μ for an agent, and fold it into its first layer after α.

    :param seed: seed of the flights that measure the offset.
    :param settings: vehicle, noise and scaling that the agent flies with. None: those that the
        model was trained with, or the defaults.
    :param scale: α, above 0.
    :raises ConfigError: an agent that crashes on the way to targets, or whose first layer does not
        read the 18 features. It is then left unchanged.
    """
    if not scale > 0.0:
        raise ConfigError(f"scale {scale}: must be above 0; 1 leaves distances as they are")
    own = settings or settings_of_model(model) or FlightSettings()
    std = own.scaling(1)[1][:, 0]
    statistics = statistics_of(model)
    if statistics is not None:
        # VecNormalize scales what the environment has scaled.
        std = std * np.sqrt(statistics.obs_rms.var + statistics.epsilon)
    layer = first_layer(model)
    weights = copy.deepcopy(layer.state_dict())
    try:
        before = after = hover_offset(model, seed=seed, settings=own)
        if scale != 1.0:
            with th.no_grad():
                layer.weight[:, _POSITION] /= scale
            after = hover_offset(model, seed=seed, settings=own)
        for seed_of_round in row_seeds(seed, ROUNDS):
            shift_position(layer, after / std[_POSITION])
            after = hover_offset(model, seed=seed_of_round, settings=own)
    except BaseException:
        layer.load_state_dict(weights)
        raise
    return Correction(float(np.linalg.norm(before)), float(np.linalg.norm(after)))


def hover_offset(
    controller: Any,
    n_episodes: int = N_OFFSETS,
    seed: int = 0,
    settings: FlightSettings | None = None,
) -> FloatArray:
    """Return the mean of r - r_T, shape (3,), world frame, m, after 15 s of target tracking.

    It averages over the flights that survive.

    :param settings: vehicle, noise and so on; the measurement sets the task and the episode length.
    :raises ConfigError: a controller that crashes on the way in more than half of the flights.
    """
    own = {} if settings is None else settings.in_any_task()
    flights = fly(controller, "target_tracking", n_episodes, seed, **own)
    crashed = 1.0 - float(flights.survival.mean())
    if crashed > 0.5:
        raise ConfigError(
            f"the steady offset from the target cannot be measured: {100 * crashed:.0f} % of the"
            " flights to targets end early; train longer first, or do without the correction"
        )
    return np.asarray(flights.final_offset[flights.survival].mean(axis=0))


def shift_position(layer: th.nn.Linear, offset: FloatArray) -> None:
    """Shift the position that an actor's first layer sees by ``offset``, (3,), world frame, in σ of
    its features.
    """
    with th.no_grad():
        layer.bias.add_(layer.weight[:, _POSITION] @ layer.weight.new_tensor(offset))


def first_layer(model: BaseAlgorithm) -> th.nn.Linear:
    """Return the layer of an agent's actor that reads the 18 features.

    :raises ConfigError: the agent has no such layer.
    """
    # SAC and TD3 have an actor, on-policy algorithms an extractor for both networks.
    policy = model.policy
    owner = getattr(policy, "actor", None) or getattr(policy, "mlp_extractor", None)
    for name in ("policy_net", "latent_pi", "mu"):
        layers = getattr(owner, name, None)
        if layers is not None:
            layer = next(iter(layers), None)
            if isinstance(layer, th.nn.Linear) and layer.in_features == OBSERVATION_SIZE:
                return layer
            break
    raise ConfigError(
        "offset correction needs an MlpPolicy whose first layer reads the "
        f"{OBSERVATION_SIZE} features"
    )
