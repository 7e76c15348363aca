"""A policy as TorchScript: loads by ``torch.jit.load`` in Python and in C++ (libtorch)."""

from __future__ import annotations

import io
import json
import warnings
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_quad.export.check import Trial, time_calls
from sb3_quad.export.network import Float32Array, Network
from sb3_quad.simulation.observation import OBSERVATION_SIZE

if TYPE_CHECKING:
    import torch as th

METADATA = "metadata.json"  # the name of the extra file in the archive


def write(network: Network, metadata: Mapping[str, str]) -> bytes:
    """The traced module: float32 (batch, 18) to float32 (batch, 4).

    :param metadata: stored as the archive's extra file ``metadata.json``.
    """
    import torch as th

    buffer = io.BytesIO()
    with warnings.catch_warnings():
        # torch calls TorchScript deprecated: it still loads everywhere, also where torch.export's files do not.
        warnings.simplefilter("ignore", DeprecationWarning)
        traced = th.jit.trace(_module(network), th.zeros(2, OBSERVATION_SIZE))  # type: ignore[no-untyped-call]
        th.jit.save(traced, buffer, _extra_files={METADATA: json.dumps(dict(metadata))})
    return buffer.getvalue()


def run(content: bytes, observations: Float32Array) -> Trial:
    """What torch makes of the file, on the CPU.

    :param observations: physical units, (n, 18).
    """
    import torch as th

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        module = th.jit.load(io.BytesIO(content), map_location="cpu")  # type: ignore[no-untyped-call]

    def call(rows: Float32Array) -> Any:
        with th.no_grad():
            return module(th.from_numpy(rows)).numpy()

    return Trial(call(observations), time_calls(call, observations), f"torch {th.__version__}")


def _module(network: Network) -> th.nn.Module:
    import torch as th

    class Policy(th.nn.Module):
        """The network with its numbers as buffers."""

        def __init__(self) -> None:
            super().__init__()
            for name, value in (("mean", network.mean), ("inverse_std", network.inverse_std)):
                self.register_buffer(name, th.from_numpy(value.copy()))
            for k, layer in enumerate(network.layers):
                self.register_buffer(f"weight_{k}", th.from_numpy(layer.weight.copy()))
                self.register_buffer(f"bias_{k}", th.from_numpy(layer.bias.copy()))
            self.register_buffer("middle", th.tensor(np.float32(network.middle)))
            self.register_buffer("half_range", th.tensor(np.float32(network.half_range)))

        def forward(self, observation: th.Tensor) -> th.Tensor:
            """Rotor thrusts or speeds, (batch, 4), of observations, (batch, 18)."""
            buffers = dict(self.named_buffers())
            value = (observation - buffers["mean"]) * buffers["inverse_std"]
            for k, layer in enumerate(network.layers):
                value = th.nn.functional.linear(value, buffers[f"weight_{k}"], buffers[f"bias_{k}"])
                if layer.activation != "none":
                    value = th.tanh(value) if layer.activation == "tanh" else th.relu(value)
            value = buffers["middle"] + buffers["half_range"] * value.clamp(-1.0, 1.0)
            if network.output == "thrusts":
                return value
            return value.clamp_min(0.0).sqrt()  # rounding may leave a rotor that can stand still a hair below zero

    return Policy().eval()
