"""What a policy computes, as plain arrays: scaling, layers, and the way from the last layer to the rotors."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt

from sb3_quad.base.errors import ConfigError, unknown
from sb3_quad.simulation.observation import DEFAULT_MEAN, DEFAULT_STD, OBSERVATION_SIZE
from sb3_quad.vehicles.vehicle import Vehicle

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

Float32Array = npt.NDArray[np.float32]
Activation = Literal["none", "tanh", "relu"]
Output = Literal["thrusts", "speeds"]
OUTPUTS = ("thrusts", "speeds")
N_ROTORS = 4


@dataclass(frozen=True, eq=False)
class Layer:
    """y = activation(weight x + bias).

    :param weight: (outputs, inputs).
    :param bias: (outputs,).
    """

    weight: Float32Array
    bias: Float32Array
    activation: Activation


@dataclass(frozen=True, eq=False)
class Network:
    """A deterministic policy from 18 features in physical units to the four rotors, all of it float32.

    ``a = clip(layers((features - mean) * inverse_std), -1, 1)``, then ``q = middle + half_range * a`` (Eq. 3.18). For
    thrusts, q is the result, N. For speeds, middle and half_range are divided by kF, so that the result is the root of q,
    rad/s (Eq. 2.4).

    :param mean: μ of Eq. 3.16, (18,), in the features' units.
    :param inverse_std: 1 / σ of Eq. 3.16, (18,).
    :param layers: the hidden layers and the last one, whose activation is ``tanh`` where the policy squashes its actions.
    """

    mean: Float32Array
    inverse_std: Float32Array
    layers: tuple[Layer, ...]
    middle: np.float32
    half_range: np.float32
    output: Output

    @property
    def n_parameters(self) -> int:
        """Weights and biases."""
        return sum(layer.weight.size + layer.bias.size for layer in self.layers)

    @property
    def unit(self) -> str:
        """Of the result."""
        return "N" if self.output == "thrusts" else "rad/s"

    @property
    def result(self) -> str:
        """What one of the four numbers of the result is called."""
        return "thrust" if self.output == "thrusts" else "rotor_speed"


def build_network(
    model: BaseAlgorithm,
    vehicle: Vehicle,
    output: str = "thrusts",
    mean: npt.ArrayLike | None = None,
    std: npt.ArrayLike | None = None,
    where: str = "model",
) -> Network:
    """The policy of an on-policy SB3 model with ``MlpPolicy``, its scaling and its rotors.

    :param vehicle: its hover thrust and thrust limits, and for speeds its kF.
    :param output: ``thrusts`` (N) or ``speeds`` (rad/s).
    :param mean: μ of Eq. 3.16, (18,), as in training; None: zero.
    :param std: σ of Eq. 3.16, (18,), as in training; None: Table A.2.
    :param where: what messages call the model.
    :raises ConfigError: other spaces than the quadcopter's, another policy than ``MlpPolicy`` of an on-policy algorithm,
        or a network with other layers than linear ones, tanh and ReLU.
    """
    if output not in OUTPUTS:
        raise ConfigError(unknown("output", output, OUTPUTS))
    _check_policy(model.policy, where)
    _check_spaces(model, where)
    means = _features("observation_mean", DEFAULT_MEAN if mean is None else mean)
    stds = _features("observation_std", DEFAULT_STD if std is None else std)
    if (stds <= 0).any():
        raise ConfigError("observation_std: every value must be positive")
    low, high = vehicle.thrust_range
    divisor = 1.0 if output == "thrusts" else vehicle.thrust_coefficient
    return Network(
        means.astype(np.float32),
        (1.0 / stds).astype(np.float32),
        _layers(model.policy, where),
        np.float32((high + low) / 2 / divisor),
        np.float32((high - low) / 2 / divisor),
        "thrusts" if output == "thrusts" else "speeds",
    )


def result_range(vehicle: Vehicle, output: Output) -> tuple[float, float]:
    """Least and greatest number of the result, N or rad/s."""
    return vehicle.thrust_range if output == "thrusts" else vehicle.rotor_speed_range


def actions_to_result(actions: npt.ArrayLike, vehicle: Vehicle, output: Output) -> npt.NDArray[np.float64]:
    """Rotor thrusts, N (Eq. 3.18), or speeds, rad/s (Eq. 2.4), of actions of any shape; in float64."""
    thrusts = vehicle.action_to_thrust(np.asarray(actions, dtype=np.float64))
    return thrusts if output == "thrusts" else np.sqrt(thrusts / vehicle.thrust_coefficient)


def _check_policy(policy: Any, where: str) -> None:
    from stable_baselines3.common.policies import ActorCriticPolicy
    from stable_baselines3.common.torch_layers import FlattenExtractor, MlpExtractor

    kind = type(policy).__name__
    if not isinstance(policy, ActorCriticPolicy):
        raise ConfigError(
            f"{where}: its policy is an off-policy one ({kind}); only on-policy algorithms (PPO, A2C, DAgger, PPOBC) export"
        )
    extractor = type(policy.pi_features_extractor)
    if type(policy) is not ActorCriticPolicy or extractor is not FlattenExtractor:
        found = kind if type(policy) is not ActorCriticPolicy else f"one with a {extractor.__name__}"
        raise ConfigError(f"{where}: its policy is {found}; only MlpPolicy without a features extractor of its own exports")
    if type(policy.mlp_extractor) is not MlpExtractor:
        raise ConfigError(f"{where}: its network is a {type(policy.mlp_extractor).__name__}; only SB3's MlpExtractor exports")


def _check_spaces(model: BaseAlgorithm, where: str) -> None:
    from gymnasium import spaces

    seen, done = model.observation_space, model.action_space
    if not isinstance(seen, spaces.Box) or seen.shape != (OBSERVATION_SIZE,):
        raise ConfigError(f"{where}: its observations are {seen}, the quadcopter's are of shape ({OBSERVATION_SIZE},)")
    unit = isinstance(done, spaces.Box) and done.shape == (N_ROTORS,) and (done.low == -1).all() and (done.high == 1).all()
    if not unit:
        raise ConfigError(f"{where}: its actions are {done}, the quadcopter's are Box(-1, 1, ({N_ROTORS},))")


def _features(name: str, values: npt.ArrayLike) -> npt.NDArray[np.float64]:
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise ConfigError(f"{name}: must be {OBSERVATION_SIZE} numbers") from None
    if array.shape != (OBSERVATION_SIZE,) or not np.isfinite(array).all():
        raise ConfigError(f"{name}: must be {OBSERVATION_SIZE} finite numbers")
    return array


def _layers(policy: Any, where: str) -> tuple[Layer, ...]:
    from torch import nn

    names: dict[type[nn.Module], Activation] = {nn.Tanh: "tanh", nn.ReLU: "relu"}
    layers: list[Layer] = []
    for module in policy.mlp_extractor.policy_net:
        if type(module) is nn.Linear:
            layers.append(_linear(module, "none", where))
        elif type(module) in names and layers and layers[-1].activation == "none":
            layers[-1] = Layer(layers[-1].weight, layers[-1].bias, names[type(module)])
        else:
            raise ConfigError(f"{where}: its network has a layer {module}; only linear layers, Tanh and ReLU export")
    # gSDE's squashed actions are the tanh of the mean; without squashing the mean is clipped.
    return (*layers, _linear(policy.action_net, "tanh" if policy.squash_output else "none", where))


def _linear(module: Any, activation: Activation, where: str) -> Layer:
    def array(tensor: Any) -> Float32Array:
        found = np.array(tensor.detach().cpu().numpy(), dtype=np.float32, order="C")  # a copy
        if not math.isfinite(float(np.abs(found).sum())):
            raise ConfigError(f"{where}: holds parameters that are not finite")
        return found

    weight = array(module.weight)
    bias = np.zeros(weight.shape[0], dtype=np.float32) if module.bias is None else array(module.bias)
    return Layer(weight, bias, activation)
