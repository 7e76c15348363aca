"""Reading the pickles in SB3's zips. Python's own reader calls any function that a pickle names
(docs/security.md).

Here the opcodes are interpreted one by one. Names are looked up in the tables of this file alone;
what is called is a function of this file, which checks its arguments; what is changed was made by
the same pickle. So nothing outside the result changes.
"""

import base64
import math
import pickletools
import re
import sys
from collections import OrderedDict, deque
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.random import PCG64, Generator, SeedSequence
from stable_baselines3.common import buffers, noise, policies, torch_layers, utils
from stable_baselines3.common.sb2_compat.rmsprop_tf_like import RMSpropTFLike
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit
from stable_baselines3.dqn import policies as dqn
from stable_baselines3.her import GoalSelectionStrategy, HerReplayBuffer
from stable_baselines3.sac import policies as sac
from stable_baselines3.td3 import policies as td3
from torch import nn, optim

from sb3_quad.base.errors import ConfigError, MissingExtra
from sb3_quad.base.imports import require
from sb3_quad.base.process import TRUST_VARIABLE

WAY_OUT = f"if you trust whoever made it, add --trust (in Python: {TRUST_VARIABLE}=1)"
Names = dict[tuple[str, str], Any]  # what stands for module and name


def unpickle(text: str, where: str) -> Any:
    """What an entry of an SB3 zip holds.

    :param text: base64 of a pickle, as SB3 writes it.
    :param where: what messages call the entry.
    :raises ConfigError: it names or does what SB3's own pickles do not; nothing of that has been
        imported or called.
    """
    try:
        return _interpret(base64.b64decode(text))
    except _UnknownName as error:
        raise ConfigError(f"{where} names {error}, which may run anything; {WAY_OUT}") from None
    except MissingExtra:
        raise
    except Exception as error:  # what wrong types raise depends on the types
        # Not the message of any error: to show an object is to ask it.
        reason = str(error) if isinstance(error, _Refusal) else type(error).__name__
        raise ConfigError(
            f"{where} is not what Stable-Baselines3 pickles ({reason}); {WAY_OUT}"
        ) from None


class _UnknownName(Exception):
    """A pickle names what is in no table."""


class _Refusal(Exception):
    """A pickle does what no pickle of SB3 does."""


def _check(fits: bool, what: str) -> None:
    if not fits:
        raise _Refusal(what)


def _array(buffer: Any, dtype: Any, shape: Any, order: Any, axes: Any = None) -> Any:
    """As ``numpy._core.numeric._frombuffer``."""
    _check(type(buffer) in (bytes, bytearray) and isinstance(dtype, np.dtype), "an array")
    array = np.frombuffer(buffer, dtype)
    return (
        array.reshape(shape, order=order) if axes is None else array.reshape(shape).transpose(axes)
    )


def _fill_array(array: Any, state: Any) -> None:
    """As ``ndarray.__setstate__``."""
    _, shape, dtype, by_columns, content = state
    _check(
        isinstance(dtype, np.dtype) and type(content) is bytes and type(by_columns) is bool,
        "an array",
    )
    _check(
        type(shape) is tuple and all(type(n) is int and n >= 0 for n in shape),
        "the shape of an array",
    )
    _check(len(content) == math.prod(shape) * dtype.itemsize, "the size of an array")
    array.__setstate__((1, shape, dtype, by_columns, content))


def _dtype(code: Any, *_: Any) -> Any:
    """Numbers only. An array of objects made of bytes would read memory as it likes."""
    _check(type(code) is str and re.fullmatch(r"[biufc]\d{1,2}", code) is not None, "a dtype")
    return np.dtype(code)


def _check_dtype(dtype: Any, state: Any) -> None:
    native = "|" if dtype.itemsize == 1 else {"little": "<", "big": ">"}[sys.byteorder]
    _check(state[1] in ("|", native) and state[2:5] == (None, None, None), "a dtype")


def _set_bit_generator(bit_generator: Any, state: Any) -> None:
    if type(state) is tuple:
        state, seeds = state
        _check(type(seeds) is SeedSequence, "a random generator")
        bit_generator.__init__(seeds)
    bit_generator.state = state


def _generator(bit_generator: Any, *_: Any) -> Generator:
    """As ``numpy.random._pickle.__generator_ctor``; NumPy 1 gives the bit generator's name."""
    return Generator(bit_generator if type(bit_generator) is PCG64 else PCG64(0))


def _set_generator(generator: Any, state: Any) -> None:
    generator.bit_generator.state = state


def _set_seed_sequence(seeds: Any, state: Any) -> None:
    entropy, spawned, _, pool_size, spawn_key = state  # of which the pool follows
    seeds.__init__(entropy, spawn_key=spawn_key, pool_size=pool_size, n_children_spawned=spawned)


def _member(kind: Any, value: Any) -> Any:
    return {each.value: each for each in kind}[value]


def _by_name(*classes: type) -> Names:
    return {(each.__module__, each.__qualname__): each for each in classes}


_WITH_ATTRIBUTES = _by_name(  # instances of these are made, and given attributes
    *(spaces.Box, spaces.Dict, spaces.Discrete, spaces.MultiBinary, spaces.MultiDiscrete),
    *(noise.NormalActionNoise, noise.OrnsteinUhlenbeckActionNoise, noise.VectorizedActionNoise),
    *(utils.ConstantSchedule, utils.FloatSchedule, utils.LinearSchedule),
)
_CLASSES = _WITH_ATTRIBUTES | _by_name(  # these are only named; TrainFreq is a tuple
    *(
        policies.ActorCriticPolicy,
        policies.ActorCriticCnnPolicy,
        policies.MultiInputActorCriticPolicy,
    ),
    *(
        sac.SACPolicy,
        sac.CnnPolicy,
        sac.MultiInputPolicy,
        td3.TD3Policy,
        td3.CnnPolicy,
        td3.MultiInputPolicy,
    ),
    *(dqn.DQNPolicy, dqn.CnnPolicy, dqn.MultiInputPolicy),
    *(torch_layers.FlattenExtractor, torch_layers.NatureCNN, torch_layers.CombinedExtractor),
    *(
        buffers.RolloutBuffer,
        buffers.DictRolloutBuffer,
        buffers.ReplayBuffer,
        buffers.DictReplayBuffer,
    ),
    *(buffers.NStepReplayBuffer, HerReplayBuffer, TrainFreq, np.float32, np.float64),
    *(
        nn.CELU,
        nn.ELU,
        nn.GELU,
        nn.Hardswish,
        nn.Hardtanh,
        nn.LeakyReLU,
        nn.Mish,
        nn.ReLU,
        nn.ReLU6,
        nn.SELU,
        nn.Sigmoid,
    ),
    *(nn.SiLU, nn.Softplus, nn.Softsign, nn.Tanh),
    *(
        optim.Adagrad,
        optim.Adam,
        optim.Adamax,
        optim.AdamW,
        optim.NAdam,
        optim.RAdam,
        optim.RMSprop,
        optim.SGD,
        RMSpropTFLike,
    ),
)
_NUMPY: Names = {  # in numpy.core, which is numpy._core in NumPy 2
    ("numeric", "_frombuffer"): _array,
    ("multiarray", "_reconstruct"): lambda *_: np.empty(0, np.int8),
    ("multiarray", "scalar"): lambda dtype, content: _array(content, dtype, (), "C")[()],
}
_FUNCTIONS: Names = {  # what is called for a name; items and state follow
    **{
        (f"numpy.{core}.{module}", name): each
        for core in ("core", "_core")
        for (module, name), each in _NUMPY.items()
    },
    ("numpy", "dtype"): _dtype,
    ("numpy.random._pickle", "__bit_generator_ctor"): lambda *_: PCG64(
        0
    ),  # Gymnasium's spaces have no other kind
    ("numpy.random._pickle", "__generator_ctor"): _generator,
    ("numpy.random.bit_generator", "__pyx_unpickle_SeedSequence"): lambda *_: SeedSequence(0),
    ("collections", "OrderedDict"): lambda: OrderedDict(),
    ("collections", "deque"): lambda _, length=None: deque(maxlen=length),
    **{
        key: partial(_member, kind)
        for key, kind in _by_name(TrainFrequencyUnit, GoalSelectionStrategy).items()
    },
}
_ARGUMENTS: Names = {
    key: key[1] for key in _by_name(np.ndarray, PCG64, SeedSequence)
}  # of those functions, which know them
_CHANGES: dict[type, Callable[[Any, Any], None]] = {  # how what has been made is given its state
    np.ndarray: _fill_array,
    PCG64: _set_bit_generator,
    Generator: _set_generator,
    SeedSequence: _set_seed_sequence,
    **{type(np.dtype(each)): _check_dtype for each in "?bhilqBHILQefdgFDG"},
}


def _find(module: Any, name: Any) -> Any:
    _check(type(module) is str and type(name) is str, "a name")
    names = _CLASSES | _FUNCTIONS | _ARGUMENTS
    if module.startswith("sb3_contrib.common.recurrent."):
        recurrent = require("sb3_contrib", "", "a recurrent agent").common.recurrent
        kinds = ("ActorCriticPolicy", "ActorCriticCnnPolicy", "MultiInputActorCriticPolicy")
        names |= _by_name(*(getattr(recurrent.policies, f"Recurrent{kind}") for kind in kinds))
        names |= _by_name(
            recurrent.buffers.RecurrentRolloutBuffer, recurrent.buffers.RecurrentDictRolloutBuffer
        )
    if (module, name) not in names:
        raise _UnknownName(f"{module}.{name}".encode("unicode_escape").decode()[:200])
    return names[module, name]


def _call(function: Any, arguments: Any) -> Any:
    _check(
        any(function is each for each in _FUNCTIONS.values()) and type(arguments) is tuple, "a call"
    )
    return function(*arguments)


def _new(kind: Any, arguments: Any) -> Any:
    _check(type(arguments) is tuple, "an instance")
    if kind is TrainFreq:
        return TrainFreq(*arguments)
    _check(any(kind is each for each in _WITH_ATTRIBUTES.values()) and not arguments, "an instance")
    return kind.__new__(kind)


def _change(instance: Any, state: Any) -> Any:
    kind = type(instance)
    if kind in _CHANGES:
        _CHANGES[kind](instance, state)
        return instance
    _check(kind in _WITH_ATTRIBUTES.values() and type(state) is dict, "a state")
    _check(all(type(name) is str and not name.startswith("__") for name in state), "attributes")
    getattr(kind, "__setstate__", lambda made, attributes: made.__dict__.update(attributes))(
        instance, state
    )
    return instance


def _of_kind(value: Any, *kinds: type) -> Any:
    _check(type(value) in kinds, "a container")
    return value


_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
_EMPTY = {"EMPTY_TUPLE": tuple, "EMPTY_LIST": list, "EMPTY_DICT": dict, "EMPTY_SET": set}
_LITERALS = {
    *(
        "BININT",
        "BININT1",
        "BININT2",
        "LONG1",
        "BINFLOAT",
        "SHORT_BINUNICODE",
        "BINUNICODE",
        "BINUNICODE8",
    ),
    *("SHORT_BINBYTES", "BINBYTES", "BINBYTES8", "BYTEARRAY8"),
}
_OF_TWO: dict[str, Callable[[Any, Any], Any]] = {
    "STACK_GLOBAL": _find,
    "REDUCE": _call,
    "NEWOBJ": _new,
    "BUILD": _change,
}
_SIZES = {
    "TUPLE1": 1,
    "TUPLE2": 2,
    "TUPLE3": 3,
    "APPEND": 1,
    "SETITEM": 2,
    "POP": 1,
    **dict.fromkeys(_OF_TWO, 2),
}
_FROM_MARK = {"TUPLE", "APPENDS", "SETITEMS", "ADDITEMS", "FROZENSET", "POP_MARK"}


def _interpret(content: bytes) -> Any:
    """What a pickle holds; of the opcodes, those that protocols 4 and 5 use for what SB3 saves."""
    memo: dict[int, Any] = {}
    stack: list[Any] = []
    below: list[list[Any]] = []  # the stacks below each mark
    argument: Any
    for opcode, argument, _ in pickletools.genops(content):
        name, items = opcode.name, []
        if name in _SIZES:
            items = [stack.pop() for _ in range(_SIZES[name])][::-1]
        elif name in _FROM_MARK:
            items, stack = stack, below.pop()
        if name in _CONSTANTS:
            stack.append(_CONSTANTS[name])
        elif name in _EMPTY:
            stack.append(_EMPTY[name]())
        elif name in _LITERALS:
            stack.append(argument)
        elif name in _OF_TWO:
            stack.append(_OF_TWO[name](*items))
        elif name.startswith("TUPLE"):
            stack.append(tuple(items))
        elif name == "FROZENSET":
            stack.append(frozenset(items))
        elif name.startswith("APPEND"):
            _of_kind(stack[-1], list, deque).extend(items)
        elif name.startswith("SETITEM"):
            _of_kind(stack[-1], dict, OrderedDict).update(zip(items[::2], items[1::2], strict=True))
        elif name == "ADDITEMS":
            _of_kind(stack[-1], set).update(items)
        elif name == "GLOBAL":
            stack.append(_find(*argument.split(" ")))
        elif name == "MARK":
            below.append(stack)
            stack = []
        elif name == "MEMOIZE":
            memo[len(memo)] = stack[-1]
        elif name in ("BINPUT", "LONG_BINPUT"):
            memo[argument] = stack[-1]
        elif name in ("BINGET", "LONG_BINGET"):
            stack.append(memo[argument])
        elif name == "STOP":
            return stack.pop()
        else:
            _check(name in ("PROTO", "FRAME", "POP", "POP_MARK"), f"opcode {name}")
    raise _Refusal("no end")
