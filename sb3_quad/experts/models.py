"""Loading a saved SB3 model without being told which algorithm made it."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING

from sb3_quad.errors import ConfigError

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

# The module of the saved policy class tells the algorithm's family; DAgger and PPO+BC save stock actor-critic policies.
_FAMILIES = {
    "stable_baselines3.common.policies": "PPO",
    "stable_baselines3.sac.policies": "SAC",
    "stable_baselines3.td3.policies": "TD3",
    "stable_baselines3.dqn.policies": "DQN",
}


def load_model(path: str | Path, device: str = "cpu") -> BaseAlgorithm:
    """The model in an SB3 ``.zip``, of any algorithm of Stable-Baselines3 (and of this package), ready for ``predict``.

    :raises ConfigError: a missing file, one that is not a complete SB3 zip, or a policy of an unknown family.
    """
    import stable_baselines3

    file = Path(path)
    if not file.is_file():
        raise ConfigError(f"model {file}: no such file")
    try:
        with zipfile.ZipFile(file) as archive:
            policy = json.loads(archive.read("data"))["policy_class"]
        module = str(policy["__module__"])
    except (OSError, KeyError, TypeError, ValueError, zipfile.BadZipFile) as error:
        raise ConfigError(f"model {file}: not a complete SB3 zip ({type(error).__name__}: {error})") from None
    if module not in _FAMILIES:
        raise ConfigError(f"model {file}: its policy is of {module}, known are {', '.join(sorted(_FAMILIES))}")
    try:
        model: BaseAlgorithm = getattr(stable_baselines3, _FAMILIES[module]).load(file, device=device)
    except Exception as error:  # a zip whose parts do not fit raises whatever its unpickling raises
        raise ConfigError(f"model {file}: cannot be loaded ({type(error).__name__}: {error})") from None
    return model
