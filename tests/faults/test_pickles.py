"""Generated pickles with all opcodes and all names: nothing outside of the result changes.

SB3_QUAD_PICKLES asks for more of them.
"""

import base64
import json
import os
import pickle
import pickletools
import random
import sys
import types
import zipfile
from collections import deque
from collections.abc import Iterable

import numpy as np
import pytest
from stable_baselines3.common.noise import NormalActionNoise, VectorizedActionNoise
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.utils import FloatSchedule

from sb3_quad.base.errors import ConfigError
from sb3_quad.controllers import unpickle as own
from sb3_quad.controllers.pretrained import pretrained

COUNT = int(os.environ.get("SB3_QUAD_PICKLES", "300"))
KNOWN = [tuple(name.rsplit(".", 1)) for name in own._KNOWN]
FOREIGN = [
    *(
        ("os", "system"),
        ("builtins", "getattr"),
        ("builtins", "setattr"),
        ("builtins", "bool"),
        ("builtins", "exec"),
    ),
    *(
        ("canary", "touched"),
        ("canary", "Touched"),
        ("numpy", "load"),
        ("stable_baselines3.common.buffers", "BaseBuffer"),
    ),
    ("stable_baselines3.common.vec_env.base_vec_env", "CloudpickleWrapper"),
]
ATTRIBUTES = [
    "__subclasshook__",
    "__setstate__",
    "__class__",
    "__init__",
    "low",
    "dtype",
    "_shape",
    "start",
    "_mu",
    "x",
]
WORDS = [
    *ATTRIBUTES,
    "f4",
    "i8",
    "?",
    "O",
    "V8",
    "|",
    "<",
    "C",
    "PCG64",
    "step",
    "echo > ran",
    "os",
]
NEW, CALL, CHANGE = b"\x81", b"R", b"b"


def text(value: str) -> bytes:
    return b"\x8c" + bytes([len(value)]) + value.encode()


def real_pickles() -> list[bytes]:
    with zipfile.ZipFile(pretrained("itm-imitation")) as archive:
        entries = json.loads(archive.read("data")).values()
    saved = [
        base64.b64decode(entry[":serialized:"])
        for entry in entries
        if isinstance(entry, dict) and ":serialized:" in entry
    ]
    noise = VectorizedActionNoise(NormalActionNoise(np.zeros(2), np.ones(2)), 2)
    arrays = (
        np.ones((2, 2)).T,
        np.arange(12.0).reshape(4, 3)[:, 1],
        np.array(True),
        np.float64(0.5),
        np.zeros((0, 3), np.uint8),
    )
    others = (
        noise,
        TrainFreq(1, TrainFrequencyUnit.STEP),
        FloatSchedule(0.1),
        deque([1], 3),
        arrays,
    )
    return saved + [pickle.dumps(value, protocol) for value in others for protocol in (4, 5)]


REAL = real_pickles()


def shown(value: object) -> str:
    generator = getattr(value, "_np_random", None)
    return repr(
        (value, generator and generator.bit_generator.state, getattr(value, "maxlen", None))
    )


@pytest.mark.parametrize("content", REAL)
def test_sb3s_pickles_are_read_as_pickle_reads_them(content):
    ours, theirs = own.unpickle(base64.b64encode(content).decode(), "here"), pickle.loads(content)
    assert shown(ours) == shown(theirs)
    assert type(ours) is type(theirs)


class Writer:
    """Writes pickles. Most of them fit together."""

    def __init__(self, seed: int) -> None:
        self.rng = random.Random(seed)

    def pickle(self) -> bytes:
        if self.rng.random() < 0.5:
            return b"\x80\x04" + self.value(0) + b"."
        content = self.rng.choice(REAL)
        for _ in range(self.rng.randint(1, 3)):
            places = (
                [place for _, _, place in pickletools.genops(content)]
                if self.rng.random() < 0.8
                else range(len(content))
            )
            first, after = sorted(self.rng.choices(places, k=2))
            piece = self.rng.choice(
                (self.value(1), self.value(1) + b"0", self.raw(), content[first:after], b"")
            )
            content = content[:first] + piece + content[self.rng.choice((first, first, after)) :]
            try:
                list(pickletools.genops(content))
            except ValueError:
                break
        return content

    def value(self, depth: int) -> bytes:
        """Return opcodes that leave one object on the stack, as a rule."""
        simple, nested = (
            (self.constant, self.word, self.a_name, self.raw),
            (self.items, self.made, self.made, self.changed),
        )
        return self.rng.choice(simple if depth > 4 or self.rng.random() < 0.3 else nested)(
            depth + 1
        )

    def constant(self, depth: int = 0) -> bytes:
        return self.rng.choice(
            (
                b"N",
                b"\x88",
                b"\x89",
                b"K\x01",
                b"J\xff\xff\xff\xff",
                b"G@\x00\0\0\0\0\0\0",
                b"C\x04abcd",
                b")",
            )
        )

    def word(self, depth: int = 0) -> bytes:
        return text(self.rng.choice(WORDS))

    def a_name(self, depth: int = 0) -> bytes:
        return self.name(FOREIGN if self.rng.random() < 0.05 else KNOWN)

    def name(self, names: Iterable[tuple[str, str]]) -> bytes:
        chosen = self.rng.choice([*names])
        module, name = chosen.rsplit(".", 1) if isinstance(chosen, str) else chosen
        return text(module) + text(name) + b"\x93"

    def raw(self, depth: int = 0) -> bytes:
        """Return any opcode, with an argument that it takes."""
        opcode = self.rng.choice(pickletools.opcodes)
        size, one = (
            opcode.arg.n if opcode.arg else 0,
            b"\1\0\0\0",
        )  # sizes below 0 say where the length stands
        lines = b"os\nsystem\n" if opcode.name in ("GLOBAL", "INST") else b"1\n"
        argument = {
            -1: lines,
            -2: b"\1a",
            -3: one + b"a",
            -4: one + b"a",
            -5: one + b"\0\0\0\0a",
        }.get(size, b"\0" * size)
        return opcode.code.encode("latin-1") + argument

    def tuple(self, depth: int) -> bytes:
        return b"(" + b"".join(self.value(depth + 1) for _ in range(self.rng.randint(0, 3))) + b"t"

    def items(self, depth: int) -> bytes:
        many = b"".join(self.value(depth + 1) for _ in range(self.rng.randint(0, 2)))
        return self.rng.choice(
            (self.tuple(depth), b"](" + many + b"e", b"\x8f(" + many + b"\x90", self.state(depth))
        )

    def state(self, depth: int) -> bytes:
        pairs = b"".join(
            text(self.rng.choice(ATTRIBUTES)) + self.value(depth + 1)
            for _ in range(self.rng.randint(0, 3))
        )
        return b"}(" + pairs + b"u"

    def made(self, depth: int) -> bytes:
        names, arguments, how = self.rng.choice(
            (
                (own._WITH_ATTRIBUTES, b")", NEW),
                (
                    own._FUNCTIONS,
                    self.rng.choice((b")", self.tuple(depth), self.word() + b"\x89\x88\x87")),
                    CALL,
                ),
                (
                    KNOWN + FOREIGN,
                    self.rng.choice((b")", self.tuple(depth))),
                    self.rng.choice((NEW, CALL)),
                ),
            )
        )
        return self.name(names) + arguments + how

    def changed(self, depth: int) -> bytes:
        """Return opcodes that set the state of an object, or of something else.

        The state holds attributes or, as Python allows, slots.
        """
        state = self.rng.choice(
            (self.state(depth), b"N" + self.state(depth) + b"\x86", self.tuple(depth))
        )
        return (
            self.rng.choice((self.made(depth), self.made(depth), self.a_name(), self.value(depth)))
            + b"\x94"
            + state
            + CHANGE
        )


def contents(value: object) -> list[object]:
    return (
        [*value.values()]
        if type(value) is dict
        else [*value]
        if type(value) in (list, set, tuple)
        else []
    )


class World:
    """Attributes of all classes that pickles may name, of their bases and modules, and the contents
    of containers.
    """

    def __init__(self) -> None:
        known = (*own._CLASSES.values(), *own._CHANGES)
        kinds = {base for kind in known for base in kind.__mro__}
        names = {kind.__module__ for kind in kinds} | {module for module, _ in KNOWN}
        owners = [own, *kinds, *(sys.modules[name] for name in names if name in sys.modules)]
        self.before = [
            (vars(owner), {name: (value, contents(value)) for name, value in vars(owner).items()})
            for owner in owners
        ]
        self.modules, self.environment = [*sys.modules], dict(os.environ)

    def is_as_before(self) -> bool:
        for now, before in self.before:  # the owners' attributes now and before
            if now.keys() - {"__warningregistry__"} != before.keys() - {"__warningregistry__"}:
                return False
            for name, (value, held) in before.items():
                if now[name] is not value or (
                    held and [*map(id, contents(value))] != [*map(id, held)]
                ):
                    return False
        return [*sys.modules] == self.modules and dict(os.environ) == self.environment


EVENTS: list[str] | None = None  # events of Python's auditing, while they are recorded


def audit(event: str, _: object) -> None:
    if EVENTS is not None:
        EVENTS.append(event)


sys.addaudithook(audit)


def touch(*_: object, **__: object) -> None:
    raise AssertionError("called")


@pytest.mark.timeout(60 + COUNT // 10)
def test_nothing_outside_of_the_result_changes(tmp_path, monkeypatch):
    global EVENTS
    canary = types.ModuleType("canary")
    canary.touched, canary.Touched = (
        touch,
        type("Touched", (), {"__setstate__": touch, "__new__": touch}),
    )
    monkeypatch.setitem(sys.modules, "canary", canary)
    monkeypatch.chdir(tmp_path)
    world, read = World(), 0
    for seed in range(COUNT):
        content = base64.b64encode(Writer(seed).pickle()).decode()
        EVENTS = []
        try:
            own.unpickle(content, "here")
            read += 1
        except ConfigError:
            pass
        finally:
            events, EVENTS = EVENTS, None
        assert not events, (seed, events)
        assert world.is_as_before(), seed
    assert not [*tmp_path.iterdir()]
    assert 0.1 < read / COUNT < 0.9, read
