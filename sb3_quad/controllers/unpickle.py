"""Unpickling what SB3's zips hold, and nothing else: a pickle may call any function by its name (docs/security.md)."""

import base64
import io
import pickle
from typing import Any

import gymnasium
import numpy as np
import torch as th
from stable_baselines3.common.buffers import BaseBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.trust import VARIABLE

_ARRAYS = {"multiarray": ("_reconstruct", "scalar"), "numeric": ("_frombuffer",)}
_NAMES = {
    "builtins": ("bool", "bytearray", "complex", "float", "frozenset", "int", "set", "slice"),
    "collections": ("OrderedDict", "deque"),
    "numpy": ("dtype", "ndarray"),
    **{f"numpy.{core}.{module}": names for core in ("core", "_core") for module, names in _ARRAYS.items()},
    "numpy.random._pcg64": ("PCG64",),
    "numpy.random._pickle": ("__bit_generator_ctor", "__generator_ctor"),
    "numpy.random.bit_generator": ("SeedSequence", "__pyx_unpickle_SeedSequence"),
    "stable_baselines3.common.type_aliases": ("TrainFreq", "TrainFrequencyUnit"),
    "stable_baselines3.common.utils": ("ConstantSchedule", "FloatSchedule", "LinearSchedule"),
    "stable_baselines3.her.goal_selection_strategy": ("GoalSelectionStrategy",),
}
_SB3 = (BasePolicy, BaseFeaturesExtractor, BaseBuffer, ActionNoise, th.optim.Optimizer)
_CLASSES: dict[str, tuple[type, ...]] = {  # by the beginning of a module's name, what its classes must be subclasses of
    "gymnasium.spaces.": (gymnasium.Space,),
    "numpy.": (np.generic,),
    "sb3_contrib.": _SB3,
    "stable_baselines3.": _SB3,
    "torch.nn.modules.": (th.nn.Module,),
    "torch.optim.": (th.optim.Optimizer,),
}


def unpickle(text: str, where: str) -> Any:
    """What an entry of an SB3 zip holds.

    :param text: base64 of a pickle, as SB3 writes it.
    :param where: what messages call the entry.
    :raises ConfigError: it names something that SB3's own zips do not hold; nothing of that has been imported or called.
    """
    return _Unpickler(where, base64.b64decode(text)).load()


class _Unpickler(pickle.Unpickler):
    """Python's own way to restrict what pickles may name; it is asked for every name before it is used."""

    def __init__(self, where: str, content: bytes) -> None:
        super().__init__(io.BytesIO(content), fix_imports=False)
        self._where = where

    def find_class(self, module: str, name: str) -> Any:
        if name in _NAMES.get(module, ()):
            return super().find_class(module, name)
        bases = next((bases for start, bases in _CLASSES.items() if f"{module}.".startswith(start)), ())
        if bases and "." not in name:
            found = super().find_class(module, name)
            if isinstance(found, type) and issubclass(found, bases):
                return found
        way_out = f"if you trust whoever made it, add --trust (in Python: {VARIABLE}=1)"
        raise ConfigError(f"{self._where} names {module}.{name}, which may run anything; {way_out}")
