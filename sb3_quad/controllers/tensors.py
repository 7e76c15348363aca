"""Agents as safetensors files: the weights, and as text what else a zip says of an agent.

Nothing in such a file is a pickle. ``sb3-quad export --format safetensors`` writes them.
"""

import json
from pathlib import Path

import torch as th

from sb3_quad.base.errors import ConfigError, raised_as
from sb3_quad.base.imports import require
from sb3_quad.base.types import StrDict, StrPath

ENDING = ".safetensors"
AGENTS = (".zip", ENDING)
"""The endings of files that hold an agent."""
DATA = "sb3_quad"
"""The key of the file's metadata: JSON, as in an SB3 zip but for its pickles, with the
``policy_kwargs`` and the ``observation_size``.
"""


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
        data = dict(json.loads(file.metadata()[DATA]))
        return data, {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
