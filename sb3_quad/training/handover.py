"""Starting from a trained agent: its policy and critic, in a new algorithm with a fresh optimiser."""

from __future__ import annotations

from pathlib import Path

import torch as th
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.save_util import load_from_zip_file

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import one_line


def transfer_policy(path: str | Path, model: OnPolicyAlgorithm) -> None:
    """Give ``model`` the policy and critic of an SB3 zip, of any on-policy algorithm with the same spaces and networks.

    ``log_std`` comes from the zip, unless the model's settings give a ``log_std_init``: then that holds. The optimiser
    stays as it is, so a new model starts with a fresh one.

    :raises ConfigError: a zip that cannot be read, or whose layers differ; the message names the first that does.
    """
    theirs, ours = read_policy(path), model.policy.state_dict()
    for layer in sorted({**ours, **theirs}, key=lambda name: name == "log_std"):  # the network's own layers say more
        if layer not in ours or layer not in theirs:
            only = "the zip" if layer in theirs else f"this {type(model).__name__}"
            raise ConfigError(f"{path}: layer {layer} is in {only} only (policy_kwargs differ)")
        there, here = tuple(theirs[layer].shape), tuple(ours[layer].shape)
        if there != here:
            advice = "environment spaces and policy_kwargs must be the same"
            raise ConfigError(f"{path}: layer {layer} has shape {there}, here it is {here}; {advice}")
    if "log_std_init" in model.policy_kwargs and "log_std" in ours:
        theirs = {**theirs, "log_std": ours["log_std"]}
    model.policy.load_state_dict(theirs)


def read_policy(path: str | Path) -> dict[str, th.Tensor]:
    """The parameters of the policy in an SB3 zip; nothing in it is unpickled.

    :raises ConfigError: a file that is missing or not a complete SB3 zip.
    """
    file = Path(path)
    if not file.is_file():
        raise ConfigError(f"{file}: no such file")
    try:
        _, parameters, _ = load_from_zip_file(file, load_data=False, device="cpu")
        policy = parameters["policy"]
    except Exception as error:  # what a damaged archive raises depends on where the damage is
        raise ConfigError(f"{file}: not a complete SB3 zip ({one_line(error)})") from None
    if not all(th.isfinite(tensor).all() for tensor in policy.values()):
        raise ConfigError(f"{file}: holds parameters that are not finite")
    return dict(policy)


hand_over = transfer_policy  # its name in version 0.1
