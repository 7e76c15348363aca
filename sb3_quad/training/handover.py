"""Starting from a trained agent: its policy and critic, in a new algorithm with a fresh optimiser."""

from pathlib import Path

import torch as th
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.save_util import load_from_zip_file

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import one_line
from sb3_quad.base.memory import check_unpacked


def transfer_policy(path: str | Path, model: OnPolicyAlgorithm) -> None:
    """Give ``model`` the policy and critic of an SB3 zip, of any on-policy algorithm with the same spaces and networks.

    ``log_std`` comes from the zip, unless the model's settings give a ``log_std_init``: then that holds. The optimiser
    stays as it is, so a new model starts with a fresh one.

    :raises ConfigError: a zip that is missing, not complete or not finite, or whose layers differ; the message names the
        first that does.
    """
    try:
        check_unpacked(path)
        _, parameters, _ = load_from_zip_file(path, load_data=False, device="cpu")  # unpickles nothing
        theirs, ours = dict(parameters["policy"]), model.policy.state_dict()
    except ConfigError:
        raise
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file") from None
    except Exception as error:  # what a damaged archive raises depends on where the damage is
        raise ConfigError(f"{path}: not a complete SB3 zip ({one_line(error)})") from None
    if not all(th.isfinite(tensor).all() for tensor in theirs.values()):
        raise ConfigError(f"{path}: holds parameters that are not finite")
    for layer in sorted({**ours, **theirs}, key=lambda name: name == "log_std"):  # the network's own layers say more
        if layer not in ours or layer not in theirs:
            only = "the zip" if layer in theirs else f"this {type(model).__name__}"
            raise ConfigError(f"{path}: layer {layer} is in {only} only (policy_kwargs differ)")
        there, here = tuple(theirs[layer].shape), tuple(ours[layer].shape)
        if there != here:
            advice = "environment spaces and policy_kwargs must be the same"
            raise ConfigError(f"{path}: layer {layer} has shape {there}, here it is {here}; {advice}")
    if "log_std_init" in model.policy_kwargs and "log_std" in ours:
        theirs["log_std"] = ours["log_std"]
    model.policy.load_state_dict(theirs)


hand_over = transfer_policy  # its name in version 0.1
