"""A policy's computation as one torch module, and the ONNX file that torch makes from it."""

import copy
import io
import itertools
import math
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import FlattenExtractor, MlpExtractor
from stable_baselines3.sac.policies import SACPolicy
from stable_baselines3.td3.policies import TD3Policy
from torch import nn

from sb3_quad.base.errors import ConfigError, refuse_unknown
from sb3_quad.base.imports import require
from sb3_quad.base.types import StrDict
from sb3_quad.envs.simulation.observation import GROUPS, OBSERVATION_SIZE, turn_features
from sb3_quad.envs.simulation.tracks import ACCELERATION_STD
from sb3_quad.evaluation.flights import ACTIONS
from sb3_quad.export.check import TrainedPolicy

ACTIVATIONS = {nn.Tanh: "tanh", nn.ReLU: "relu"}
OUTPUTS = {
    "thrusts": ("thrust", "N"),
    "speeds": ("rotor_speed", "rad/s"),
    "rates": ("command", "N or rad/s"),
}
"""Each output, with the name and the unit of its four numbers."""


class Network(nn.Module):
    """A deterministic policy from features in physical units to the four rotors, or to collective
    thrust and body rates, all of it float32, on the CPU.

    ``a = clip(layers((features - mean) * inverse_std), -1, 1)``, where VecNormalize bounds the
    input of the layers by ``clip``. Then ``q = middle + half_range * a`` (Eq. 3.18): thrusts, N.
    For speeds, middle and half_range are divided by kF, and the result is the root of q, rad/s (Eq.
    2.4).

    A policy that sees more than the present features keeps the frames of

    :mod:`sb3_quad.envs.simulation.frames` in a state, float32 (batch, ``state_size``). The state is
    zero when a flight begins. It has those of these parts that the policy sees: the last action
    (4); the integral s (3), m, with a 1 once a flight has begun; the earlier frames, scaled, the
    latest first.

    A policy that previews its reference takes the accelerations, m/s², after the features of
    ``observation``: (batch, OBSERVATION_SIZE + 3 * previews).

    :param layers: linear layers, each with the activation that follows it, if any; they are copied.
    :param trained: its scaling, vehicle, output and ``observation``; features and rotors are
        those of the vehicle's own layout.
    """

    mean: th.Tensor
    inverse_std: th.Tensor
    middle: th.Tensor
    half_range: th.Tensor

    def __init__(self, layers: nn.Sequential, trained: TrainedPolicy) -> None:
        super().__init__()
        self.trained = trained
        vehicle = trained.vehicle
        observation = trained.observation
        self.observation = observation
        self.clip = trained.clip
        self.result, self.unit = OUTPUTS[trained.output]
        # Eq. 3.18 maps an action to thrusts; divided by kF, to squares of speeds.
        limits = np.array(vehicle.thrust_range)[:, None] * np.ones(4)
        if trained.output == "rates":
            limits = trained.limits
        elif trained.output == "speeds":
            if not vehicle.thrust_coefficient:
                raise ConfigError(
                    f"output speeds: {vehicle.name} has no thrust_coefficient; export thrusts"
                )
            limits /= vehicle.thrust_coefficient
        # The previewed accelerations follow the features.
        ahead = np.zeros(3 * len(observation.preview or ()))
        buffers = {
            "mean": np.append(trained.own_mean, ahead),
            "inverse_std": 1.0 / np.append(trained.std, ahead + ACCELERATION_STD),
            "middle": limits.mean(axis=0),
            "half_range": np.ptp(limits, axis=0) / 2,
        }
        for name, value in buffers.items():
            self.register_buffer(name, th.as_tensor(value, dtype=th.float32))
        self.layers = own_layers(layers, trained).to(th.float32)

        # The state begins with the last action; the latest frame follows the integral.
        integral = observation.position_integral
        self.integral = integral and integral.numbers(vehicle.control_step)
        self.actions = 4 * observation.last_action
        self.newest = self.actions + 4 * bool(integral)
        self.state_size = self.newest + observation.ages[-1] * observation.frame_size
        # Maps the integral to its contribution to the scaled features.
        self.shift = th.diag(self.inverse_std[:OBSERVATION_SIZE])[GROUPS["position"]]
        # An example of the inputs of the files
        self.examples: tuple[th.Tensor, ...] = (th.zeros(2, len(self.mean)),)
        if observation.is_extended:
            self.examples += (th.zeros(2, self.state_size),)
        self.eval()

    def forward(self, observation: th.Tensor, state: th.Tensor | None = None) -> Any:
        """Rotor thrusts or speeds, (batch, 4), for observations; with a state also the next one."""
        scaled = (observation - self.mean) * self.inverse_std
        if self.clip:
            scaled = scaled.clamp(-self.clip, self.clip)
        if state is None:
            return self.command(self.layers(scaled).clamp(-1.0, 1.0))
        frame = scaled[:, :OBSERVATION_SIZE]
        following = []
        if self.integral:
            gain, distance2, speed2, limit = self.integral
            s = state[:, self.actions : self.newest - 1]
            begun = state[:, self.newest - 1 : self.newest]
            error = observation[:, GROUPS["position"]]
            velocity = observation[:, GROUPS["velocity"]]
            is_near = error.square().sum(1, keepdim=True) < distance2
            is_slow = velocity.square().sum(1, keepdim=True) < speed2
            s = th.where(is_near & is_slow & (begun > 0), s + gain * error, s).clamp(-limit, limit)
            frame = frame + s @ self.shift
            following = [s, begun.clamp(min=1.0)]
        # The present frame ends with the last action; the earlier frames follow it.
        frames = th.cat([frame, state[:, : self.actions], state[:, self.newest :]], dim=1)
        # The policy sees the frames of some ages; all except for the oldest stay in the state.
        size = self.observation.frame_size
        ages = self.observation.ages
        seen = frames.view(-1, ages[-1] + 1, size)[:, ages].flatten(1)
        seen = th.cat([seen, scaled[:, OBSERVATION_SIZE:]], dim=1)
        action = self.layers(seen).clamp(-1.0, 1.0)
        following = [action[:, : self.actions], *following, frames[:, : ages[-1] * size]]
        return self.command(action), th.cat(following, dim=1)

    def command(self, action: th.Tensor) -> th.Tensor:
        """Rotor thrusts or speeds, or thrust and body rates, (batch, 4), for actions."""
        value: th.Tensor = self.middle + self.half_range * action
        if self.trained.output != "speeds":
            return value
        # Rounding may put a rotor that can stand still slightly below zero.
        return value.relu().sqrt()

    @property
    def shapes(self) -> list[StrDict]:
        """Inputs, outputs and activation (``tanh``, ``relu`` or ``none``) of each linear layer."""
        return [
            {
                "inputs": layer.in_features,
                "outputs": layer.out_features,
                "activation": ACTIVATIONS.get(type(following), "none"),
            }
            for layer, following in itertools.pairwise([*self.layers, None])
            if isinstance(layer, nn.Linear)
        ]


def build_network(trained: TrainedPolicy, where: str = "model") -> Network:
    """Build the network of an SB3 model with ``MlpPolicy``, on-policy, SAC's or TD3's, with its
    scaling and its rotors.

    :param where: the name of the model in messages.
    :raises ConfigError: an unknown output, other spaces than the quadcopter's, a policy
        that :func:`check_policy` refuses, or a network with other layers than linear ones, tanh and
        ReLU.
    """
    refuse_unknown("output", [trained.output], OUTPUTS)
    # The policy must be one whose layers we know, on the spaces that its settings describe.
    model = trained.model
    layers = deterministic_layers(model.policy, where)
    expected = (trained.observation.size,)
    if model.observation_space.shape != expected:
        raise ConfigError(
            f"{where}: its observations are {model.observation_space}, "
            f"by its settings of shape {expected}"
        )
    if model.action_space != ACTIONS:
        raise ConfigError(
            f"{where}: its actions are {model.action_space}, the quadcopter's are {ACTIONS}"
        )
    # C knows these layers only.
    for layer in layers:
        if type(layer) not in (nn.Linear, *ACTIVATIONS):
            raise ConfigError(
                f"{where}: its network has a layer {layer}; "
                "only linear layers, Tanh and ReLU export"
            )
    return Network(layers, trained)


def own_layers(layers: nn.Sequential, trained: TrainedPolicy) -> nn.Sequential:
    """Copy a policy's layers for features in the vehicle's own body frame and its own order of the
    rotors.

    The first layer turns the features, and the last action; the last layer renumbers the rotors.
    Thrust and body rates stay, since their axes are those of the layout.
    """
    layers = copy.deepcopy(layers).to("cpu", th.float64).requires_grad_(False)
    turn = trained.turn
    linear = [layer for layer in layers if isinstance(layer, nn.Linear)]
    # Every observed frame is turned in the same way; the weights absorb the turn, so that files
    # stay as fast.
    shape = (len(trained.observation.ages), trained.observation.frame_size)
    frames = linear[0].weight[:, : math.prod(shape)].view(-1, *shape)
    features = frames[..., :OBSERVATION_SIZE]
    turned = turn_features(turn) * trained.std / trained.std[:, None]
    features.copy_(features @ th.from_numpy(turned))
    if trained.output == "rates":
        return layers
    if trained.observation.last_action:
        action = frames[..., OBSERVATION_SIZE:]
        action.copy_(action[..., turn.own])
    last = linear[-1]
    last.weight.copy_(last.weight[turn.own])
    last.bias.copy_(last.bias[turn.own])
    return layers


def deterministic_layers(policy: Any, where: str) -> nn.Sequential:
    """Return the layers from a policy's observations to its deterministic actions, before they are
    clipped.

    :raises ConfigError: see :func:`check_policy`.
    """
    # SAC and TD3 keep their policy in an actor.
    actor = getattr(policy, "actor", None)
    if actor is not None and type(actor.features_extractor) is FlattenExtractor:
        if type(policy) is TD3Policy:
            return nn.Sequential(*actor.mu)  # its tanh included
        if type(policy) is SACPolicy:
            # gSDE bounds the mean by a Hardtanh, which is in actor.mu and does not export.
            return nn.Sequential(*actor.latent_pi, actor.mu, nn.Tanh())
    check_policy(policy, where)
    layers = [*policy.mlp_extractor.policy_net, policy.action_net]
    # gSDE's squashed actions are the tanh of the mean; without squashing, the mean is clipped.
    if policy.squash_output:
        layers.append(nn.Tanh())
    return nn.Sequential(*layers)


def check_policy(policy: Any, where: str) -> None:
    """:raises ConfigError: a policy that is not ``MlpPolicy`` of an on-policy algorithm, or has
    custom extractors.
    """
    kinds = [
        type(policy),
        type(getattr(policy, "pi_features_extractor", None)),
        type(getattr(policy, "mlp_extractor", None)),
    ]
    if kinds != [ActorCriticPolicy, FlattenExtractor, MlpExtractor]:
        names = " with ".join(kind.__name__ for kind in kinds if kind is not type(None))
        raise ConfigError(
            f"{where}: its policy is {names}; "
            "only MlpPolicy (of PPO, A2C, DAgger, PPOBC, APG, SAC, TD3) will do, "
            "without a features extractor of its own"
        )


def write_onnx(network: Network, metadata: StrDict) -> bytes:
    """Return the model: from ``observation``, float32 (batch, numbers), to ``thrust`` or
    ``rotor_speed``, float32 (batch, 4).

    For a policy with a state, also from ``state`` to ``next_state``, float32 (batch, state_size).

    :param metadata: stored as the model's ``metadata_props``.
    :raises ConfigError: onnx is not installed.
    """
    onnx = require("onnx", "export", "--format onnx")
    # A policy without a state has only one input and one output.
    inputs = ["observation", "state"][: len(network.examples)]
    outputs = [network.result, "next_state"][: len(network.examples)]
    buffer: Any = io.BytesIO()
    th.onnx.export(
        network,
        network.examples,
        buffer,
        input_names=inputs,
        output_names=outputs,
        dynamic_axes={name: {0: "batch"} for name in (*inputs, *outputs)},
        # Any ONNX runtime since 2020 reads opset 13. The newer exporter (dynamo) needs onnxscript,
        # and writes opset 18 or later.
        opset_version=13,
        dynamo=False,
    )
    model = onnx.load_from_string(buffer.getvalue())
    model.producer_name = "sb3_quad"
    onnx.helper.set_model_props(model, metadata)
    onnx.checker.check_model(model, full_check=True)
    return bytes(model.SerializeToString())
