"""Agents as safetensors files: the weights, and as JSON the other attributes in a zip.

Nothing in such a file is a pickle. ``sb3-quad export --format safetensors`` writes them.
"""

import json
from pathlib import Path
from typing import Any

import torch as th

from sb3_quad.base.errors import ConfigError, raised_as
from sb3_quad.base.imports import require
from sb3_quad.base.types import StrDict, StrPath

ENDING = ".safetensors"
AGENTS = (".zip", ENDING)
"""The suffixes of files that contain an agent."""


def write_tensors(model: Any, data: StrDict) -> bytes:
    """Return a safetensors file of a model.

    :param data: the attributes of its zip, and further ones; pickled ones are left out.
    :raises ConfigError: safetensors is not installed.
    """
    safetensors = require("safetensors.torch", "export", "--format safetensors")
    plain = {
        key: value
        for key, value in data.items()
        if not (isinstance(value, dict) and ":serialized:" in value)
    }
    plain |= {
        "observation_size": model.observation_space.shape[0],
        # The module of the policy's class tells the algorithm's family.
        "policy_class": {"__module__": type(model.policy).__module__},
        "policy_kwargs": model.policy_kwargs,
    }
    text = json.dumps(plain, default=_class_name)
    return bytes(safetensors.save(model.policy.state_dict(), {"sb3_quad": text}))


def _class_name(value: Any) -> str:
    """Return the name of a class of PyTorch, as settings have it, such as ``nn.Tanh``."""
    return f"{value.__module__.split('.')[1]}.{value.__name__}"


def read_tensors(path: StrPath) -> tuple[StrDict, dict[str, th.Tensor]]:
    """Return the attributes of the model in a safetensors file, and its policy's parameters.

    :raises ConfigError: a missing file, a damaged one, or one that this package has not written.
    """
    where = f"model {path}"
    safetensors = require("safetensors", "export", where)
    if not Path(path).is_file():
        raise ConfigError(f"{where}: no such file")
    with (
        raised_as(ConfigError, f"{where}: not what sb3-quad export --format safetensors writes"),
        safetensors.safe_open(path, "pt") as file,
    ):
        data = dict(json.loads(file.metadata()["sb3_quad"]))
        return data, {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
