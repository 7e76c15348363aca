"""Loading a saved SB3 model without being told which algorithm made it."""

import json
import zipfile
from pathlib import Path
from typing import Any

import stable_baselines3
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.memory import check_unpacked

# The module of the saved policy class tells the algorithm's family.
_ACTOR_CRITIC = "stable_baselines3.common.policies"
_FAMILIES = {
    _ACTOR_CRITIC: "PPO",
    "stable_baselines3.sac.policies": "SAC",
    "stable_baselines3.td3.policies": "TD3",
    "stable_baselines3.dqn.policies": "DQN",
}
_OURS = {"bc_coef": "PPOBC", "beta": "DAgger"}  # settings that only these save; their zips are stock PPO's otherwise


def saved_data(path: str | Path) -> dict[str, Any]:
    """The attributes of the model in an SB3 ``.zip`` as its JSON has them; those that are pickled there stay so.

    :raises ConfigError: a missing file, one that is not a complete SB3 zip, or a zip bomb.
    """
    file = Path(path)
    if not file.is_file():
        raise ConfigError(f"model {file}: " + ("no run with an agent in this folder" if file.is_dir() else "no such file"))
    try:
        check_unpacked(file)
        with zipfile.ZipFile(file) as archive:
            return dict(json.loads(archive.read("data")))
    except ConfigError:
        raise
    except Exception as error:  # what a damaged archive raises depends on where the damage is
        raise ConfigError(f"model {file}: not a complete SB3 zip ({type(error).__name__}: {error})") from None


def saved_algorithm(path: str | Path) -> str:
    """What made an SB3 ``.zip``: PPO, A2C, SAC, TD3, DDPG or DQN, or PPOBC or DAgger of this package.

    A zip does not name its algorithm; the policy class and the settings that were saved with it tell.

    :raises ConfigError: a missing file, one that is not a complete SB3 zip, or a policy of an unknown family.
    """
    data = saved_data(path)
    try:
        module = str(data["policy_class"]["__module__"])
    except (KeyError, TypeError) as error:
        raise ConfigError(f"model {path}: not a complete SB3 zip ({type(error).__name__}: {error})") from None
    if module not in _FAMILIES:
        raise ConfigError(f"model {path}: its policy is of {module}, known are {', '.join(sorted(_FAMILIES))}")
    if module == _ACTOR_CRITIC:
        own = next((name for key, name in _OURS.items() if key in data), None)
        return own or ("PPO" if "n_epochs" in data else "A2C")
    return "DDPG" if _FAMILIES[module] == "TD3" and data.get("policy_delay") == 1 else _FAMILIES[module]


def load_model(path: str | Path, device: str = "cpu") -> BaseAlgorithm:
    """The model in an SB3 ``.zip``, of any algorithm of Stable-Baselines3 (and of this package), ready for ``predict``.

    :raises ConfigError: a missing file, one that is not a complete SB3 zip, a policy of an unknown family, or with parameters
        that are not finite.
    """
    file = Path(path)
    algorithm = saved_algorithm(file)
    stock = "PPO" if algorithm in _OURS.values() else algorithm
    try:
        model: BaseAlgorithm = getattr(stable_baselines3, stock).load(file, device=device)
    except Exception as error:  # a zip whose parts do not fit raises whatever its unpickling raises
        raise ConfigError(f"model {file}: cannot be loaded ({type(error).__name__}: {error})") from None
    broken = [name for name, tensor in model.policy.state_dict().items() if not th.isfinite(tensor).all()]
    if broken:
        raise ConfigError(f"model {file}: {broken[0]} is not finite; no policy flies by that")
    return model
