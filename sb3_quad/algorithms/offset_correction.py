"""Correcting an agent in place: its own weights cancel its steady offset from the target.

Its zip stays stock. :func:`correct_offset` does what the thesis does (4.3.1). An agent that PPO has
trained hovers next to its target, by the same vector wherever the target is. The thesis cancels
that in the scaling of the observation (Eq. 3.16): the measured offset goes into the position
components of μ. To make an agent quicker near its target, σ is multiplied by an α below 1 (Eq.
4.10). Here α is a constant, so that both can go into the actor's first layer, since W (s - μ) / (α
σ) + b = (W / α) s / σ + (b - W μ / (α σ)): the agent flies without any wrapper. An α well below 1
costs recoveries and far targets; PPO after it wins them back.

That fits one heading. :func:`correct_hover` is for agents whose offset turns with the heading. At
its target, level and at rest, an agent should give hover thrust, and one that was trained by
samples gives that but for a hundredth. The change D = [ΔW, Δb] of its last layer W, b follows in
closed form::

    min  mean_ψ |h̄(ψ) D + y(ψ)|² + λ mean_s |h(s) D|²

with h the input of that layer and a 1, h̄(ψ) its mean over the observation noise at the target with
heading ψ, y(ψ) the mean action there less that of hover, and s the states of flights: a change is
cheap where the agent never is.
"""

from typing import Any, NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.seeds import row_seeds
from sb3_quad.base.types import BoolArray, Float32Array, FloatArray
from sb3_quad.evaluation.flights import Hook, fly
from sb3_quad.simulation.observation import DEFAULT_MEAN, DEFAULT_STD, GROUPS, OBSERVATION_SIZE
from sb3_quad.simulation.settings import FlightSettings, levels
from sb3_quad.simulation.state import QuadcopterState
from sb3_quad.vehicles.vehicle import first_vehicle

_POSITION = GROUPS["position"]
# The offset is the mean of the last positions of so many flights to random targets. It is measured
# again after each correction.
N_OFFSETS = 120
ROUNDS = 3
# λ of the hover's correction
STIFFNESS = 0.1
# Headings at the target, and noisy observations of each
N_HEADINGS = 72
N_SAMPLES = 256
# The actions of these flights should stay: every third state of their first 3 s
TASKS = {"state_recovery": 0.5, "recovery_and_tracking": 0.5}
N_FLIGHTS = 240
STEPS = 300
EVERY = 3


class Correction(NamedTuple):
    """The effect of a correction.

    :param before: size of the steady offset in m. After :func:`correct_hover` it is the mean action
        at the target less that of hover, root mean square over headings and rotors.
    :param after: the same, after the correction.
    """

    before: float
    after: float


def correct_offset(
    model: BaseAlgorithm, seed: int = 0, settings: FlightSettings | None = None, scale: float = 1.0
) -> Correction:
    """Find μ for an agent and fold it into its first layer, and α before it.

    :param seed: of the flights that measure it.
    :param settings: vehicle, noise and scaling that the agent flies with.
    :param scale: α.
    :raises ConfigError: an agent that crashes on the way to targets, or whose first layer does not
        read the 18 features.
    """
    own = settings or FlightSettings()
    first_layer(model)
    _, std = scaling(own)
    before = after = hover_offset(model, seed=seed, settings=own)
    if scale != 1.0:
        scale_position(model, scale)
        after = hover_offset(model, seed=seed, settings=own)
    for seed_of_round in row_seeds(seed, ROUNDS):
        shift_position(model, after, std[_POSITION])
        after = hover_offset(model, seed=seed_of_round, settings=own)
    return Correction(float(np.linalg.norm(before)), float(np.linalg.norm(after)))


def hover_offset(
    controller: Any,
    n_flights: int = N_OFFSETS,
    seed: int = 0,
    settings: FlightSettings | None = None,
) -> FloatArray:
    """Return the mean of r - r_T, shape (3,), world frame, m, after 15 s of target tracking.

    It is taken over the flights that last.

    :param settings: how it flies; task and episode length are those of this measurement.
    :raises ConfigError: a controller that crashes on the way in more than half of the flights.
    """
    own = {} if settings is None else settings.in_any_task()
    flights = fly(controller, "target_tracking", n_flights, seed, **own)
    crashed = 1.0 - float(flights.survival.mean())
    if crashed > 0.5:
        raise ConfigError(
            f"the steady offset from the target cannot be measured: {100 * crashed:.0f} % of the"
            " flights to targets end early"
        )
    return np.asarray(flights.final_offset[flights.survival].mean(axis=0))


def shift_position(model: BaseAlgorithm, offset: FloatArray, std: FloatArray) -> None:
    """Let the actor see its position moved by ``offset`` (m, world frame).

    :param std: σ of the position features, shape (3,).
    """
    layer = first_layer(model)
    with th.no_grad():
        shift = th.as_tensor(offset / std, dtype=layer.weight.dtype, device=layer.weight.device)
        layer.bias.add_(layer.weight[:, _POSITION] @ shift)


def scale_position(model: BaseAlgorithm, scale: float) -> None:
    """Let the actor see its distance from the target divided by ``scale`` (α)."""
    with th.no_grad():
        first_layer(model).weight[:, _POSITION] /= scale


def correct_hover(
    model: BaseAlgorithm, seed: int = 0, settings: FlightSettings | None = None
) -> Correction:
    """Correct an agent's last layer so that it hovers at its target with every heading.

    :param seed: of the flights and of the observation noise.
    :param settings: vehicle, noise and scaling that the agent flies with.
    :raises ConfigError: an agent whose last layer is not linear, or that does not read the 18
        features.
    """
    layer = getattr(model.policy, "action_net", None)
    if (
        not isinstance(layer, th.nn.Linear)
        or model.observation_space.shape != (OBSERVATION_SIZE,)
        or hasattr(model.policy, "lstm_actor")
    ):
        raise ConfigError("offset correction needs an MlpPolicy that reads the 18 features")
    own = settings or FlightSettings()
    # h̄(ψ), and h(s) of flights
    at_target = _latents(model, _at_target(own, np.random.default_rng(seed)))
    at_target = at_target.reshape(N_HEADINGS, N_SAMPLES, -1).mean(dim=1)
    seen = _Observations()
    fly(model, TASKS, N_FLIGHTS, seed, max_steps=STEPS, hooks=[seen], **own.in_any_task())
    flown = _latents(model, np.concatenate(seen.kept[::EVERY]))
    hover = first_vehicle(own.vehicle).hover_action
    with th.no_grad():
        # The layer as one matrix (inputs + 1, actions), and the least squares that change it
        weights = th.cat([layer.weight, layer.bias[:, None]], dim=1).T.double()
        before = at_target @ weights - hover
        metric = at_target.T @ at_target / len(at_target) + STIFFNESS * flown.T @ flown / len(flown)
        metric += 1e-6 * th.eye(len(metric), dtype=metric.dtype)
        weights -= th.linalg.solve(metric, at_target.T @ before / len(at_target))
        layer.weight.copy_(weights[:-1].T)
        layer.bias.copy_(weights[-1])
        after = at_target @ weights - hover
    return Correction(_root_mean_square(before), _root_mean_square(after))


def _root_mean_square(actions: th.Tensor) -> float:
    return float(actions.square().mean().sqrt())


def first_layer(model: BaseAlgorithm, size: int = OBSERVATION_SIZE) -> th.nn.Linear:
    """Return the layer of an agent's actor that reads ``size`` numbers.

    :raises ConfigError: it has none.
    """
    # SAC and TD3 have an actor, on-policy algorithms an extractor for both networks.
    policy = model.policy
    owner = getattr(policy, "actor", None) or getattr(policy, "mlp_extractor", None)
    for name in ("policy_net", "latent_pi", "mu"):
        layers = getattr(owner, name, None)
        if layers is not None:
            layer = next(iter(layers), None)
            if isinstance(layer, th.nn.Linear) and layer.in_features == size:
                return layer
            break
    raise ConfigError(
        f"offset correction needs an MlpPolicy whose first layer reads the {size} features"
    )


class _Observations(Hook):
    """Keeps the observations of flights."""

    def __init__(self) -> None:
        self.kept: list[Float32Array] = []

    def before_step(
        self,
        state: QuadcopterState,
        observation: Float32Array,
        wrench: FloatArray,
        flying: BoolArray,
    ) -> None:
        self.kept.append(observation[flying])


def _latents(model: BaseAlgorithm, observations: Float32Array) -> th.Tensor:
    """Return inputs of the actor's last layer and a 1, float64, (n, inputs + 1)."""
    policy: Any = model.policy
    with th.no_grad():
        tensor = th.as_tensor(observations, device=model.device)
        features = BasePolicy.extract_features(policy, tensor, policy.pi_features_extractor)
        latent = policy.mlp_extractor.forward_actor(features).double().cpu()
    return th.cat([latent, th.ones(len(latent), 1, dtype=th.float64)], dim=1)


def _at_target(settings: FlightSettings, rng: np.random.Generator) -> Float32Array:
    """Return noisy observations at the target, level and at rest: N_SAMPLES of each heading."""
    headings = np.linspace(0.0, 2.0 * np.pi, N_HEADINGS, endpoint=False)
    heading = np.repeat(headings, N_SAMPLES)
    cosine = np.cos(heading)
    sine = np.sin(heading)
    zero = np.zeros(heading.size)
    features = np.zeros((heading.size, OBSERVATION_SIZE))
    features[:, GROUPS["rotation"]] = np.stack(
        [cosine, sine, zero, -sine, cosine, zero, zero, zero, zero + 1], axis=1
    )
    mean, std = scaling(settings)
    relative, additive = levels(settings.noise)
    features *= 1.0 + relative.mean() * rng.standard_normal(features.shape)
    features += additive.mean() * std * rng.standard_normal(features.shape)
    return np.asarray((features - mean) / std, dtype=np.float32)


def scaling(settings: FlightSettings) -> tuple[FloatArray, FloatArray]:
    """Return μ and σ of Eq. 3.16, (18,) both."""
    mean = settings.observation_mean
    std = settings.observation_std
    return (
        DEFAULT_MEAN if mean is None else np.asarray(mean),
        DEFAULT_STD if std is None else np.asarray(std),
    )
