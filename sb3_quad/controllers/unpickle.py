"""A strict reader of the pickles in SB3's zips.

Python's own reader calls any function that a pickle names (docs/security.md). This one interprets
the opcodes one by one. It looks names up in the tables of this file alone. It calls only functions
of this file, which check their arguments, and changes only objects that the same pickle has made.
So nothing outside the result changes.
"""

import base64
import math
import pickletools
import re
from collections import OrderedDict, deque
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.random import PCG64, Generator, SeedSequence
from stable_baselines3.common import buffers, noise, policies, torch_layers, utils
from stable_baselines3.common.sb2_compat.rmsprop_tf_like import RMSpropTFLike
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit
from stable_baselines3.dqn import policies as dqn
from stable_baselines3.her import GoalSelectionStrategy
from stable_baselines3.her import her_replay_buffer as her
from stable_baselines3.sac import policies as sac
from stable_baselines3.td3 import policies as td3
from torch import nn, optim

from sb3_quad.base.errors import ConfigError, MissingExtra
from sb3_quad.base.imports import require
from sb3_quad.base.process import TRUST_VARIABLE
from sb3_quad.base.types import StrDict

WAY_OUT = f"if you trust whoever made it, add --trust (in Python: {TRUST_VARIABLE}=1)"


def unpickle(text: str, where: str) -> Any:
    """Return the object that an entry of an SB3 zip holds.

    :param text: base64 of a pickle, as SB3 writes it.
    :param where: what messages call the entry.
    :raises ConfigError: the pickle names or does something that SB3's own pickles do not. Nothing
        of that has been imported or called.
    """
    try:
        return _interpret(base64.b64decode(text))
    except _UnknownName as error:
        raise ConfigError(f"{where} names {error}, which may run anything; {WAY_OUT}") from None
    except MissingExtra:
        raise
    except Exception as error:  # what wrong types raise depends on the types
        # Other errors' messages may show an object of the pickle, and to show it is to call it.
        reason = str(error) if isinstance(error, _Refusal) else type(error).__name__
        raise ConfigError(
            f"{where} is not what Stable-Baselines3 pickles ({reason}); {WAY_OUT}"
        ) from None


class _UnknownName(Exception):
    """A pickle names something that is in no table."""


class _Refusal(Exception):
    """A pickle does something that no pickle of SB3 does."""


def _check(fits: bool, what: str) -> None:
    if not fits:
        raise _Refusal(what)


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
    """Do what ``ndarray.__setstate__`` does."""
    _, shape, dtype, by_columns, content = state
    _check(isinstance(dtype, np.dtype), "an array")
    _check(type(content) is bytes and type(by_columns) is bool, "an array")
    is_shape = type(shape) is tuple and all(type(n) is int and n >= 0 for n in shape)
    _check(is_shape, "the shape of an array")
    _check(len(content) == math.prod(shape) * dtype.itemsize, "the size of an array")
    array.__setstate__((1, shape, dtype, by_columns, content))


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


def _by_name(*classes: type) -> StrDict:
    return {f"{kind.__module__}.{kind.__qualname__}": kind for kind in classes}


def _members(names: dict[Any, str]) -> StrDict:
    """Return classes by their full names.

    :param names: the names of the classes in each module.
    """
    classes = []
    for module, text in names.items():
        classes += [getattr(module, name) for name in text.split()]
    return _by_name(*classes)


# Instances of these classes are made, and get attributes.
_WITH_ATTRIBUTES = _members(
    {
        spaces: "Box Dict Discrete MultiBinary MultiDiscrete",
        noise: "NormalActionNoise OrnsteinUhlenbeckActionNoise VectorizedActionNoise",
        utils: "ConstantSchedule FloatSchedule LinearSchedule",
    }
)
_NAMED = {
    policies: "ActorCriticPolicy ActorCriticCnnPolicy MultiInputActorCriticPolicy",
    sac: "SACPolicy CnnPolicy MultiInputPolicy",
    td3: "TD3Policy CnnPolicy MultiInputPolicy",
    dqn: "DQNPolicy CnnPolicy MultiInputPolicy",
    torch_layers: "FlattenExtractor NatureCNN CombinedExtractor",
    buffers: ("RolloutBuffer DictRolloutBuffer ReplayBuffer DictReplayBuffer NStepReplayBuffer"),
    her: "HerReplayBuffer",
    nn: (
        "CELU ELU GELU Hardswish Hardtanh LeakyReLU Mish ReLU ReLU6 SELU Sigmoid SiLU Softplus "
        "Softsign Tanh"
    ),
    optim: "Adagrad Adam Adamax AdamW NAdam RAdam RMSprop SGD",
    np: "float32 float64",
}
# The others of these are only named, but for TrainFreq, a named tuple.
_CLASSES = _WITH_ATTRIBUTES | _members(_NAMED) | _by_name(RMSpropTFLike, TrainFreq)
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
}
# Members of enumerations, by their values.
for _key, _kind in _by_name(TrainFrequencyUnit, GoalSelectionStrategy).items():
    _FUNCTIONS[_key] = {member.value: member for member in _kind}.__getitem__
# Arguments of these functions, which know by themselves what they make.
_ARGUMENTS = {key: key for key in _by_name(np.ndarray, PCG64, SeedSequence)}
# How an object that has been made gets its state.
_CHANGES: dict[type, Any] = {
    np.ndarray: _fill_array,
    PCG64: _set_bit_generator,
    Generator: _set_generator,
    SeedSequence: lambda *_: None,
}
for _code in "?bhilqBHILQefdgFDG":
    _CHANGES[type(np.dtype(_code))] = _check_dtype


# What the opcodes do. Each function takes the items of the stack and returns what replaces them.


def _find(module: Any, name: Any) -> Any:
    _check(type(module) is str and type(name) is str, "a name")
    # NumPy 2 moved its core.
    full_name = f"{module}.{name}".replace("numpy._core.", "numpy.core.")
    names = _CLASSES | _FUNCTIONS | _ARGUMENTS
    if full_name.startswith("sb3_contrib.common.recurrent."):
        recurrent = require("sb3_contrib", "", "a recurrent agent").common.recurrent
        names |= _members(
            {
                recurrent.policies: (
                    "RecurrentActorCriticPolicy RecurrentActorCriticCnnPolicy "
                    "RecurrentMultiInputActorCriticPolicy"
                ),
                recurrent.buffers: "RecurrentRolloutBuffer RecurrentDictRolloutBuffer",
            }
        )
    if full_name not in names:
        raise _UnknownName(full_name.encode("unicode_escape").decode()[:200])
    return names[full_name]


def _call(function: Any, arguments: Any) -> Any:
    _check(_is_one_of(function, _FUNCTIONS) and type(arguments) is tuple, "a call")
    return function(*arguments)


def _new(kind: Any, arguments: Any) -> Any:
    _check(type(arguments) is tuple, "an instance")
    if kind is TrainFreq:
        return TrainFreq(*arguments)
    _check(_is_one_of(kind, _WITH_ATTRIBUTES) and not arguments, "an instance")
    return kind.__new__(kind)


def _change(instance: Any, state: Any) -> Any:
    kind = type(instance)
    if kind in _CHANGES:
        _CHANGES[kind](instance, state)
        return instance
    _check(_is_one_of(kind, _WITH_ATTRIBUTES) and type(state) is dict, "a state")
    _check(all(type(name) is str and not name.startswith("__") for name in state), "attributes")
    if hasattr(kind, "__setstate__"):
        kind.__setstate__(instance, state)
    else:
        instance.__dict__.update(state)
    return instance


def _extend(items: Any, *new: Any) -> Any:
    _check(type(items) in (list, deque), "a container")
    items.extend(new)
    return items


def _update(items: Any, *new: Any) -> Any:
    _check(type(items) in (dict, OrderedDict), "a container")
    items.update(zip(new[::2], new[1::2], strict=True))
    return items


def _tuple(*items: Any) -> Any:
    return items


# Opcodes that push their argument.
_LITERALS = [
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
]
# Opcodes that replace so many items of the stack by the result of a function.
_OPERATIONS: StrDict = {
    "NONE": (0, lambda: None),
    "NEWTRUE": (0, lambda: True),
    "NEWFALSE": (0, lambda: False),
    "EMPTY_TUPLE": (0, _tuple),
    "EMPTY_LIST": (0, list),
    "EMPTY_DICT": (0, dict),
    "TUPLE1": (1, _tuple),
    "TUPLE2": (2, _tuple),
    "TUPLE3": (3, _tuple),
    "TUPLE": (0, _tuple),
    "APPEND": (2, _extend),
    "APPENDS": (1, _extend),
    "SETITEM": (3, _update),
    "SETITEMS": (1, _update),
    "STACK_GLOBAL": (2, _find),
    "REDUCE": (2, _call),
    "NEWOBJ": (2, _new),
    "BUILD": (2, _change),
}
# These replace all items above the last mark as well.
_TO_MARK = ("TUPLE", "APPENDS", "SETITEMS")


def _interpret(content: bytes) -> Any:
    """Return what a pickle holds.

    Known are the opcodes of protocols 4 and 5 that are used for what SB3 saves.
    """
    memo: list[Any] = []
    stack: list[Any] = []
    below: list[list[Any]] = []  # the stacks below each mark
    argument: Any
    for opcode, argument, _ in pickletools.genops(content):
        name = opcode.name
        if name in _LITERALS:
            stack.append(argument)
        elif name in _OPERATIONS:
            # Take the items off the stack, and push the result.
            above: list[Any] = []
            if name in _TO_MARK:
                above = stack
                stack = below.pop()
            count, operation = _OPERATIONS[name]
            items = [stack.pop() for _ in range(count)]
            stack.append(operation(*reversed(items), *above))
        elif name == "GLOBAL":
            stack.append(_find(*argument.split(" ")))
        # A mark begins a new stack on top of the present one.
        elif name == "MARK":
            below.append(stack)
            stack = []
        elif name == "POP":
            stack.pop()
        # The memo is how a pickle names an object twice.
        elif name == "MEMOIZE":
            memo.append(stack[-1])
        elif name in ("BINGET", "LONG_BINGET"):
            stack.append(memo[argument])
        else:
            _check(name in ("PROTO", "FRAME", "STOP"), f"opcode {name}")
    return stack.pop()
