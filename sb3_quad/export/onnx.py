"""A policy as an ONNX model, node by node; opset 13, which any runtime since 2020 reads."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sb3_quad.base.errors import ConfigError
from sb3_quad.export.check import Trial, time_calls
from sb3_quad.export.network import N_ROTORS, Float32Array, Network
from sb3_quad.simulation.observation import OBSERVATION_SIZE

OPSET, IR_VERSION = 13, 7


def write(network: Network, metadata: Mapping[str, str]) -> bytes:
    """The model: ``observation`` float32 (batch, 18) to ``thrust`` or ``rotor_speed``, float32 (batch, 4).

    :param metadata: stored as the model's ``metadata_props``.
    :raises ConfigError: onnx is not installed.
    """
    onnx = _import("onnx")
    helper, numpy_helper, real = onnx.helper, onnx.numpy_helper, onnx.TensorProto.FLOAT
    constants: list[Any] = []
    nodes: list[Any] = []

    def constant(name: str, value: Any) -> str:
        constants.append(numpy_helper.from_array(np.asarray(value, dtype=np.float32), name))
        return name

    def node(kind: str, *inputs: str, name: str | None = None, **attributes: Any) -> str:
        result = name or f"{kind.lower()}_{len(nodes)}"
        nodes.append(helper.make_node(kind, list(inputs), [result], **attributes))
        return result

    value = node("Sub", "observation", constant("observation_mean", network.mean))
    value = node("Mul", value, constant("observation_inverse_std", network.inverse_std))
    for k, layer in enumerate(network.layers):
        weight, bias = constant(f"weight_{k}", layer.weight), constant(f"bias_{k}", layer.bias)
        value = node("Gemm", value, weight, bias, transB=1)
        if layer.activation != "none":
            value = node({"tanh": "Tanh", "relu": "Relu"}[layer.activation], value)
    value = node("Clip", value, constant("least", -1.0), constant("greatest", 1.0))
    value = node("Mul", value, constant("half_range", network.half_range))
    last = network.output == "thrusts"
    value = node("Add", value, constant("middle", network.middle), name=network.result if last else None)
    if not last:  # rounding may leave a rotor that can stand still a hair below zero
        node("Sqrt", node("Relu", value), name=network.result)
    graph = helper.make_graph(
        nodes,
        "policy",
        [helper.make_tensor_value_info("observation", real, ["batch", OBSERVATION_SIZE])],
        [helper.make_tensor_value_info(network.result, real, ["batch", N_ROTORS])],
        constants,
    )
    opset = [helper.make_opsetid("", OPSET)]
    model = helper.make_model(graph, opset_imports=opset, ir_version=IR_VERSION, producer_name="sb3_quad")
    helper.set_model_props(model, dict(metadata))
    onnx.checker.check_model(model, full_check=True)
    return bytes(model.SerializeToString())


def run(content: bytes, observations: Float32Array) -> Trial:
    """What onnxruntime makes of the file, on one thread of the CPU.

    :param observations: physical units, (n, 18).
    :raises ConfigError: onnxruntime is not installed.
    """
    runtime = _import("onnxruntime")
    options = runtime.SessionOptions()
    options.intra_op_num_threads = 1
    session = runtime.InferenceSession(content, options, providers=["CPUExecutionProvider"])

    def call(rows: Float32Array) -> Any:
        return session.run(None, {"observation": rows})[0]

    return Trial(call(observations), time_calls(call, observations), f"onnxruntime {runtime.__version__}")


def _import(name: str) -> Any:
    import importlib

    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ConfigError(f"--format onnx needs {name} ({error}): pip install 'sb3_quad[export]'") from None
