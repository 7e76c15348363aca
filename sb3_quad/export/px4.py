"""A policy as a TensorFlow Lite file for PX4's module mc_nn_control.

The inputs that the module gives a network, and its use of the outputs, are in
``src/modules/mc_nn_control`` of PX4-Autopilot: ``PopulateInputTensor``, ``RegisterOps``,
``RescaleActions``.
"""

from functools import partial
from typing import Any

import numpy as np

from sb3_quad.base.errors import ConfigError, raised_as
from sb3_quad.base.imports import require
from sb3_quad.base.types import Float32Array, StrDict
from sb3_quad.envs.simulation.observation import GROUPS, F
from sb3_quad.envs.vehicles.layout import ORDERS
from sb3_quad.envs.vehicles.vehicle import Vehicle
from sb3_quad.export.load import Call
from sb3_quad.export.network import Network

PARAMETERS = "px4.params"
FILES = ("control_net.cpp", "control_net.hpp", PARAMETERS)
ARENA = 10 * 1024  # bytes that the module gives the interpreter
# The features that the 15 inputs correspond to. The module provides the first two rows of the
# rotation matrix from body to world, which are columns of ours, and target - position.
SHOWN = np.r_[
    GROUPS["position"],
    F.rotation : F.velocity : 3,
    F.rotation + 1 : F.velocity : 3,
    GROUPS["velocity"],
    GROUPS["body_rates"],
]
SIGNS = np.repeat([-1.0, 1.0], [3, 12]).astype(np.float32)


def write_px4(network: Network, metadata: StrDict) -> bytes:
    """Return the file: inputs float32 (1, 15), outputs (1, 4), the actions of PX4's motors.

    :raises ConfigError: tflite is not installed; a network that the module cannot compute.
    """
    tflite = require("tflite", "px4", "--format px4")
    builder = require("flatbuffers", "px4", "--format px4").Builder()
    _check(network)
    # Weights and biases in turn. The first layer scales its inputs, the last one numbers the motors
    # as PX4 does.
    values = [parameter.numpy() for parameter in network.layers.parameters()]
    scaled = values[0][:, SHOWN] * network.inverse_std.numpy()[SHOWN]
    values[1] = values[1] - scaled @ network.mean.numpy()[SHOWN]
    values[0] = scaled * SIGNS
    motors = motor_order(network.trained.own)
    values[-2:] = values[-2][motors], values[-1][motors]

    def table(kind: str, **fields: Any) -> Any:
        getattr(tflite, f"{kind}Start")(builder)
        for name, value in fields.items():
            getattr(tflite, f"{kind}Add{name}")(builder, value)
        return getattr(tflite, f"{kind}End")(builder)

    def vector(content: Any, prepend: Any = builder.PrependInt32, size: int = 4) -> Any:
        # The interpreter reads numbers in place, so all are aligned.
        builder.StartVector(size, len(content), 16)
        for element in reversed(content):
            prepend(element)
        return builder.EndVector()

    tables = partial(vector, prepend=builder.PrependUOffsetTRelative)
    buffers: list[Any] = []
    tensors: list[Any] = []

    def tensor(array: Any, constant: bool = True) -> int:
        # Tensors that the network computes have an empty buffer. Float32 is the schema's default.
        content = vector(array.tobytes() * constant, builder.PrependByte, 1)
        buffers.append(table("Buffer", Data=content))
        tensors.append(table("Tensor", Shape=vector(array.shape), Buffer=len(tensors)))
        return len(tensors) - 1

    operators = []
    last = tensor(SIGNS[None], False)
    for shape, weights, bias in zip(network.shapes, values[::2], values[1::2], strict=True):
        inputs = vector([last, tensor(weights), tensor(bias)])
        last = tensor(bias[None], False)
        outputs = vector([last])
        bends = int(shape["activation"] == "relu")
        operators.append(
            table(
                "Operator",
                Inputs=inputs,
                Outputs=outputs,
                BuiltinOptionsType=tflite.BuiltinOptions.FullyConnectedOptions,
                BuiltinOptions=table("FullyConnectedOptions", FusedActivationFunction=bends),
            )
        )
    kind = tflite.BuiltinOperator.FULLY_CONNECTED
    code = table("OperatorCode", DeprecatedBuiltinCode=kind, BuiltinCode=kind)
    graph = table(
        "SubGraph",
        Tensors=tables(tensors),
        Inputs=vector([0]),
        Outputs=vector([last]),
        Operators=tables(operators),
    )
    model = table(
        "Model",
        Version=3,
        OperatorCodes=tables([code]),
        Subgraphs=tables([graph]),
        Buffers=tables(buffers),
        Description=builder.CreateString(metadata["policy"]),
    )
    builder.Finish(model, b"TFL3")
    return bytes(builder.Output())


def _check(network: Network) -> None:
    trained = network.trained
    kinds = {shape["activation"] for shape in network.shapes}
    seen = network.observation
    refusals = {
        "keeps no state: train without last_action, history, position_integral and preview": (
            seen.is_extended or seen.preview
        ),
        "computes linear layers and ReLU: train with policy_kwargs of activation_fn=nn.ReLU": (
            "tanh" in kinds
        ),
        "takes -1 for no thrust: give the vehicle rotor_thrust_limits from 0, and train for it": (
            trained.vehicle.thrust_range[0] > 0.0
        ),
        "takes actions as they are: train without normalize and a turned rotor_layout": (
            trained.clip or trained.turn.angle
        ),
    }
    for refusal, holds in refusals.items():
        if holds:
            raise ConfigError(f"--format px4: PX4's module {refusal}")


def motor_order(vehicle: Vehicle) -> list[int]:
    """Return the rotor of a vehicle that each of PX4's motors 1 to 4 turns.

    :raises ConfigError: not one rotor in each corner.
    """
    corners = list(map(tuple, np.sign(vehicle.rotor_positions)))
    with raised_as(
        ConfigError, f"--format px4: vehicle {vehicle.name}: needs a rotor in each corner"
    ):
        return [corners.index(corner) for corner in ORDERS["px4"]]


def load_px4(content: bytes, state_size: int, vehicle: Vehicle) -> tuple[Call, str]:
    """Load the file with TensorFlow Lite Micro, in an arena of the module's size, with the module's
    own processing before and after it; see :func:`.load.load_onnx`.

    :raises ConfigError: tflite-micro is not installed; the network needs a larger arena.
    """
    runtime = require("tflite_micro", "px4", "--format px4").runtime
    what = f"--format px4: needs more than {ARENA} bytes; train smaller layers"
    with raised_as(ConfigError, what):
        interpreter = runtime.Interpreter.from_bytes(content, arena_size=ARENA)
    motors = motor_order(vehicle)

    def call(rows: Float32Array, state: Any = None) -> Any:
        actions = np.empty((len(rows), 4))
        for row, shown in enumerate(rows[:, SHOWN] * SIGNS):
            interpreter.set_input(shown[None], 0)
            interpreter.invoke()
            actions[row, motors] = interpreter.get_output(0)[0]
        return vehicle.action_to_thrust(actions), state

    return call, "tflite-micro"
