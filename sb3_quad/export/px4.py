"""A policy as PX4's module mc_nn_control computes it: a TensorFlow Lite file, the module's
parameters, and the C++ file with the network that PX4 is built with.

What the module gives a network and makes of its results is in ``src/modules/mc_nn_control`` of
PX4-Autopilot: ``PopulateInputTensor``, ``RegisterOps``, ``RescaleActions``.
"""

import math
import textwrap
from typing import Any

import numpy as np
from torch import nn

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.imports import require
from sb3_quad.base.types import FloatArray, StrDict
from sb3_quad.export.load import Call
from sb3_quad.export.network import Network
from sb3_quad.simulation.observation import OBSERVATION_SIZE, F
from sb3_quad.vehicles.vehicle import Vehicle

ARENA = 10 * 1024  # bytes that the module gives the interpreter
WHERE = "--format px4"
# The features behind the 15 inputs: the module shows target - position, then the rows of the
# rotation from body to world, of which two columns of ours are the first two.
SHOWN = [*range(F.position, F.position + 3)]
SHOWN += [F.rotation + 3 * row + column for column in range(2) for row in range(3)]
SHOWN += range(F.velocity, OBSERVATION_SIZE)
SIGNS = np.repeat([-1.0, 1.0], [3, 12])
# Motors 1 to 4 of PX4's quadcopter X: the signs of x (forward) and y (left)
CORNERS = {(1, -1): "front right", (-1, 1): "back left", (1, 1): "front left"}
CORNERS[-1, -1] = "back right"
# MC_NN_THRST_COEF may be this, at most; the module divides it by _SCALE.
_LARGEST = 5.0
_SCALE = 1e5

Layer = tuple[FloatArray, FloatArray, bool]
"""Weights (outputs, inputs), bias (outputs,), and whether a ReLU follows."""


def write_px4(network: Network, metadata: StrDict, vehicle: Vehicle) -> bytes:
    """Return the TensorFlow Lite file: inputs float32 (1, 15), outputs (1, 4), the motors' actions.

    :param network: that sees ``features: px4`` in the vehicle's own layout.
    :raises ConfigError: tflite is not installed; a network that the module cannot compute.
    """
    tflite = require("tflite", "px4", WHERE)
    builder = require("flatbuffers", "px4", WHERE).Builder(0)

    def table(kind: str, **fields: Any) -> int:
        getattr(tflite, f"{kind}Start")(builder)
        for name, value in fields.items():
            getattr(tflite, f"{kind}Add{name}")(builder, value)
        return int(getattr(tflite, f"{kind}End")(builder))

    def tables(offsets: list[int]) -> int:
        builder.StartVector(4, len(offsets), 4)
        for offset in reversed(offsets):
            builder.PrependUOffsetTRelative(offset)
        return int(builder.EndVector())

    def numbers(*values: int) -> int:
        return int(builder.CreateNumpyVector(np.array(values, np.int32)))

    # The first buffer is empty, and belongs to the tensors that the network computes.
    buffers = [table("Buffer")]
    tensors: list[int] = []
    operators = []

    def tensor(shape: tuple[int, ...], values: FloatArray | None = None) -> int:
        buffer = 0
        if values is not None:
            content = values.astype("<f4").tobytes()
            # The interpreter reads the numbers where they are.
            builder.StartVector(1, len(content), 16)
            for byte in reversed(content):
                builder.PrependByte(byte)
            buffer = len(buffers)
            buffers.append(table("Buffer", Data=builder.EndVector()))
        dimensions = numbers(*shape)
        tensors.append(
            table("Tensor", Shape=dimensions, Type=tflite.TensorType.FLOAT32, Buffer=buffer)
        )
        return len(tensors) - 1

    last = tensor((1, len(SHOWN)))
    for weights, bias, bends in _layers(network, vehicle):
        inputs = numbers(last, tensor(weights.shape, weights), tensor(bias.shape, bias))
        last = tensor((1, len(bias)))
        outputs = numbers(last)
        options = table("FullyConnectedOptions", FusedActivationFunction=int(bends))
        operators.append(
            table(
                "Operator",
                Inputs=inputs,
                Outputs=outputs,
                BuiltinOptionsType=tflite.BuiltinOptions.FullyConnectedOptions,
                BuiltinOptions=options,
            )
        )
    kind = tflite.BuiltinOperator.FULLY_CONNECTED
    codes = tables([table("OperatorCode", DeprecatedBuiltinCode=kind, BuiltinCode=kind, Version=1)])
    graph = {
        "Tensors": tables(tensors),
        "Inputs": numbers(0),
        "Outputs": numbers(last),
        "Operators": tables(operators),
    }
    graphs = tables([table("SubGraph", **graph)])
    described = builder.CreateString(metadata["policy"])
    model = {"OperatorCodes": codes, "Subgraphs": graphs, "Description": described}
    builder.Finish(table("Model", Version=3, **model, Buffers=tables(buffers)), b"TFL3")
    return bytes(builder.Output())


def _layers(network: Network, vehicle: Vehicle) -> list[Layer]:
    """Return the layers from the module's inputs to its outputs, in PX4's order of the motors."""
    if network.observation.is_extended or network.observation.preview:
        raise ConfigError(
            f"{WHERE}: PX4's module keeps no state and previews nothing; train without last_action,"
            " history, position_integral and preview"
        )
    layers: list[Layer] = []
    for layer in network.layers:
        if isinstance(layer, nn.Linear):
            layers.append((layer.weight.double().numpy(), layer.bias.double().numpy(), False))
        elif type(layer) is nn.ReLU:
            layers[-1] = (*layers[-1][:2], True)
        else:
            raise ConfigError(
                f"{WHERE}: PX4's module computes FullyConnected, Relu and Add, not {layer}; train"
                " with policy_kwargs of activation_fn=nn.ReLU"
            )
    # The first layer scales its inputs.
    weights, bias, bends = layers[0]
    scaled = (weights * network.inverse_std.numpy())[:, SHOWN]
    bias = bias - scaled @ network.mean.numpy()[SHOWN]
    layers[0] = scaled * SIGNS, bias, bends
    # The module clips results to [-1, 1], takes -1 as no thrust and 1 as the greatest.
    weights, bias, _ = layers[-1]
    motors = motor_order(vehicle)
    low, high = vehicle.thrust_range
    layers[-1] = weights[motors], bias[motors], False
    if low > 0.0:
        # The least thrust, -1 of ours, is more than -1 of theirs.
        layers[-1] = weights[motors], bias[motors] + 1.0, True
        layers.append((np.eye(4) * (1.0 - low / high), np.full(4, 2.0 * low / high - 1.0), False))
    return layers


def motor_order(vehicle: Vehicle) -> list[int]:
    """Return the rotor of a vehicle that each of PX4's motors 1 to 4 turns.

    :raises ConfigError: not one rotor in each corner.
    """
    corners = [tuple(np.sign(place).astype(int)) for place in vehicle.rotor_positions]
    if {*corners} != {*CORNERS}:
        raise ConfigError(
            f"{WHERE}: vehicle {vehicle.name} has not one rotor in each corner, as PX4's"
            " quadcopter X has; export it for a vehicle of that layout with --vehicle"
        )
    return [corners.index(corner) for corner in CORNERS]


def px4_parameters(vehicle: Vehicle) -> dict[str, str]:
    """Return PX4's parameters for a vehicle, by name.

    The motors' speeds follow from its thrust limits and its kF.
    """
    low, high = vehicle.thrust_range
    fastest = math.sqrt(high / vehicle.thrust_coefficient) / (2.0 * math.pi)
    # The action 1 is twice this coefficient times the square of the revolutions per second. Where
    # PX4 does not take as much, all speeds are smaller, in proportion.
    coefficient = min(2.0 * _SCALE / fastest**2, _LARGEST)
    most = 60.0 * math.sqrt(2.0 * _SCALE / coefficient)
    return {
        "MC_NN_EN": "1",
        "MC_NN_THRST_COEF": f"{coefficient:.5g}",
        "MC_NN_MAX_RPM": f"{most:.0f}",
        "MC_NN_MIN_RPM": f"{most * math.sqrt(low / high):.0f}",
        "MC_NN_MANL_CTRL": "1",
        "THR_MDL_FAC": "0.8",
    }


def describe_px4(vehicle: Vehicle) -> StrDict:
    """Return what the user of the file must know, by the names of the other formats' facts."""
    turns = {-1: "counter-clockwise", 1: "clockwise"}
    motors = []
    for rotor, corner in zip(motor_order(vehicle), CORNERS.values(), strict=True):
        turn = turns[vehicle.rotor_directions[rotor]]
        motors.append(f"{len(motors) + 1} {corner}, {turn} from above")
    return {
        "observation": "15 numbers of mc_nn_control: target - position, m, world frame; the first "
        "two rows of the rotation matrix body to world; velocity, m/s, world frame; body rates, "
        "rad/s; world: x east, y north, z up; body: x forward, y left, z up",
        "result": "4 actions of PX4's motors, -1 no thrust, 1 "
        f"{vehicle.thrust_range[1]:.6g} N each",
        "motors": "; ".join(motors),
        "parameters": ", ".join(f"{k} {v}" for k, v in px4_parameters(vehicle).items()),
    }


def px4_files(content: bytes, vehicle: Vehicle) -> dict[str, bytes]:
    """Return what else PX4 needs, by the ending of the file: the parameters as commands of its
    shell, and the source file that takes the place of the module's control_net.cpp.
    """
    commands = [f"param set {name} {value}\n" for name, value in px4_parameters(vehicle).items()]
    table = "\n".join(textwrap.wrap(", ".join(map(str, content)), 100))
    source = (
        '#include <cstdint>\n#include "control_net.hpp"\n\n'
        f"alignas(16) const unsigned char control_net_tflite[] = {{\n{table}\n}};\n"
    )
    return {".params": "".join(commands).encode(), ".cpp": source.encode()}


def load_px4(content: bytes, state_size: int, vehicle: Vehicle) -> tuple[Call, str]:
    """Load the file by TensorFlow Lite Micro, in an arena of the module's size, with what the
    module does before and after it; see :func:`.load.load_torchscript`.

    :raises ConfigError: tflite-micro is not installed; the network needs a larger arena.
    """
    runtime = require("tflite_micro", "px4", WHERE).runtime
    try:
        interpreter = runtime.Interpreter.from_bytes(content, arena_size=ARENA)
    except RuntimeError as error:
        raise ConfigError(
            f"{WHERE}: the network needs more than the {ARENA // 1024} KiB that PX4's module has "
            f"({error}); train one with smaller layers"
        ) from None
    motors = motor_order(vehicle)
    _, high = vehicle.thrust_range

    def call(rows: FloatArray, _: Any = None) -> Any:
        thrusts = np.empty((len(rows), 4), np.float32)
        inputs = (rows[:, SHOWN] * SIGNS).astype(np.float32)
        for row in range(len(rows)):
            interpreter.set_input(inputs[row : row + 1], 0)
            interpreter.invoke()
            actions = interpreter.get_output(0)[0].clip(-1.0, 1.0)
            thrusts[row, motors] = 0.5 * high * (actions + 1.0)
        return thrusts, None

    return call, "tflite-micro"
