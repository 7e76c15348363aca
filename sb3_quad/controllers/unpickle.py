"""A strict reader of the pickles in SB3's zips.

Python's own reader calls any function that a pickle names (docs/security.md). This one is made of
it, but knows only the opcodes that SB3's pickles use. It looks names up in the tables of this file
alone. It calls only functions of this file, which check their arguments, and changes only objects
that the same pickle has made. So nothing outside the result changes.
"""

import base64
import io
import pickle
import pkgutil
import re
from collections import OrderedDict, deque
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
from numpy.random import PCG64, Generator, SeedSequence
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.process import TRUST_VARIABLE, trusted
from sb3_quad.base.types import StrDict

WAY_OUT = f"if you trust whoever made it, add --trust (in Python: {TRUST_VARIABLE}=1)"
_UNLIKE_SB3 = "is not what Stable-Baselines3 pickles"


def unpickle(text: str, where: str) -> Any:
    """Return the object that an entry of an SB3 zip holds. :func:`trusted` files may hold any.

    :param text: base64 of a pickle, as SB3 writes it.
    :param where: what messages call the entry.
    :raises ConfigError: the pickle names or does something that SB3's own pickles do not. Nothing
        of that has been imported or called.
    """
    read = pickle.Unpickler if trusted() else _Reader
    try:
        return read(io.BytesIO(base64.b64decode(text))).load()
    except _Refusal as error:
        fault = str(error)
    except Exception as error:  # what wrong types raise depends on the types
        # Its message may show an object of the pickle, and to show it is to call it.
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


# Functions that stand for those that SB3's pickles call, and for the methods that set a state.


def _array(buffer: Any, dtype: Any, shape: Any, order: Any, axes: Any = None) -> Any:
    """Do what ``numpy._core.numeric._frombuffer`` does."""
    _check(type(buffer) in (bytes, bytearray) and isinstance(dtype, np.dtype), "an array")
    array = np.frombuffer(buffer, dtype)
    if axes is None:
        return array.reshape(shape, order=order)
    return array.reshape(shape).transpose(axes)


def _fill_array(array: Any, state: Any) -> None:
    """Do what ``ndarray.__setstate__`` does, which itself trusts the state."""
    _, shape, dtype, by_columns, content = state
    values = _array(content, dtype, shape, "F" if by_columns is True else "C")
    _, _, checked_state = values.__reduce__()
    array.__setstate__(checked_state)


def _dtype(code: Any, *_: Any) -> Any:
    """Make a dtype of numbers; an array of objects made of bytes would read memory as it likes."""
    _check(type(code) is str and re.fullmatch(r"[biufc]\d{1,2}", code) is not None, "a dtype")
    return np.dtype(code)


def _check_dtype(dtype: Any, state: Any) -> None:
    """Accept the state of a plain dtype in this machine's byte order, which it has already."""
    _check(state[1:5] == (dtype.str[0], None, None, None), "a dtype")


def _set_bit_generator(bit_generator: Any, state: Any) -> None:
    # NumPy 2 adds the seeds. Only further generators would need them, and a space spawns none.
    if type(state) is tuple:
        state, _ = state
    bit_generator.state = state


def _generator(bit_generator: Any, *_: Any) -> Generator:
    """Do what ``numpy.random._pickle.__generator_ctor`` does.

    NumPy 1 passes the name of the bit generator, whose state follows.
    """
    return Generator(bit_generator if type(bit_generator) is PCG64 else PCG64(0))


def _set_generator(generator: Any, state: Any) -> None:
    generator.bit_generator.state = state


# Tables: what a pickle may name.


def _by_name(*names: str) -> StrDict:
    return {name: pkgutil.resolve_name(name) for name in names}


# Instances of these classes are made, and get attributes.
_WITH_ATTRIBUTES = _by_name(
    "gymnasium.spaces.box.Box",
    "gymnasium.spaces.dict.Dict",
    "gymnasium.spaces.discrete.Discrete",
    "gymnasium.spaces.multi_binary.MultiBinary",
    "gymnasium.spaces.multi_discrete.MultiDiscrete",
    "stable_baselines3.common.noise.NormalActionNoise",
    "stable_baselines3.common.noise.OrnsteinUhlenbeckActionNoise",
    "stable_baselines3.common.noise.VectorizedActionNoise",
    "stable_baselines3.common.running_mean_std.RunningMeanStd",
    "stable_baselines3.common.utils.ConstantSchedule",
    "stable_baselines3.common.utils.FloatSchedule",
    "stable_baselines3.common.utils.LinearSchedule",
    "stable_baselines3.common.vec_env.vec_normalize.VecNormalize",
)
# The others of these are only named, but for TrainFreq, a named tuple.
_CLASSES = _WITH_ATTRIBUTES | _by_name(
    "numpy.float32",
    "numpy.float64",
    "stable_baselines3.common.buffers.DictReplayBuffer",
    "stable_baselines3.common.buffers.DictRolloutBuffer",
    "stable_baselines3.common.buffers.NStepReplayBuffer",
    "stable_baselines3.common.buffers.ReplayBuffer",
    "stable_baselines3.common.buffers.RolloutBuffer",
    "stable_baselines3.common.policies.ActorCriticCnnPolicy",
    "stable_baselines3.common.policies.ActorCriticPolicy",
    "stable_baselines3.common.policies.MultiInputActorCriticPolicy",
    "stable_baselines3.common.sb2_compat.rmsprop_tf_like.RMSpropTFLike",
    "stable_baselines3.common.torch_layers.CombinedExtractor",
    "stable_baselines3.common.torch_layers.FlattenExtractor",
    "stable_baselines3.common.torch_layers.NatureCNN",
    "stable_baselines3.common.type_aliases.TrainFreq",
    "stable_baselines3.sac.policies.CnnPolicy",
    "stable_baselines3.sac.policies.MultiInputPolicy",
    "stable_baselines3.sac.policies.SACPolicy",
    "stable_baselines3.td3.policies.CnnPolicy",
    "stable_baselines3.td3.policies.MultiInputPolicy",
    "stable_baselines3.td3.policies.TD3Policy",
    "torch.nn.modules.activation.CELU",
    "torch.nn.modules.activation.ELU",
    "torch.nn.modules.activation.GELU",
    "torch.nn.modules.activation.Hardswish",
    "torch.nn.modules.activation.Hardtanh",
    "torch.nn.modules.activation.LeakyReLU",
    "torch.nn.modules.activation.Mish",
    "torch.nn.modules.activation.ReLU",
    "torch.nn.modules.activation.ReLU6",
    "torch.nn.modules.activation.SELU",
    "torch.nn.modules.activation.SiLU",
    "torch.nn.modules.activation.Sigmoid",
    "torch.nn.modules.activation.Softplus",
    "torch.nn.modules.activation.Softsign",
    "torch.nn.modules.activation.Tanh",
    "torch.optim.adagrad.Adagrad",
    "torch.optim.adam.Adam",
    "torch.optim.adamax.Adamax",
    "torch.optim.adamw.AdamW",
    "torch.optim.nadam.NAdam",
    "torch.optim.radam.RAdam",
    "torch.optim.rmsprop.RMSprop",
    "torch.optim.sgd.SGD",
)
# The function that is called for a name. Items and state of its result follow in the pickle.
_FUNCTIONS: StrDict = {
    "numpy.dtype": _dtype,
    # Gymnasium's spaces have no other bit generator.
    "numpy.random._pickle.__bit_generator_ctor": lambda *_: PCG64(0),
    "numpy.random._pickle.__generator_ctor": _generator,
    "numpy.random.bit_generator.__pyx_unpickle_SeedSequence": lambda *_: SeedSequence(0),
    "numpy.core.numeric._frombuffer": _array,
    "numpy.core.multiarray._reconstruct": lambda *_: np.empty(0, np.int8),
    "numpy.core.multiarray.scalar": lambda dtype, content: _array(content, dtype, (), "C")[()],
    "collections.OrderedDict": lambda: OrderedDict(),
    "collections.deque": lambda _, length=None: deque(maxlen=length),
    # A member of this enumeration is called for by its value.
    "stable_baselines3.common.type_aliases.TrainFrequencyUnit": (
        TrainFrequencyUnit._value2member_map_.__getitem__
    ),
}
# Arguments of these functions, which know by themselves what they make.
_ARGUMENTS = {
    "numpy.ndarray": "an array",
    "numpy.random._pcg64.PCG64": "a bit generator",
    "numpy.random.bit_generator.SeedSequence": "seeds",
}
_KNOWN = _CLASSES | _FUNCTIONS | _ARGUMENTS
# How an object that has been made gets its state. For others that is by attributes.
_CHANGES: dict[type, Any] = {
    np.ndarray: _fill_array,
    PCG64: _set_bit_generator,
    Generator: _set_generator,
    SeedSequence: lambda *_: None,
}
# Opcodes that only put plain values on the stack, or move what is there.
_HARMLESS = (
    "PROTO",
    "FRAME",
    "STOP",
    "NONE",
    "NEWTRUE",
    "NEWFALSE",
    "BININT",
    "BININT1",
    "BININT2",
    "LONG1",
    "BINFLOAT",
    "SHORT_BINUNICODE",
    "BINUNICODE",
    "SHORT_BINBYTES",
    "BINBYTES",
    "BYTEARRAY8",
    "EMPTY_TUPLE",
    "EMPTY_LIST",
    "EMPTY_DICT",
    "TUPLE",
    "TUPLE1",
    "TUPLE2",
    "TUPLE3",
    "MARK",
    # The memo is how a pickle names an object twice.
    "MEMOIZE",
    "BINGET",
    "LONG_BINGET",
    # They ask _Reader.find_class.
    "GLOBAL",
    "STACK_GLOBAL",
)


class _Reader(pickle._Unpickler):
    """Python's reader for few opcodes, which checks what they name, call and change."""

    # Python's, which have no public types.
    stack: list[Any]
    pop_mark: Callable[[], list[Any]]

    def find_class(self, module: str, name: str) -> Any:
        # NumPy 2 moved its core.
        full_name = f"{module}.{name}".replace("numpy._core.", "numpy.core.")
        if full_name not in _KNOWN:
            shown = full_name.encode("unicode_escape").decode()[:200]
            raise _Refusal(f"names {shown}, which may run anything")
        return _KNOWN[full_name]

    def call(self) -> None:
        arguments = self.stack.pop()
        function = self.stack.pop()
        _check(_is_one_of(function, _FUNCTIONS) and type(arguments) is tuple, "a call")
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
        if isinstance(instance, np.dtype):
            _check_dtype(instance, state)
        elif kind in _CHANGES:
            _CHANGES[kind](instance, state)
        else:
            _check(_is_one_of(kind, _WITH_ATTRIBUTES) and type(state) is dict, "a state")
            are_plain = all(type(name) is str and not name.startswith("__") for name in state)
            _check(are_plain, "attributes")
            if hasattr(kind, "__setstate__"):
                kind.__setstate__(instance, state)
            else:
                instance.__dict__.update(state)

    def drop(self) -> None:
        # Python's would also take a mark, which no pickler writes.
        self.stack.pop()

    def append_item(self) -> None:
        self.extend([self.stack.pop()])

    def append_items(self) -> None:
        self.extend(self.pop_mark())

    def extend(self, new: list[Any]) -> None:
        items = self.stack[-1]
        _check(type(items) in (list, deque), "a container")
        items.extend(new)

    def set_item(self) -> None:
        value = self.stack.pop()
        key = self.stack.pop()
        self.update([key, value])

    def set_items(self) -> None:
        self.update(self.pop_mark())

    def update(self, new: list[Any]) -> None:
        items = self.stack[-1]
        _check(type(items) in (dict, OrderedDict), "a container")
        items.update(zip(new[::2], new[1::2], strict=True))

    dispatch: ClassVar[dict[int, Any]] = {
        pickle.POP[0]: drop,
        pickle.REDUCE[0]: call,
        pickle.NEWOBJ[0]: make,
        pickle.BUILD[0]: change,
        pickle.APPEND[0]: append_item,
        pickle.APPENDS[0]: append_items,
        pickle.SETITEM[0]: set_item,
        pickle.SETITEMS[0]: set_items,
    }


for _name in _HARMLESS:
    _opcode = getattr(pickle, _name)[0]
    _Reader.dispatch[_opcode] = pickle._Unpickler.dispatch[_opcode]
