"""Trimming an agent: its steady offset from the target, measured and folded into its first layer (thesis 4.3.1).

An agent that PPO has trained hovers beside its target, by the same vector wherever the target is. The thesis cancels this by
the mean μ of the observation (Eq. 3.16), with the measured offset in its position components. Here the same shift goes into
the biases of the actor's first layer, since W (s - μ/σ) + b = W s + (b - W μ/σ): the agent flies without any wrapper, and its
zip stays a stock one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import torch as th

from sb3_quad.envs.observation import DEFAULT_STD
from sb3_quad.errors import ConfigError

if TYPE_CHECKING:
    from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

STEPS = 1500  # control steps until the offset is read: 15 s, as an episode
ROUNDS = 3  # the offset is measured anew after each correction


def hover_offset(
    model: OnPolicyAlgorithm, n_flights: int = 120, seed: int = 0, **env_kwargs: Any
) -> npt.NDArray[np.float64]:
    """Mean of r - r_T, shape (3,), world frame, m, after 15 s of target tracking.

    :param env_kwargs: for :class:`~sb3_quad.envs.vec_env.QuadcopterVecEnv`, such as ``vehicle`` and ``noise``.
    :raises ConfigError: an agent that crashes on the way in more than half of the flights.
    """
    from sb3_quad.envs.vec_env import QuadcopterVecEnv

    keywords = {**env_kwargs, "task": "target_tracking", "max_episode_steps": STEPS + 1}
    env = QuadcopterVecEnv(n_flights, seed=seed, **keywords)
    observation = env.reset()
    flying = np.ones(n_flights, dtype=np.bool_)
    for _ in range(STEPS):
        observation, _, dones, _ = env.step(model.predict(observation, deterministic=True)[0])  # type: ignore[arg-type]
        flying &= ~dones
    state = env.true_state()
    if flying.mean() < 0.5:
        raise ConfigError(f"the agent cannot be trimmed: {100 * (1 - flying.mean()):.0f} % of its flights to targets end early")
    return np.asarray((state.position - state.target)[flying].mean(axis=0))


def shift_position(model: OnPolicyAlgorithm, offset: npt.NDArray[np.float64], std: npt.NDArray[np.float64]) -> None:
    """Let the actor see its position moved by ``offset`` (m, world frame), in place.

    :param std: σ of the position features, shape (3,).
    :raises ConfigError: an actor whose first layer is not a linear one on the observation.
    """
    layer = getattr(model.policy.mlp_extractor, "policy_net", [None])[0]
    if not isinstance(layer, th.nn.Linear) or layer.in_features != len(DEFAULT_STD):
        raise ConfigError("trimming needs an MlpPolicy whose first layer reads the 18 features")
    shift = th.as_tensor(offset / std, dtype=layer.weight.dtype, device=layer.weight.device)
    with th.no_grad():
        layer.bias += layer.weight[:, :3] @ shift


def trim(model: OnPolicyAlgorithm, seed: int = 0, **env_kwargs: Any) -> list[float]:
    """Cancel the agent's steady offset, in place; returns its size in m before each correction and after the last.

    :param seed: of the flights that measure it.
    :param env_kwargs: as for :func:`hover_offset`.
    """
    given = env_kwargs.get("observation_std")
    std = np.asarray(DEFAULT_STD if given is None else given, dtype=np.float64)[:3]
    sizes = []
    for number in range(ROUNDS + 1):
        offset = hover_offset(model, seed=seed + 1000 * number, **env_kwargs)
        sizes.append(float(np.linalg.norm(offset)))
        if number < ROUNDS:
            shift_position(model, offset, std)
    return sizes
