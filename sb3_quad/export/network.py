"""What a policy computes, as one torch module, and what torch traces of it: TorchScript and ONNX."""

import copy
import io
import itertools
import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import FlattenExtractor, MlpExtractor
from stable_baselines3.sac.policies import SACPolicy
from stable_baselines3.td3.policies import TD3Policy

from sb3_quad.base.errors import ConfigError, unknown
from sb3_quad.base.imports import require
from sb3_quad.evaluation.flights import ACTIONS
from sb3_quad.export.check import Reference
from sb3_quad.simulation.observation import GROUPS, OBSERVATION_SIZE
from sb3_quad.vehicles.layout import Turn

ACTIVATIONS: dict[type[Any], str] = {th.nn.Tanh: "tanh", th.nn.ReLU: "relu"}
OUTPUTS = {"thrusts": ("thrust", "N"), "speeds": ("rotor_speed", "rad/s")}
"""Each output with the name and the unit of one of its four numbers."""
EXAMPLE = th.zeros(2, OBSERVATION_SIZE)


class Network(th.nn.Module):
    """A deterministic policy from 18 features in physical units to the four rotors, all of it
    float32, on the CPU.

    ``a = clip(layers((features - mean) * inverse_std), -1, 1)``, then ``q = middle + half_range *
    a`` (Eq. 3.18): thrusts, N. For speeds, middle and half_range are divided by kF, and the result
    is the root of q, rad/s (Eq. 2.4).

    :param layers: linear layers, each with the activation that follows it, if any; they are copied.
    :param reference: its scaling, vehicle and output; features and rotors are those of the
        vehicle's own layout.
    """

    mean: th.Tensor
    inverse_std: th.Tensor
    middle: th.Tensor
    half_range: th.Tensor
    examples: tuple[th.Tensor, ...] = (EXAMPLE,)
    facts: Mapping[str, str] = {}  # for the file's metadata

    def __init__(self, layers: th.nn.Sequential, reference: Reference) -> None:
        super().__init__()
        self.output, vehicle = reference.output, reference.vehicle
        self.result, self.unit = OUTPUTS[self.output]
        self.inputs, self.outputs = ["observation"], [self.result]
        low, high = np.array(vehicle.thrust_range) / (
            1.0 if self.output == "thrusts" else vehicle.thrust_coefficient
        )
        buffers = {"mean": reference.own_mean, "inverse_std": 1.0 / reference.std}
        buffers |= {"middle": (high + low) / 2, "half_range": (high - low) / 2}
        for name, value in buffers.items():
            self.register_buffer(name, th.as_tensor(value, dtype=th.float32))
        self.layers = own_layers(layers, reference).to(th.float32)
        self.eval()

    def forward(self, observation: th.Tensor) -> th.Tensor:
        """Rotor thrusts or speeds, (batch, 4), of observations, (batch, 18)."""
        return self.command(
            self.layers((observation - self.mean) * self.inverse_std).clamp(-1.0, 1.0)
        )

    def command(self, action: th.Tensor) -> th.Tensor:
        """Rotor thrusts or speeds, (batch, 4), of actions."""
        value: th.Tensor = self.middle + self.half_range * action
        # Rounding may leave a rotor that can stand still a hair below zero.
        return value if self.output == "thrusts" else value.relu().sqrt()

    @property
    def steps(self) -> list[tuple[th.nn.Linear, str]]:
        """Each linear layer, and the name of the activation that follows it: ``tanh``, ``relu`` or
        ``none``.
        """
        pairs = itertools.pairwise([*self.layers, None])
        return [
            (each, ACTIVATIONS.get(type(after), "none"))
            for each, after in pairs
            if isinstance(each, th.nn.Linear)
        ]


class StatefulNetwork(Network):
    """A network with the frames of :mod:`sb3_quad.simulation.frames` in a state, float32 (batch,
    ``state_size``).

    The state is zeros as a flight begins. It holds what the policy sees of these: the last action
    (4); the integral s (3), m, with a 1 once a flight has begun; the earlier frames, scaled, the
    latest first.

    :param reference: its ``observation`` says what the policy sees.
    """

    def __init__(self, layers: th.nn.Sequential, reference: Reference) -> None:
        super().__init__(layers, reference)
        seen, integral = reference.observation, reference.observation.position_integral
        self.observation, self.integral = (
            seen,
            integral and integral.numbers(reference.vehicle.control_step),
        )
        self.actions = 4 * seen.last_action  # numbers of the last action in the state
        self.newest = self.actions + 4 * (
            integral is not None
        )  # where the latest frame begins in it
        state_size = self.newest + seen.ages[-1] * seen.frame_size
        self.inputs, self.outputs = ["observation", "state"], [self.result, "next_state"]
        self.examples = EXAMPLE, th.zeros(len(EXAMPLE), state_size)
        kept = [f"{name} {value}" for name, value in seen.model_dump(mode="json").items() if value]
        rule = "zeros begin a flight, then it is the next_state of the call before; in C a struct, which NAME_reset begins"
        self.facts = {
            "state": f"{rule}. It holds what {', '.join(kept)} need",
            "state_size": f"{state_size}",
        }

    def forward(self, observation: th.Tensor, state: th.Tensor) -> Any:  # type: ignore[override]
        """Rotor thrusts or speeds, (batch, 4), and the next state, of observations, (batch, 18),
        and the present state.
        """
        frame, kept = (observation - self.mean) * self.inverse_std, []
        if self.integral:
            gain, distance2, speed2, limit = self.integral
            e, v = observation[:, GROUPS["position"]], observation[:, GROUPS["velocity"]]
            s, begun = (
                state[:, self.actions : self.newest - 1],
                state[:, self.newest - 1 : self.newest],
            )
            near = (e.square().sum(1, keepdim=True) < distance2) & (
                v.square().sum(1, keepdim=True) < speed2
            )
            s = th.where(near & (begun > 0), s + gain * e, s).clamp(-limit, limit)
            shifted = frame[:, :3] + s * self.inverse_std[:3]  # the position comes first
            frame, kept = th.cat([shifted, frame[:, 3:]], dim=1), [s, begun.clamp(min=1.0)]
        frames = th.cat([frame, state[:, : self.actions], state[:, self.newest :]], dim=1)
        size, ages = self.observation.frame_size, self.observation.ages
        action = self.layers(
            th.cat([frames[:, age * size : (age + 1) * size] for age in ages], dim=1)
        ).clamp(-1.0, 1.0)
        following = [action[:, : self.actions], *kept, frames[:, : ages[-1] * size]]
        return self.command(action), th.cat(following, dim=1)


def build_network(reference: Reference, where: str = "model") -> Network:
    """The policy of an SB3 model with ``MlpPolicy``, on-policy, SAC's or TD3's; its scaling and its
    rotors.

    :param where: what messages call the model.
    :raises ConfigError: an unknown output, other spaces than the quadcopter's, a policy that
        :func:`check_policy` refuses, or a network with other layers than linear ones, tanh and
        ReLU.
    """
    if reference.output not in OUTPUTS:
        raise ConfigError(unknown("output", reference.output, OUTPUTS))
    policy: Any = reference.model.policy
    layers = deterministic_layers(policy, where)
    seen, done = reference.model.observation_space, reference.model.action_space
    if seen.shape != (reference.observation.size,):
        raise ConfigError(
            f"{where}: its observations are {seen}, by its settings of shape ({reference.observation.size},)"
        )
    if done != ACTIONS:
        raise ConfigError(f"{where}: its actions are {done}, the quadcopter's are {ACTIONS}")
    for layer in layers:
        if type(layer) is not th.nn.Linear and type(layer) not in ACTIVATIONS:
            raise ConfigError(
                f"{where}: its network has a layer {layer}; only linear layers, Tanh and ReLU export"
            )
    if not all(bool(parameter.isfinite().all()) for parameter in layers.parameters()):
        raise ConfigError(f"{where}: holds parameters that are not finite")
    kind = StatefulNetwork if reference.observation.is_extended else Network
    return kind(layers, reference)


def own_layers(layers: th.nn.Sequential, reference: Reference) -> th.nn.Sequential:
    """A copy of a policy's layers for features in the vehicle's own body frame and its own order of
    the rotors.

    Turning the features, and the last action, is a part of the first layer; the order of the rotors
    is one of the last.
    """
    layers = copy.deepcopy(layers).to("cpu", th.float64).requires_grad_(False)
    linear = [each for each in layers if isinstance(each, th.nn.Linear)]
    if reference.turn == Turn() or not linear:
        return layers
    seen, std, own = reference.observation, reference.std, reference.turn.own
    frame, n = np.eye(seen.frame_size), OBSERVATION_SIZE
    frame[:n, :n] = reference.turned_features * std / std[:, None]
    frame[n:, n:] = np.eye(4)[[*reference.turn.order]] if seen.last_action else 0.0
    linear[0].weight.copy_(linear[0].weight @ th.from_numpy(np.kron(np.eye(len(seen.ages)), frame)))
    linear[-1].weight.copy_(linear[-1].weight[own])
    linear[-1].bias.copy_(linear[-1].bias[own])
    return layers


def deterministic_layers(policy: Any, where: str) -> th.nn.Sequential:
    """The layers from a policy's observations to its deterministic actions, before they are
    clipped.

    :raises ConfigError: see :func:`check_policy`.
    """
    if (
        type(policy) in (SACPolicy, TD3Policy)
        and type(policy.actor.features_extractor) is FlattenExtractor
    ):
        actor = policy.actor
        if type(policy) is TD3Policy:
            return th.nn.Sequential(*actor.mu)  # its tanh included
        return th.nn.Sequential(
            *actor.latent_pi, actor.mu, th.nn.Tanh()
        )  # gSDE bounds the mean by a Hardtanh
    check_policy(policy, where)
    # gSDE's squashed actions are the tanh of the mean; without squashing the mean is clipped.
    squash = [th.nn.Tanh()] if policy.squash_output else []
    return th.nn.Sequential(*policy.mlp_extractor.policy_net, policy.action_net, *squash)


def check_policy(policy: Any, where: str) -> None:
    """:raises ConfigError: a policy that is not ``MlpPolicy`` of an on-policy algorithm, or has
    extractors of its own.
    """
    parts = (
        policy,
        getattr(policy, "pi_features_extractor", None),
        getattr(policy, "mlp_extractor", None),
    )
    if tuple(map(type, parts)) != (ActorCriticPolicy, FlattenExtractor, MlpExtractor):
        names = " with ".join(type(part).__name__ for part in parts if part is not None)
        raise ConfigError(
            f"{where}: its policy is {names}; only MlpPolicy (of PPO, A2C, DAgger, PPOBC, SAC, SACBC, TD3) will do, "
            "without a features extractor of its own"
        )


def write_torchscript(network: Network, metadata: Mapping[str, str]) -> bytes:
    """What ``torch.jit.load`` reads, in Python and in C++, with ``metadata`` as the extra file
    ``metadata.json``.
    """
    buffer = io.BytesIO()
    traced = th.jit.trace(network, network.examples)  # type: ignore[no-untyped-call]
    th.jit.save(traced, buffer, _extra_files={"metadata.json": json.dumps(dict(metadata))})
    return buffer.getvalue()


def write_onnx(network: Network, metadata: Mapping[str, str]) -> bytes:
    """The model: ``observation`` float32 (batch, 18) to ``thrust`` or ``rotor_speed``, float32
    (batch, 4).

    Of a policy with a state also ``state`` to ``next_state``, float32 (batch, state_size).

    :param metadata: stored as the model's ``metadata_props``.
    :raises ConfigError: onnx is not installed.
    """
    onnx = require("onnx", "export", "--format onnx")
    buffer: Any = io.BytesIO()
    batch = {name: {0: "batch"} for name in (*network.inputs, *network.outputs)}
    ports: dict[str, Any] = {
        "input_names": network.inputs,
        "output_names": network.outputs,
        "dynamic_axes": batch,
    }
    # Any ONNX runtime since 2020 reads opset 13. The newer exporter (dynamo) needs onnxscript, and
    # writes opset 18 or later.
    th.onnx.export(network, network.examples, buffer, opset_version=13, dynamo=False, **ports)
    model = onnx.load_from_string(buffer.getvalue())
    model.producer_name = "sb3_quad"
    onnx.helper.set_model_props(model, dict(metadata))
    onnx.checker.check_model(model, full_check=True)
    return bytes(model.SerializeToString())
