"""RAPTOR's network, 22-16-GRU 16-4, as a policy to train and to fly in PX4's ``mc_raptor`` (docs/px4.md)."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import Schedule
from torch import nn

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.imports import require
from sb3_quad.experts.raptor_frame import idle_share, motor_order, seen
from sb3_quad.simulation.observation import DEFAULT_MEAN, DEFAULT_STD, OBSERVATION_SIZE
from sb3_quad.vehicles.vehicle import Vehicle, load_vehicle

require("sb3_contrib", "recurrent", "RaptorPolicy")
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy  # noqa: E402

INPUTS, UNITS = OBSERVATION_SIZE + 4, 16
LEAST_SLOPE = 0.25  # of an action by its command, in the gradient: at -1 a rotor that can stand still has none


def motor_kwargs(vehicle: str | Vehicle) -> dict[str, Any]:
    """``policy_kwargs`` of :class:`RaptorPolicy` for a vehicle: the order of its rotors, and how slow they can be.

    :param vehicle: name, YAML path or :class:`~sb3_quad.vehicles.vehicle.Vehicle`.
    :raises ConfigError: an unknown vehicle; rotors that are no X, or turn the other way.
    """
    found = load_vehicle(vehicle)
    return {"motors": motor_order(found, "RaptorPolicy"), "idle": idle_share(found)}


class _Actions(th.autograd.Function):
    """Actions of motor commands. Its gradient is never lost, and pushes no command that is out of range further out."""

    @staticmethod
    def forward(ctx: Any, commands: th.Tensor, idle: float) -> th.Tensor:
        ctx.linear = linear = 2.0 * idle / (1.0 + idle)
        share = (commands.clamp(-1.0, 1.0) + 1.0) / 2.0
        ctx.save_for_backward(commands, share)
        return 2.0 * share * (share + linear * (1.0 - share)) - 1.0

    @staticmethod
    def backward(ctx: Any, *gradients: th.Tensor) -> tuple[th.Tensor, None]:
        commands, share = ctx.saved_tensors
        gradient = gradients[0] * (2.0 * (1.0 - ctx.linear) * share + ctx.linear).clamp(min=LEAST_SLOPE)
        outwards = ((commands > 1.0) & (gradient < 0.0)) | ((commands < -1.0) & (gradient > 0.0))
        return gradient.masked_fill(outwards, 0.0), None


class Motors(nn.Module):
    """From motor commands, linear in the rotors' speeds, to the environment's actions, linear in their thrusts, and back.

    With share s = idle + (1 - idle) (command + 1) / 2 of the greatest speed, the thrust is s² of the greatest thrust. A rotor
    that can stand still (idle 0) has the action 2 ((command + 1) / 2)² - 1.

    :param motors: for each rotor of the vehicle, which motor it is: 0 front right, 1 back right, 2 back left, 3 front left.
    :param idle: speed at command -1 over speed at command 1, in [0, 1).
    :raises ConfigError: values that do not fit.
    """

    def __init__(self, motors: Sequence[int], idle: float) -> None:
        super().__init__()
        if sorted(motors) != [0, 1, 2, 3]:
            raise ConfigError(f"motors {list(motors)}: must name each of 0, 1, 2, 3 once; motor_kwargs(vehicle) gives them")
        if not 0.0 <= idle < 1.0:
            raise ConfigError(f"idle {idle}: must be at least 0 and below 1; motor_kwargs(vehicle) gives it")
        self._rotor_motors, self._motor_rotors, self._idle = list(motors), np.argsort(motors).tolist(), float(idle)

    def forward(self, commands: th.Tensor) -> th.Tensor:
        """Actions, (n, 4), in [-1, 1] and the rotors' order, of commands, (n, 4), in the motors' order, which are clipped."""
        actions: th.Tensor = _Actions.apply(commands[:, self._rotor_motors], self._idle)  # type: ignore[no-untyped-call]
        return actions

    def commands(self, actions: th.Tensor) -> th.Tensor:
        """Commands, (n, 4), of actions, (n, 4); of four zeros, which begin an episode, zeros, as ``mc_raptor`` begins."""
        squares = self._idle**2 + (1.0 - self._idle**2) * (actions.clamp(-1.0, 1.0) + 1.0) / 2.0
        found = 2.0 * (squares.sqrt() - self._idle) / (1.0 - self._idle) - 1.0
        return found[:, self._motor_rotors].masked_fill((actions == 0.0).all(dim=1, keepdim=True), 0.0)


class RaptorExtractor(BaseFeaturesExtractor):
    """The 22 inputs of ``mc_raptor``, of an observation with the last action, and the network's first layer.

    :param observation_space: of 22 numbers: ``last_action: true`` in ``env_kwargs``, with the scaling of Table A.2.
    :param motors: see :class:`Motors`, as is ``idle``.
    :param features_dim: units of the layer.
    :raises ConfigError: another observation.
    """

    mean: th.Tensor
    std: th.Tensor

    def __init__(
        self, observation_space: spaces.Space[Any], motors: Sequence[int], idle: float, features_dim: int = UNITS
    ) -> None:
        if observation_space.shape != (INPUTS,):
            raise ConfigError(
                f"RaptorPolicy: sees {INPUTS} numbers, the environment shows {observation_space.shape}; "
                "set last_action: true in env_kwargs, and no history"
            )
        super().__init__(observation_space, features_dim)
        self.motors, self.layer = Motors(motors, idle), nn.Linear(INPUTS, features_dim)
        for name, values in {"mean": DEFAULT_MEAN, "std": DEFAULT_STD}.items():
            self.register_buffer(name, th.as_tensor(values, dtype=th.float32), persistent=False)

    def inputs(self, observations: th.Tensor) -> th.Tensor:
        """Those 22: what :func:`~sb3_quad.experts.raptor_frame.seen` says, and the last motor commands; (n, 22)."""
        features = observations[:, :OBSERVATION_SIZE] * self.std + self.mean
        return th.hstack([seen(features), self.motors.commands(observations[:, OBSERVATION_SIZE:])])

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """The first layer's outputs, (n, features_dim)."""
        return self.layer(self.inputs(observations)).relu()  # type: ignore[no-any-return]


class GatedUnit(nn.GRU):
    """A GRU that is called as sb3-contrib calls an LSTM, with (h, c); c comes back as it was."""

    def forward(self, x: th.Tensor, state: Any = None) -> Any:  # type: ignore[override]
        """Outputs (steps, n, units), and (h, c) after them."""
        hidden, cell = state
        output, hidden = super().forward(x, hidden)
        return output, (hidden, cell)


class RaptorPolicy(RecurrentActorCriticPolicy):
    """The policy of PX4's ``mc_raptor``: 22 inputs, a layer of 16 with ReLU, a GRU of 16 units, four motor commands.

    For sb3-contrib's ``RecurrentPPO`` and what is like it, in environments with ``last_action: true`` and the default scaling.
    Its actions are the environment's. The critic has a features extractor of its own and no memory, unless it is given one.

    :param net_arch: ``{"pi": [], "vf": [...]}``, of the critic alone; None: 64, 64.
    :param motors: for each rotor of the vehicle, which motor it is; the default is right for ``itm``. See :class:`Motors`.
    :param idle: least speed of a rotor over its greatest. :func:`motor_kwargs` gives both for a vehicle.
    :param lstm_hidden_size: units of the GRU; ``mc_raptor`` loads 16 and nothing else.
    :param kwargs: of ``RecurrentActorCriticPolicy``.
    :raises ConfigError: another observation, or values that do not fit.
    """

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        lr_schedule: Schedule,
        net_arch: dict[str, list[int]] | None = None,
        motors: Sequence[int] = (3, 0, 1, 2),
        idle: float = 0.0,
        lstm_hidden_size: int = UNITS,
        **kwargs: Any,
    ) -> None:
        arch = {"pi": [], "vf": [64, 64]} if net_arch is None else net_arch
        if not isinstance(arch, dict) or arch.get("pi"):
            raise ConfigError(f"net_arch {arch}: RaptorPolicy has no layers behind its GRU; give {{pi: [], vf: [64, 64]}}")
        self.motors, self.idle = tuple(motors), float(idle)
        extractor = {"motors": self.motors, "idle": self.idle}
        chosen = {"enable_critic_lstm": False, "share_features_extractor": False, **kwargs}
        chosen["features_extractor_class"] = RaptorExtractor
        chosen["features_extractor_kwargs"] = {**(kwargs.get("features_extractor_kwargs") or {}), **extractor}
        super().__init__(
            observation_space, action_space, lr_schedule, net_arch=arch, lstm_hidden_size=lstm_hidden_size, **chosen
        )
        self.lstm_actor: Any = GatedUnit(self.features_dim, lstm_hidden_size, num_layers=self.lstm_actor.num_layers)
        self.action_net: Any = nn.Sequential(self.action_net, Motors(self.motors, self.idle))
        self.optimizer = self.optimizer_class(self.parameters(), lr=lr_schedule(1), **self.optimizer_kwargs)  # type: ignore[call-arg]

    def layers(self) -> tuple[nn.Linear, nn.GRU, nn.Linear]:
        """The network's three layers, the first one before its ReLU."""
        return self.pi_features_extractor.layer, self.lstm_actor, self.action_net[0]  # type: ignore[return-value]

    def _get_constructor_parameters(self) -> dict[str, Any]:
        units = {"lstm_hidden_size": self.lstm_output_dim, "enable_critic_lstm": self.enable_critic_lstm}
        return {**super()._get_constructor_parameters(), **units, "motors": self.motors, "idle": self.idle}
