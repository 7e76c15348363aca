"""A trained zip as a safetensors file: weights and settings without a pickle."""

import json
import tempfile
from pathlib import Path
from typing import Any

import torch as th

from sb3_quad.base.errors import ConfigError, ExportError
from sb3_quad.base.imports import require
from sb3_quad.base.literals import parse_mapping
from sb3_quad.base.types import StrDict, StrPath
from sb3_quad.controllers.agent_settings import agent_settings
from sb3_quad.controllers.statistics import statistics_of
from sb3_quad.controllers.tensors import DATA, ENDING
from sb3_quad.controllers.zips import load_model, saved_data
from sb3_quad.evaluation.flights import ACTIONS
from sb3_quad.export.network import deterministic_layers
from sb3_quad.simulation.settings import KEY


def write_tensors(path: StrPath) -> bytes:
    """Return the file of an agent; all commands read it as they read the zip.

    :raises ConfigError: safetensors is not installed; a zip that cannot be read, an agent of
        another environment, or one that its weights and plain settings do not describe.
    :raises ExportError: the agent in the file has other parameters.
    """
    where = f"model {path}"
    safetensors = require("safetensors.torch", "export", "--format safetensors")
    model: Any = load_model(path)
    policy = model.policy
    deterministic_layers(policy, where)
    if model.action_space != ACTIONS or statistics_of(model) or model.use_sde:
        raise ConfigError(
            f"{where}: --format safetensors holds agents of this package's environments alone,"
            " without normalize and use_sde; keep the zip"
        )
    keywords: StrDict = {
        "net_arch": policy.net_arch,
        "activation_fn": f"nn.{policy.activation_fn.__name__}",
    }
    if "n_critics" in model.policy_kwargs:
        keywords["n_critics"] = model.policy_kwargs["n_critics"]
    # Raises for an activation that a file cannot name.
    parse_mapping(keywords, f"{where}: policy_kwargs")
    data: StrDict = {}
    for key, value in saved_data(path).items():
        if not (isinstance(value, dict) and ":serialized:" in value):
            data[key] = value
    settings, source = agent_settings(path)
    if source is not None:
        settings.write_into(model)
        data[KEY] = getattr(model, KEY)
    # The module of its class tells the algorithm's family.
    data["policy_class"] = {"__module__": type(policy).__module__}
    data["policy_kwargs"] = keywords
    data["observation_size"] = model.observation_space.shape[0]
    tensors = {name: tensor.contiguous() for name, tensor in policy.state_dict().items()}
    content = bytes(safetensors.save(tensors, {DATA: json.dumps(data)}))
    with tempfile.TemporaryDirectory(prefix="sb3_quad_") as folder:
        file = Path(folder, f"agent{ENDING}")
        file.write_bytes(content)
        loaded = load_model(file).policy.state_dict()
    if not all(th.equal(loaded[name], tensor) for name, tensor in tensors.items()):
        raise ExportError(f"{where}: the agent in the file has other weights; nothing was written")
    return content
