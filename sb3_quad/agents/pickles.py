"""A reader of the pickles in SB3's zips, which imports, calls and changes nothing.

Python's own reader calls any function that a pickle names (docs/security.md). Here a pickle is
first read as a description: what it names stays a :class:`Name`, what it makes stays a
:class:`Made`. Then :class:`_Builder` makes the few kinds of objects that SB3's agents need.

A few bytes can describe an object whose hash or copy takes forever. Therefore keys are plain, and
an object counts each time that it occurs.
"""

import functools
import io
import pickle
import pickletools
import pkgutil
import re
from collections import deque
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
import torch as th

from sb3_quad.base.process import trusted
from sb3_quad.base.types import StrDict

# The opcodes of SB3's and PyTorch's pickles.
_OPCODES = """
    PROTO FRAME STOP NONE NEWTRUE NEWFALSE BININT BININT1 BININT2 LONG1 BINFLOAT
    SHORT_BINUNICODE BINUNICODE SHORT_BINBYTES BINBYTES BYTEARRAY8 EMPTY_TUPLE EMPTY_LIST
    EMPTY_DICT TUPLE TUPLE1 TUPLE2 TUPLE3 MARK POP MEMOIZE BINPUT LONG_BINPUT BINGET
    LONG_BINGET GLOBAL STACK_GLOBAL BINPERSID REDUCE NEWOBJ BUILD APPEND APPENDS SETITEM
    SETITEMS
    """
# Random numbers, and the device that a policy was made on.
_UNNEEDED = """
    numpy.random._pickle.__bit_generator_ctor
    numpy.random._pickle.__generator_ctor
    numpy.random._pickle.__randomstate_ctor
    torch.device
    """
# The most opcodes, and the most objects of a result.
_MOST = 300_000
# Classes that an agent's keywords and settings may name.
_CLASSES = """
    numpy.float32
    numpy.float64
    stable_baselines3.common.buffers.DictReplayBuffer
    stable_baselines3.common.buffers.DictRolloutBuffer
    stable_baselines3.common.buffers.NStepReplayBuffer
    stable_baselines3.common.buffers.ReplayBuffer
    stable_baselines3.common.buffers.RolloutBuffer
    stable_baselines3.common.policies.ActorCriticCnnPolicy
    stable_baselines3.common.policies.ActorCriticPolicy
    stable_baselines3.common.policies.MultiInputActorCriticPolicy
    stable_baselines3.common.sb2_compat.rmsprop_tf_like.RMSpropTFLike
    stable_baselines3.common.torch_layers.CombinedExtractor
    stable_baselines3.common.torch_layers.FlattenExtractor
    stable_baselines3.common.torch_layers.NatureCNN
    stable_baselines3.sac.policies.CnnPolicy
    stable_baselines3.sac.policies.MultiInputPolicy
    stable_baselines3.sac.policies.SACPolicy
    stable_baselines3.td3.policies.CnnPolicy
    stable_baselines3.td3.policies.MultiInputPolicy
    stable_baselines3.td3.policies.TD3Policy
    torch.nn.modules.activation.CELU
    torch.nn.modules.activation.ELU
    torch.nn.modules.activation.GELU
    torch.nn.modules.activation.Hardswish
    torch.nn.modules.activation.Hardtanh
    torch.nn.modules.activation.LeakyReLU
    torch.nn.modules.activation.Mish
    torch.nn.modules.activation.ReLU
    torch.nn.modules.activation.ReLU6
    torch.nn.modules.activation.SELU
    torch.nn.modules.activation.SiLU
    torch.nn.modules.activation.Sigmoid
    torch.nn.modules.activation.Softplus
    torch.nn.modules.activation.Softsign
    torch.nn.modules.activation.Tanh
    torch.optim.adagrad.Adagrad
    torch.optim.adam.Adam
    torch.optim.adamax.Adamax
    torch.optim.adamw.AdamW
    torch.optim.nadam.NAdam
    torch.optim.radam.RAdam
    torch.optim.rmsprop.RMSprop
    torch.optim.sgd.SGD
    """
# Classes whose instances are made, and get the attributes that the pickle gives them.
_INSTANCES = """
    gymnasium.spaces.box.Box
    gymnasium.spaces.dict.Dict
    gymnasium.spaces.discrete.Discrete
    gymnasium.spaces.multi_binary.MultiBinary
    gymnasium.spaces.multi_discrete.MultiDiscrete
    stable_baselines3.common.noise.NormalActionNoise
    stable_baselines3.common.noise.OrnsteinUhlenbeckActionNoise
    stable_baselines3.common.noise.VectorizedActionNoise
    stable_baselines3.common.running_mean_std.RunningMeanStd
    stable_baselines3.common.utils.ConstantSchedule
    stable_baselines3.common.utils.FloatSchedule
    stable_baselines3.common.utils.LinearSchedule
    stable_baselines3.common.vec_env.vec_normalize.VecNormalize
    """
_STORAGES = {
    "torch.DoubleStorage": th.float64,
    "torch.FloatStorage": th.float32,
    "torch.HalfStorage": th.float16,
    "torch.LongStorage": th.int64,
}


class Name(str):
    """The full name of a class or function."""


class Made(list[Any]):
    """An object that a pickle makes: from what, with which arguments, state, fields and items."""

    state: Any = None

    def __init__(self, maker: Any, arguments: Any) -> None:
        self.maker = maker
        self.arguments = arguments
        self.fields: StrDict = {}

    def __setstate__(self, state: Any) -> None:
        self.state = state

    def __setitem__(self, key: Any, value: Any) -> None:
        # The hash of a deep tuple would crash Python.
        if type(key) not in (str, int):
            raise ValueError("holds a key that is neither a string nor an integer")
        self.fields[key] = value


class _Reader(pickle._Unpickler):
    """Python's reader, for which everything is a description."""

    stack: list[Any]

    def find_class(self, module: str, name: str) -> Any:
        # NumPy 2 moved its core, and Gymnasium's spaces were gym's.
        full_name = f"{module}.{name}".replace("numpy._core.", "numpy.core.")
        return Name(full_name.replace("gym.spaces.", "gymnasium.spaces."))

    def persistent_load(self, stored: Any) -> Any:
        return stored

    def _make(self) -> None:
        arguments = self.stack.pop()
        self.stack[-1] = Made(self.stack[-1], arguments)

    dispatch: ClassVar[dict[int, Any]] = {
        **pickle._Unpickler.dispatch,
        pickle.REDUCE[0]: _make,
        pickle.NEWOBJ[0]: _make,
        pickle.EMPTY_DICT[0]: lambda self: self.append(Made("dict", ())),
    }


def read_pickle(content: bytes, numbers: Callable[[str], bytes] = str.encode) -> Any:
    """Return the object in a pickle. :func:`.trusted` files may hold any.

    :param numbers: returns what a tensor's part of a file holds.
    :raises Exception: the pickle names something that is not in the tables of this file, or is too
        large or damaged. The message holds no object of the pickle.
    """
    if trusted():
        return pickle.loads(content)
    known = _OPCODES.split()
    for count, (opcode, _, _) in enumerate(pickletools.genops(content)):
        if opcode.name not in known or count == _MOST:
            raise ValueError(f"is not what Stable-Baselines3 pickles ({opcode.name})")
    return _Builder(numbers).build(_Reader(io.BytesIO(content)).load())


class _Builder:
    """Makes objects from their descriptions."""

    def __init__(self, numbers: Callable[[str], bytes]) -> None:
        # Several tensors may share their numbers.
        self._numbers = functools.cache(lambda part: bytearray(numbers(part)))
        self._left = _MOST

    def build(self, value: Any) -> Any:
        """Return what ``value`` describes."""
        self._left -= 1
        if self._left < 0:
            raise ValueError("holds too much; an object that is repeated counts each time")
        if isinstance(value, Made):
            return self._make(value, value.arguments)
        if isinstance(value, Name):
            return _known(value, _CLASSES)
        if isinstance(value, (list, tuple)):
            return type(value)(map(self.build, value))
        return value

    def _make(self, made: Made, arguments: Any) -> Any:
        match made.maker:
            case "dict" | "collections.OrderedDict":
                return {key: self.build(value) for key, value in made.fields.items()}
            case "collections.deque":
                return deque(map(self.build, made), arguments[-1])
            case "numpy.dtype":
                # Other kinds than numbers could read arbitrary memory.
                if not re.fullmatch(r"[biufc]\d{1,2}", arguments[0]) or made.state[1] == ">":
                    raise ValueError("holds an array of a kind that is unknown")
                return np.dtype(arguments[0])
            case "numpy.core.numeric._frombuffer":
                return self._array(*arguments)
            case "numpy.core.multiarray._reconstruct":
                _, shape, dtype, by_columns, content = made.state
                return self._array(content, dtype, shape, "F" if by_columns else "C")
            case "numpy.core.multiarray.scalar":
                return self._array(arguments[1], arguments[0], (), "C")[()]
            case "torch._utils._rebuild_tensor_v2":
                return self._tensor(*arguments)
            # SB3 makes a TrainFreq of a tuple. Python 3.11.0 to 3.11.3 pickle its unit by name.
            case "stable_baselines3.common.type_aliases.TrainFreq":
                return self.build(arguments)
            case "stable_baselines3.common.type_aliases.TrainFrequencyUnit":
                return self.build(arguments[0])
            case "builtins.getattr":
                return arguments[1].lower()
        if made.maker in _UNNEEDED.split():
            return None
        kind = _known(made.maker, _INSTANCES)
        instance = kind.__new__(kind)
        state = self.build(made.state)
        vars(instance).update(state)
        if hasattr(kind, "__setstate__"):
            kind.__setstate__(instance, state)
        return instance

    def _array(self, content: Any, dtype: Any, shape: Any, order: Any, axes: Any = None) -> Any:
        """Return an array, as ``numpy._core.numeric._frombuffer`` does."""
        array = np.frombuffer(content, self.build(dtype)).copy()
        if axes is None:
            return array.reshape(shape, order=order)
        return array.reshape(shape).transpose(axes)

    def _tensor(self, storage: Any, offset: Any, shape: Any, stride: Any, *_: Any) -> th.Tensor:
        """Return a tensor, as ``torch._utils._rebuild_tensor_v2`` does."""
        _, kind, part, *_ = storage
        # Others may have a hash that crashes Python.
        if not isinstance(kind, Name) or not isinstance(part, str):
            raise ValueError("holds a tensor of an unknown kind")
        stored = th.frombuffer(self._numbers(part), dtype=_STORAGES[kind])
        # PyTorch checks that it lies within what is stored.
        tensor = stored.as_strided(shape, stride, offset)
        if tensor.numel() > stored.numel():
            raise ValueError("repeats the numbers of a tensor")
        return tensor


def _known(name: Any, names: str) -> Any:
    # The text of another object might never end.
    if not isinstance(name, Name):
        raise ValueError("calls something without a name")
    if name not in names.split():
        raise ValueError(f"names {str(name)[:200]!r}, which may run anything")
    return pkgutil.resolve_name(name)
