"""Loading a saved SB3 model without being told which algorithm made it."""

import io
import json
import warnings
import zipfile
from pathlib import Path
from typing import Any, TypeVar

import stable_baselines3
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.save_util import load_from_zip_file

from sb3_quad.base.errors import ConfigError, SB3QuadError
from sb3_quad.base.files import one_line
from sb3_quad.base.imports import require
from sb3_quad.base.process import trusted
from sb3_quad.controllers.unpickle import unpickle

Algorithm = TypeVar("Algorithm", bound=BaseAlgorithm)

# The module of the saved policy class tells the algorithm's family.
_FAMILIES = {
    "stable_baselines3.common.policies": "PPO",
    "sb3_contrib.common.recurrent.policies": "RecurrentPPO",
    "stable_baselines3.sac.policies": "SAC",
    "stable_baselines3.td3.policies": "TD3",
    "stable_baselines3.dqn.policies": "DQN",
}
# By family, settings that only these save; their zips are the stock algorithm's otherwise
_OURS = {
    "PPO": {"bc_coef": "PPOBC", "beta": "DAgger"},
    "SAC": {"bc_coef": "SACBC"},
}
_STOCK = {
    name: family for family, names in _OURS.items() for name in names.values()
}  # what reads the zips of ours
_TO_FLY = (
    "action_space",
    "observation_space",
    "policy_class",
    "policy_kwargs",
)  # what is read of the pickles of an agent
_STAND_INS = {
    "clip_range": 0.0,
    "learning_rate": 0.0,
    "train_freq": 1,
}  # for those others that cannot be None
_NEVER_READ = (
    "env",
    "expert",
    "_labeller",
)  # whose names would be imported; SB3 and this package save none
_VARIABLES = {
    "ent_coef_tensor",
    "log_ent_coef",
}  # what SB3 saves beside policies and optimisers; it may write elsewhere


def saved_data(path: str | Path | io.BytesIO, where: str = "") -> dict[str, Any]:
    """The attributes of the model in an SB3 ``.zip`` as its JSON has them; those that are pickled
    there stay so.

    :param where: what messages call the file; its path unless given.
    :raises ConfigError: a missing file, or one that is not a complete SB3 zip.
    """
    file, where = path if isinstance(path, io.BytesIO) else Path(path), where or f"model {path}"
    if isinstance(file, Path) and not file.is_file():
        raise ConfigError(
            f"{where}: "
            + ("no run with an agent in this folder" if file.is_dir() else "no such file")
        )
    try:
        with zipfile.ZipFile(file) as archive:
            return dict(json.loads(archive.read("data")))
    except Exception as error:  # what a damaged archive raises depends on where the damage is
        raise ConfigError(
            f"{where}: not a complete SB3 zip ({type(error).__name__}: {error})"
        ) from None


def saved_algorithm(path: str | Path) -> str:
    """What made an SB3 ``.zip``: PPO, A2C, SAC, TD3, DDPG, DQN, RecurrentPPO; PPOBC, SACBC, DAgger
    of ours.

    A zip does not name its algorithm; the policy class and the settings that were saved with it
    tell.

    :raises ConfigError: a missing file, one that is not a complete SB3 zip, or a policy of an
        unknown family.
    """
    data = saved_data(path)
    try:
        module = str(data["policy_class"]["__module__"])
    except (KeyError, TypeError) as error:
        raise ConfigError(
            f"model {path}: not a complete SB3 zip ({type(error).__name__}: {error})"
        ) from None
    if module not in _FAMILIES:
        raise ConfigError(
            f"model {path}: its policy is of {module}, known are {', '.join(sorted(_FAMILIES))}"
        )
    family = _FAMILIES[module]
    for key, name in _OURS.get(family, {}).items():
        if key in data:
            return name
    if family == "PPO" and "n_epochs" not in data:
        return "A2C"
    return "DDPG" if family == "TD3" and data.get("policy_delay") == 1 else family


def load_zip(
    algorithm: type[Algorithm],
    path: str | Path | io.BytesIO,
    to_fly: bool = False,
    where: str = "",
    **kwargs: Any,
) -> Algorithm:
    """``algorithm.load(path, **kwargs)``, in which no code of the file's own runs, unless
    :func:`trusted`.

    PyTorch reads the weights with ``weights_only``; what is pickled beside them is read by
    :func:`unpickle`.

    :param to_fly: only for ``predict``: schedules, noise and the like, which may be functions, are
        not read at all.
    :param where: what messages call the file; its path unless given.
    :raises ConfigError: a missing or damaged file, or one that may run code of its own.
    """
    where = where or f"model {path}"
    objects: dict[str, Any] = {}
    data = {} if trusted() else saved_data(path, where)
    for key, entry in data.items():
        if key in _NEVER_READ:
            objects[key] = None
        elif isinstance(entry, dict) and ":serialized:" in entry:
            unread = to_fly and key not in _TO_FLY
            objects[key] = (
                _STAND_INS.get(key)
                if unread
                else unpickle(entry[":serialized:"], f"{where}: its {key}")
            )
    try:
        variables = load_from_zip_file(path, load_data=False, device="cpu")[2] if data else None
        if not _VARIABLES.issuperset(variables or ()):
            raise ConfigError(
                f"{where}: holds variables that no algorithm has; known are {', '.join(sorted(_VARIABLES))}"
            )
        with (
            warnings.catch_warnings()
        ):  # SB3 takes the buffer of n-step returns, its own choice, for the user's
            warnings.filterwarnings("ignore", "`n_steps=")
            return algorithm.load(path, custom_objects=objects, **kwargs)
    except SB3QuadError:
        raise
    except Exception as error:  # a zip whose parts do not fit raises whatever its parts raise
        raise ConfigError(
            f"{where}: cannot be loaded ({type(error).__name__}: {one_line(error)})"
        ) from error


def load_model(path: str | Path, device: str = "cpu") -> BaseAlgorithm:
    """The model in an SB3 ``.zip``, of any algorithm of Stable-Baselines3 (and of this package),
    ready for ``predict``.

    :raises ConfigError: a missing file, one that is not a complete SB3 zip, a policy of an unknown
        family, or with parameters that are not finite; a file that may run code of its own.
        :class:`MissingExtra`: a recurrent one, and no sb3-contrib.
    """
    algorithm = saved_algorithm(path)
    name = _STOCK.get(algorithm, algorithm)
    library = (
        require("sb3_contrib", "", f"model {path}") if name == "RecurrentPPO" else stable_baselines3
    )
    stock: type[BaseAlgorithm] = getattr(library, name)
    model: BaseAlgorithm = load_zip(stock, path, to_fly=True, device=device)
    broken = [
        name for name, tensor in model.policy.state_dict().items() if not th.isfinite(tensor).all()
    ]
    if broken:
        raise ConfigError(f"model {path}: {broken[0]} is not finite; no policy flies by that")
    return model
