"""Cancelling an agent's steady offset from its target: a least squares correction of the actor's last layer.

At its target, level and at rest, an agent should give hover thrust whatever its heading. One that was trained by samples gives
that but for a hundredth, and then hovers centimetres beside the target, in a direction that turns with the heading, where the
offset and the hundredth balance. What its last layer W, b must change by, D = [ΔW, Δb], follows in closed form::

    min  mean_ψ |h̄(ψ) D + y(ψ)|² + λ mean_s |h(s) D|²

with h the input of that layer and a 1, h̄(ψ) its mean over the observation noise at the target with heading ψ, y(ψ) the mean
action there less that of hover, and s the states of flights: a change is cheap where the agent never is. The zip stays a stock
one. The thesis cancels an offset by the position's mean in the observation's scaling instead (4.3.1; :mod:`.trim`), which fits
one heading.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy

from sb3_quad.base.arrays import BoolArray, Float32Array, FloatArray
from sb3_quad.base.errors import ConfigError
from sb3_quad.evaluation.flights import Hook, fly_settings
from sb3_quad.settings.flight import FlightSettings
from sb3_quad.simulation.observation import DEFAULT_MEAN, DEFAULT_STD, GROUPS, OBSERVATION_SIZE
from sb3_quad.simulation.state import QuadcopterState
from sb3_quad.vehicles.vehicle import load_vehicle

STIFFNESS = 0.1  # λ
N_HEADINGS, N_SAMPLES = 72, 256  # headings, and observations of each with noise of their own
TASKS = {"state_recovery": 0.5, "recovery_and_tracking": 0.5}
N_FLIGHTS, STEPS, EVERY = 240, 300, 3  # flights whose states must not see a change: their first 3 s, every third step


@dataclass(frozen=True)
class HoverTrim:
    """What the correction did.

    :param before: root mean square, over headings and rotors, of the mean action at the target less that of hover.
    :param after: the same, after it.
    """

    before: float
    after: float


def trim_hover(model: OnPolicyAlgorithm, seed: int = 0, settings: FlightSettings | None = None) -> HoverTrim:
    """Correct an agent's last layer, in place, so that it hovers at its target with every heading.

    :param seed: of the flights and of the observation noise.
    :param settings: vehicle, noise and scaling that the agent flies with.
    :raises ConfigError: an agent whose last layer is not linear, or that does not read the 18 features.
    """
    layer = getattr(model.policy, "action_net", None)
    if not isinstance(layer, th.nn.Linear) or model.observation_space.shape != (OBSERVATION_SIZE,):
        raise ConfigError("trimming needs an MlpPolicy that reads the 18 features")
    own = settings or FlightSettings()
    at_target = _features(model, _at_target(own, np.random.default_rng(seed)))
    at_target = at_target.reshape(N_HEADINGS, N_SAMPLES, -1).mean(dim=1)
    seen = _Observations()
    changes = {"task": TASKS, "task_kwargs": None, "max_episode_steps": STEPS}
    fly_settings(model, own.with_changes(**changes), range(seed, seed + N_FLIGHTS), hooks=[seen])
    flown = _features(model, np.concatenate(seen.kept))
    hover = load_vehicle(own.vehicle).hover_action
    with th.no_grad():
        weights = th.cat([layer.weight, layer.bias[:, None]], dim=1).T.double()  # (inputs + 1, actions)
        action = at_target @ weights - hover
        metric = at_target.T @ at_target / len(at_target) + STIFFNESS * flown.T @ flown / len(flown)
        metric += 1e-6 * th.eye(len(metric), dtype=metric.dtype)
        weights -= th.linalg.solve(metric, at_target.T @ action / len(at_target))
        layer.weight.copy_(weights[:-1].T)
        layer.bias.copy_(weights[-1])
    return HoverTrim(_size(action), _size(at_target @ weights - hover))


class _Observations(Hook):
    """Every third observation of flights."""

    def __init__(self) -> None:
        self.kept: list[Float32Array] = []
        self._steps = 0

    def before_step(self, state: QuadcopterState, observation: Float32Array, wrench: FloatArray, flying: BoolArray) -> None:
        if self._steps % EVERY == 0:
            self.kept.append(observation[flying])
        self._steps += 1


def _size(action: th.Tensor) -> float:
    return float(action.square().mean().sqrt())


def _features(model: OnPolicyAlgorithm, observations: Float32Array) -> th.Tensor:
    """Inputs of the actor's last layer and a 1, float64, (n, inputs + 1)."""
    policy: Any = model.policy
    with th.no_grad():
        tensor = th.as_tensor(observations, device=model.device)
        features = BasePolicy.extract_features(policy, tensor, policy.pi_features_extractor)
        latent = policy.mlp_extractor.forward_actor(features).double().cpu()
    return th.cat([latent, th.ones(len(latent), 1, dtype=th.float64)], dim=1)


def _at_target(settings: FlightSettings, rng: np.random.Generator) -> Float32Array:
    """Observations at the target, level and at rest: N_HEADINGS headings, N_SAMPLES of each."""
    heading = np.repeat(np.linspace(0.0, 2.0 * np.pi, N_HEADINGS, endpoint=False), N_SAMPLES)
    features = np.zeros((heading.size, OBSERVATION_SIZE))
    cosine, sine = np.cos(heading), np.sin(heading)
    rotation = np.stack([cosine, sine, 0 * sine, -sine, cosine, 0 * sine, 0 * sine, 0 * sine, 0 * sine + 1], axis=1)
    features[:, GROUPS["rotation"]] = rotation  # world to body, row by row
    features *= 1.0 + settings.noise * rng.standard_normal(features.shape)
    mean = DEFAULT_MEAN if settings.observation_mean is None else np.asarray(settings.observation_mean)
    std = DEFAULT_STD if settings.observation_std is None else np.asarray(settings.observation_std)
    return np.asarray((features - mean) / std, dtype=np.float32)
