"""A strict reader of the pickles in SB3's zips.

Python's own reader calls any function that a pickle names (docs/security.md). This one is derived
from it, but knows only the opcodes that SB3's pickles use. It looks names up only in the tables of
this file. It calls only functions of this file, which check their arguments, and changes only
objects that the same pickle has made, so nothing outside the result changes.

Small pickles can contain objects whose hash, copy or text crashes Python or never ends: very deep
ones, and those that contain others many times, or themselves. Therefore keys are plain, and what is
used or returned is a tree of limited size.
"""

import base64
import io
import math
import pickle
import pkgutil
import re
from collections import OrderedDict, deque
from collections.abc import Callable, Collection
from typing import Any, ClassVar

import numpy as np
from gymnasium.spaces import Box
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.process import TRUST_VARIABLE, trusted
from sb3_quad.base.trees import walk
from sb3_quad.base.types import StrDict

WAY_OUT = f"if you trust whoever made it, add --trust (in Python: {TRUST_VARIABLE}=1)"
_UNLIKE_SB3 = "is not what Stable-Baselines3 pickles"
# Steps of reading a pickle; action noise for 10,000 environments needs as many.
_STEPS = 1_500_000


def unpickle(content: str | bytes, where: str) -> Any:
    """Return the object in an entry of an SB3 zip. :func:`trusted` files may contain any.

    Tensors become None.

    :param content: a pickle, or its text in base64, as SB3 writes it.
    :param where: the name of the entry in messages.
    :raises ConfigError: the pickle names or does something that SB3's own pickles do not. None of
        it has been imported or called.
    """
    try:
        if isinstance(content, str):
            content = base64.b64decode(content)
        if trusted():
            return pickle.loads(content)
        steps = _Steps(content)
        # SB3's pickles need up to two steps for each byte.
        steps.left = min(_STEPS, 10_000 + 5 * len(content))
        reader = _Reader(steps)
        reader.steps = steps
        value = reader.load()
        reader.walk(value)
        return value
    except _Refusal as error:
        fault = str(error)
    except Exception as error:  # wrong types may raise anything
        # Do not show its message, which may contain an object of the pickle, and showing that calls
        # it.
        fault = f"{_UNLIKE_SB3} ({type(error).__name__})"
    raise ConfigError(f"{where} {fault}; {WAY_OUT}")


class _Refusal(Exception):
    """A pickle does something that no pickle of SB3 does."""


def _check(fits: bool, what: str) -> None:
    if not fits:
        raise _Refusal(f"{_UNLIKE_SB3} ({what})")


def _is_one_of(value: Any, names: StrDict) -> bool:
    """Compare by identity: equality could be an object's own method."""
    return any(value is candidate for candidate in names.values())


def held(item: Any) -> Collection[Any]:
    """Return what an object of a pickle contains. Keys are plain."""
    if _is_one_of(type(item), _WITH_ATTRIBUTES):
        item = vars(item)
    if isinstance(item, dict):
        return item.values()
    return item if isinstance(item, (list, tuple, deque)) else ()


# Functions that replace those that SB3's pickles call.


def _array(buffer: Any, dtype: Any, shape: Any, order: Any, axes: Any = None) -> Any:
    """Do what ``numpy._core.numeric._frombuffer`` does."""
    _check(type(buffer) in (bytes, bytearray) and isinstance(dtype, np.dtype), "an array")
    array = np.frombuffer(buffer, dtype)
    if axes is None:
        return array.reshape(shape, order=order)
    return array.reshape(shape).transpose(axes)


def _dtype(code: Any, *_: Any) -> Any:
    """Make a dtype of numbers; an array of objects made from bytes would read arbitrary memory."""
    _check(type(code) is str and re.fullmatch(r"[biufc]\d{1,2}", code) is not None, "a dtype")
    return np.dtype(code)


def _check_tensor(stored: Any, offset: Any, shape: Any, *_: Any) -> None:
    """Refuse a tensor with more numbers than the file stores for it, which would repeat them."""
    _check({*map(type, (stored, offset, *shape))} == {int}, "a tensor")
    _check(offset + math.prod(shape) <= stored, "a tensor")


# Pickles look up a member of this enumeration by its value. The enumeration itself would show a
# wrong value in its message.
_unit = TrainFrequencyUnit._value2member_map_.__getitem__


def _unit_by_name(enumeration: Any, name: Any) -> TrainFrequencyUnit:
    """Return a unit by its name, as Python 3.11.0 to 3.11.3 pickle it, and nothing else."""
    _check(enumeration is _unit and type(name) is str, "an enumeration")
    return TrainFrequencyUnit[name]


def _none(*_: Any) -> None:
    """Replace what is not needed."""


# Tables: what a pickle may name.


def _by_name(names: str) -> StrDict:
    return {name: pkgutil.resolve_name(name) for name in names.split()}


# Instances of these classes are made, and get attributes.
_WITH_ATTRIBUTES = _by_name(
    """
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
)
# The others are only named, except for TrainFreq, a named tuple.
_CLASSES = _WITH_ATTRIBUTES | _by_name(
    """
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
    stable_baselines3.common.type_aliases.TrainFreq
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
)
# The function that is called for a name. The items and the state of its result follow in the
# pickle.
_FUNCTIONS = {
    "numpy.dtype": _dtype,
    # Random numbers: a space without a generator makes its own, which SB3 seeds.
    "numpy.random._pickle.__bit_generator_ctor": _none,
    "numpy.random._pickle.__generator_ctor": _none,
    "numpy.random._pickle.__randomstate_ctor": _none,
    "numpy.random.bit_generator.__pyx_unpickle_SeedSequence": _none,
    # SB3 removes the device that a policy was made on.
    "torch.device": _none,
    "torch._utils._rebuild_tensor_v2": _check_tensor,
    "numpy.core.numeric._frombuffer": _array,
    "numpy.core.multiarray._reconstruct": lambda *_: np.empty(0, np.int8),
    "numpy.core.multiarray.scalar": lambda dtype, content: _array(content, dtype, (), "C")[()],
    "collections.OrderedDict": lambda: OrderedDict(),
    "collections.deque": lambda _, length=None: deque(maxlen=length),
    "stable_baselines3.common.type_aliases.TrainFrequencyUnit": _unit,
    "builtins.getattr": _unit_by_name,
}
# Arguments of these functions, which need no other information.
_ARGUMENTS = {
    "numpy.ndarray": "an array",
    "numpy.random._pcg64.PCG64": "a bit generator",
    "numpy.random.bit_generator.SeedSequence": "seeds",
    "torch.DoubleStorage": "numbers",
    "torch.FloatStorage": "numbers",
    "torch.HalfStorage": "numbers",
    "torch.LongStorage": "numbers",
}
_KNOWN = _CLASSES | _FUNCTIONS | _ARGUMENTS
# Opcodes that only put plain values on the stack, or move values, including from and to the memo,
# by which a pickle refers to an object again; and those that ask _Reader.find_class or
# _Reader.persistent_load.
_HARMLESS = """
    PROTO STOP NONE NEWTRUE NEWFALSE BININT BININT1 BININT2 LONG1 BINFLOAT
    SHORT_BINUNICODE BINUNICODE SHORT_BINBYTES BINBYTES
    EMPTY_TUPLE EMPTY_LIST EMPTY_DICT TUPLE TUPLE1 TUPLE2 TUPLE3 MARK
    MEMOIZE BINPUT LONG_BINPUT BINGET LONG_BINGET
    GLOBAL STACK_GLOBAL BINPERSID
    """


class _Steps(io.BytesIO):
    """The content of a pickle, which is read in a limited number of steps."""

    left: int

    def read(self, size: int | None = -1) -> bytes:
        self.left -= 1
        _check(self.left > 0, "its size")
        return super().read(size)


class _Reader(pickle._Unpickler):
    """Python's reader for few opcodes, which checks what they name, call and change."""

    steps: _Steps
    # Attributes of Python's reader, which have no public types.
    stack: list[Any]
    read: Callable[[int], bytes]
    pop_mark: Callable[[], list[Any]]

    def walk(self, value: Any) -> None:
        """Walk over an object before anything else does."""
        self.steps.left = walk(value, held, self.steps.left)

    def persistent_load(self, stored: Any) -> Any:
        """Return how many numbers a storage of PyTorch has."""
        return stored[-1]

    def find_class(self, module: str, name: str) -> Any:
        # NumPy 2 moved its core, and Gymnasium's spaces were gym's.
        full_name = f"{module}.{name}".replace("numpy._core.", "numpy.core.")
        full_name = full_name.replace("gym.spaces.", "gymnasium.spaces.")
        if full_name not in _KNOWN:
            shown = full_name.encode("unicode_escape").decode()[:200]
            raise _Refusal(f"names {shown}, which may run anything")
        return _KNOWN[full_name]

    def call(self) -> None:
        arguments = self.stack.pop()
        function = self.stack.pop()
        _check(_is_one_of(function, _FUNCTIONS) and type(arguments) is tuple, "a call")
        self.walk(arguments)
        self.stack.append(function(*arguments))

    def make(self) -> None:
        arguments = self.stack.pop()
        kind = self.stack.pop()
        _check(type(arguments) is tuple, "an instance")
        if kind is not TrainFreq:
            _check(_is_one_of(kind, _WITH_ATTRIBUTES) and not arguments, "an instance")
        self.stack.append(kind.__new__(kind, *arguments))

    def change(self) -> None:
        state = self.stack.pop()
        instance = self.stack[-1]
        kind = type(instance)
        self.walk(state)
        if isinstance(instance, np.dtype):
            # A plain dtype in this machine's byte order needs no change.
            _check(state[1:5] == (instance.str[0], None, None, None), "a dtype")
        elif kind is np.ndarray:
            _, shape, dtype, by_columns, content = state
            # The content is copied.
            self.steps.left -= len(content) // 128
            # NumPy does not check the state of an array, so use one that an array has returned.
            values = _array(content, dtype, shape, "F" if by_columns is True else "C")
            _, _, checked_state = values.__reduce__()
            instance.__setstate__(checked_state)
        # None stands for random numbers; PyTorch attaches versions to its OrderedDict.
        elif instance is not None and kind is not OrderedDict:
            _check(_is_one_of(kind, _WITH_ATTRIBUTES) and type(state) is dict, "a state")
            are_plain = all(type(name) is str and not name.startswith("__") for name in state)
            _check(are_plain, "attributes")
            vars(instance).update(state)
            # It may contain itself now.
            self.walk(instance)
            if hasattr(kind, "__setstate__"):
                kind.__setstate__(instance, state)
            if kind is Box:
                _check(instance.low.shape == instance.high.shape == instance._shape, "a Box")

    def read_array(self) -> None:
        # Python's own method allocates whatever size the pickle names.
        self.stack.append(bytearray(self.read(int.from_bytes(self.read(8), "little"))))

    def extend(self, new: list[Any]) -> None:
        items = self.stack[-1]
        _check(type(items) in (list, deque), "a container")
        items.extend(new)

    def set_item(self) -> None:
        value = self.stack.pop()
        self.update([self.stack.pop(), value])

    def update(self, new: list[Any]) -> None:
        items = self.stack[-1]
        keys = new[::2]
        _check(type(items) in (dict, OrderedDict), "a container")
        _check({*map(type, keys)} <= {str, int}, "a key")
        items.update(zip(keys, new[1::2], strict=True))

    dispatch: ClassVar[dict[int, Any]] = {
        # A frame says how much to read at once.
        pickle.FRAME[0]: lambda self: self.read(8),
        pickle.BYTEARRAY8[0]: read_array,
        # Python's own method would also pop a mark, which no pickler writes.
        pickle.POP[0]: lambda self: self.stack.pop(),
        pickle.REDUCE[0]: call,
        pickle.NEWOBJ[0]: make,
        pickle.BUILD[0]: change,
        pickle.APPEND[0]: lambda self: self.extend([self.stack.pop()]),
        pickle.APPENDS[0]: lambda self: self.extend(self.pop_mark()),
        pickle.SETITEM[0]: set_item,
        pickle.SETITEMS[0]: lambda self: self.update(self.pop_mark()),
    }


for _name in _HARMLESS.split():
    _opcode = getattr(pickle, _name)[0]
    _Reader.dispatch[_opcode] = pickle._Unpickler.dispatch[_opcode]
