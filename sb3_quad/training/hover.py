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
from typing import TYPE_CHECKING, Any

import numpy as np
import torch as th
from stable_baselines3.common.policies import BasePolicy

from sb3_quad.base.errors import ConfigError
from sb3_quad.envs.vec_env import QuadcopterVecEnv
from sb3_quad.simulation.observation import DEFAULT_STD, OBSERVATION_SIZE
from sb3_quad.vehicles.vehicle import load_vehicle

if TYPE_CHECKING:
    from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

STIFFNESS = 0.1  # λ
N_HEADINGS, N_DRAWS = 72, 256  # headings, and observations of each with noise of their own
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


def trim_hover(model: OnPolicyAlgorithm, seed: int = 0, noise: float = 0.05, **env_kwargs: Any) -> HoverTrim:
    """Correct an agent's last layer, in place, so that it hovers at its target with every heading.

    :param seed: of the flights and of the observation noise.
    :param noise: relative, of the observations that the agent will get.
    :param env_kwargs: ``vehicle`` and ``observation_std``, as of the environments.
    :raises ConfigError: an agent whose last layer is not linear, or that does not read the 18 features.
    """
    layer = getattr(model.policy, "action_net", None)
    if not isinstance(layer, th.nn.Linear) or model.observation_space.shape != (OBSERVATION_SIZE,):
        raise ConfigError("trimming needs an MlpPolicy that reads the 18 features")
    given = env_kwargs.get("observation_std")
    std = np.asarray(DEFAULT_STD if given is None else given, dtype=np.float64)
    at_target = _features(model, _at_target(noise, std, np.random.default_rng(seed)))
    at_target = at_target.reshape(N_HEADINGS, N_DRAWS, -1).mean(dim=1)
    flown = _features(model, _flown(model, seed, noise, env_kwargs))
    hover = load_vehicle(env_kwargs.get("vehicle", "itm")).hover_action
    with th.no_grad():
        weights = th.cat([layer.weight, layer.bias[:, None]], dim=1).T.double()  # (inputs + 1, actions)
        action = at_target @ weights - hover
        metric = at_target.T @ at_target / len(at_target) + STIFFNESS * flown.T @ flown / len(flown)
        metric += 1e-6 * th.eye(len(metric), dtype=metric.dtype)
        weights -= th.linalg.solve(metric, at_target.T @ action / len(at_target))
        layer.weight.copy_(weights[:-1].T)
        layer.bias.copy_(weights[-1])
    return HoverTrim(_size(action), _size(at_target @ weights - hover))


def _size(action: th.Tensor) -> float:
    return float(action.square().mean().sqrt())


def _features(model: OnPolicyAlgorithm, observations: np.ndarray[Any, np.dtype[np.float32]]) -> th.Tensor:
    """Inputs of the actor's last layer and a 1, float64, (n, inputs + 1)."""
    policy: Any = model.policy
    with th.no_grad():
        tensor = th.as_tensor(observations, device=model.device)
        features = BasePolicy.extract_features(policy, tensor, policy.pi_features_extractor)
        latent = policy.mlp_extractor.forward_actor(features).double().cpu()
    return th.cat([latent, th.ones(len(latent), 1, dtype=th.float64)], dim=1)


def _at_target(
    noise: float, std: np.ndarray[Any, np.dtype[np.float64]], rng: np.random.Generator
) -> np.ndarray[Any, np.dtype[np.float32]]:
    """Observations at the target, level and at rest: N_HEADINGS headings, N_DRAWS of each."""
    heading = np.repeat(np.linspace(0.0, 2.0 * np.pi, N_HEADINGS, endpoint=False), N_DRAWS)
    features = np.zeros((heading.size, OBSERVATION_SIZE))
    features[:, 3] = features[:, 7] = np.cos(heading)  # world to body, row by row
    features[:, 4], features[:, 6] = np.sin(heading), -np.sin(heading)
    features[:, 11] = 1.0
    features *= 1.0 + noise * rng.standard_normal(features.shape)
    return (features / std).astype(np.float32)


def _flown(
    model: OnPolicyAlgorithm, seed: int, noise: float, env_kwargs: dict[str, Any]
) -> np.ndarray[Any, np.dtype[np.float32]]:
    env = QuadcopterVecEnv(N_FLIGHTS, TASKS, noise=noise, max_episode_steps=STEPS, seed=seed, **env_kwargs)
    observation: Any = env.reset()
    seen = []
    for step in range(STEPS):
        if step % EVERY == 0:
            seen.append(observation.copy())
        observation = env.step(model.predict(observation, deterministic=True)[0])[0]
    env.close()
    return np.concatenate(seen)
