"""Generated pickles with all opcodes and all names, with depth, sharing and cycles. Each is read in
a process of its own, which ends within ``SECONDS`` and ``MEMORY`` and changes nothing.

SB3_QUAD_PICKLES asks for more of them.
"""

import base64
import copy
import json
import os
import pickle
import pickletools
import random
import resource
import sys
import traceback
import types
import zipfile
from collections import deque
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from stable_baselines3.common.noise import NormalActionNoise, VectorizedActionNoise
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.utils import FloatSchedule

from sb3_quad.agents import unpickle as own
from sb3_quad.agents.pretrained import pretrained_path
from sb3_quad.base.errors import ConfigError

COUNT = int(os.environ.get("SB3_QUAD_PICKLES", "100"))
SECONDS, MEMORY = 5, 2**30  # of one core; bytes
KNOWN = [tuple(name.rsplit(".", 1)) for name in own._KNOWN]
FOREIGN = [
    *(("os", "system"), ("canary", "touched"), ("canary", "Touched"), ("numpy", "load")),
    *(("builtins", name) for name in ("getattr", "setattr", "bool", "exec")),
    ("stable_baselines3.common.buffers", "BaseBuffer"),
    ("stable_baselines3.common.vec_env.base_vec_env", "CloudpickleWrapper"),
]
DANGEROUS = ("__subclasshook__", "__setstate__", "__class__", "__init__")
ATTRIBUTES = [*DANGEROUS, "low", "dtype", "_shape", "start", "_mu", "x"]
WORDS = [*ATTRIBUTES, "f4", "i8", "?", "O", "V8", "|", "<", "C", "PCG64", "step", "echo > ran"]
NEW, CALL = b"\x81", b"R"


def text(value: str) -> bytes:
    return b"\x8c" + bytes([len(value)]) + value.encode()


def real_pickles() -> list[bytes]:
    with zipfile.ZipFile(pretrained_path("itm-imitation")) as archive:
        entries = json.loads(archive.read("data")).values()
    saved = [
        base64.b64decode(entry[":serialized:"])
        for entry in entries
        if isinstance(entry, dict) and ":serialized:" in entry
    ]
    noise = VectorizedActionNoise(NormalActionNoise(np.zeros(2), np.ones(2)), 2)
    strided = np.arange(12.0).reshape(4, 3)[:, 1]
    arrays = np.ones((2, 2)).T, strided, np.array(True), np.float64(0.5), np.zeros((0, 3), np.uint8)
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
    return repr((value, getattr(value, "maxlen", None)))


@pytest.mark.parametrize("content", REAL)
def test_sb3s_pickles_are_read_as_pickle_reads_them(content):
    ours, theirs = own.unpickle(base64.b64encode(content).decode(), "here"), pickle.loads(content)
    assert shown(ours) == shown(theirs)
    assert type(ours) is type(theirs)


def put(number: int) -> bytes:
    return b"r" + number.to_bytes(4, "little")


def get(number: int) -> bytes:
    return b"j" + number.to_bytes(4, "little")


TUPLES = b")" + b"\x85" * 300_000
DEEP = [TUPLES, b")" + b"\x85" * 10, b"]" * 1000 + b"N" + b"a" * 1000]
DEEP += [b"}\x8c\x01a" * n + b"N" + b"s" * n for n in (10, 1000, 300_000)]
PAIRS = [b")" + b"".join(put(k) + get(k) + b"\x86" for k in range(n)) for n in (3, 20, 60)]
LISTS = b")" + b"".join(put(k) + b"0]" + get(k) + b"a" + get(k) + b"a" for k in range(60))
ITSELF = b"]" + put(999) + get(999) + b"a"
CYCLES = [ITSELF, b"]" + put(999) + get(999) + b"\x85a", b"}" + put(9) + b"K\1" + get(9) + b"s"]
BOX = text("gymnasium.spaces.box") + text("Box") + b"\x93)\x81"
UNIT = text("stable_baselines3.common.type_aliases") + text("TrainFrequencyUnit") + b"\x93"
SEEDS = text("numpy.random.bit_generator") + text("__pyx_unpickle_SeedSequence") + b"\x93"
HOLDER = BOX + put(1) + b"}" + text("low") + get(1) + b"sb"
MANY = [code * n for code in (b"(", b"}\x94", b")\x94") for n in (10, 400_000)]
LONG = [b"\x96" + (1 << n).to_bytes(8, "little") for n in (20, 34, 62)]
MONSTERS = [DEEP, [*PAIRS, LISTS], [*CYCLES, HOLDER], MANY, LONG]
PLACES = [(b"", b""), (b"}", b"Ns"), (b"}", b"K\1s"), (b"\x8f(", b"\x90"), (UNIT, b"\x85R")]
PLACES += [(SEEDS, b"K\0K\0\x87R"), (BOX + b"}" + text("low"), b"sb"), (BOX, b"b")]


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
            if len(content) > 100_000:
                break
            try:
                list(pickletools.genops(content))
            except ValueError:
                break
        return content

    def value(self, depth: int) -> bytes:
        """Return opcodes that leave one object on the stack, as a rule."""
        simple = (self.constant, self.word, self.a_name, self.raw)
        nested = (self.items, self.made, self.made, self.changed)
        if self.rng.random() < 0.1:
            return self.monster(depth)
        return self.rng.choice(simple if depth > 4 or self.rng.random() < 0.3 else nested)(
            depth + 1
        )

    def monster(self, depth: int) -> bytes:
        """Return opcodes for an object that is deep, shared or cyclic, in a place of some kind."""
        before, after = self.rng.choice(PLACES)
        return before + self.rng.choice(self.rng.choice(MONSTERS)) + after

    def constant(self, depth: int = 0) -> bytes:
        minus_one, two = b"J\xff\xff\xff\xff", b"G@\0\0\0\0\0\0\0"
        return self.rng.choice((b"N", b"\x88", b"\x89", b"K\x01", minus_one, two, b"C\4abcd", b")"))

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
        size, one = opcode.arg.n if opcode.arg else 0, b"\1\0\0\0"
        # Sizes below 0 say where the length stands.
        lines = b"os\nsystem\n" if opcode.name in ("GLOBAL", "INST") else b"1\n"
        texts = {-1: lines, -2: b"\1a", -3: one + b"a", -4: one + b"a", -5: one + b"\0\0\0\0a"}
        return opcode.code.encode("latin-1") + texts.get(size, b"\0" * size)

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
        some = self.rng.choice((b")", self.tuple(depth)))
        names, arguments, how = self.rng.choice(
            (
                (own._WITH_ATTRIBUTES, b")", NEW),
                (own._FUNCTIONS, some, CALL),
                (own._FUNCTIONS, self.word() + b"\x89\x88\x87", CALL),
                (KNOWN + FOREIGN, some, self.rng.choice((NEW, CALL))),
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
        made = self.made(depth)
        return (
            self.rng.choice((made, made, self.a_name(), self.value(depth))) + b"\x94" + state + b"b"
        )


def contents(value: object) -> list[object]:
    if type(value) is dict:
        return [*value.values()]
    return [*value] if type(value) in (list, set, tuple) else []


class World:
    """Attributes of all classes that pickles may name, of their bases and modules, and the contents
    of containers.
    """

    def __init__(self) -> None:
        known = (*own._CLASSES.values(), np.ndarray, np.dtype, deque)
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


def read(content: bytes, world: World) -> int:
    """Read and use a pickle; 0: it was read, 1: refused, others: what should not be."""
    global EVENTS
    EVENTS = []
    try:
        found = own.unpickle(base64.b64encode(content).decode(), "here")
    except ConfigError:
        found = None
    events, EVENTS = EVENTS, None
    if events:
        return 2
    if not world.is_as_before():
        return 3
    for use in (repr, copy.deepcopy, pickle.dumps):
        with suppress(Exception):  # half of an object has no text
            use(found)
    return found is None


def status(job) -> tuple[int, float]:
    """Exit code of a process that does a job, below 0 the signal that ended it, and its bytes."""
    # The child begins with the memory of this process, which other tests have filled.
    statm = Path("/proc/self/statm")
    held = int(statm.read_text().split()[1]) * resource.getpagesize() if statm.exists() else 0
    child = os.fork()
    if child == 0:
        code = 70
        try:
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
            resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS))
            code = job()
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(code)
    _, ended, usage = os.wait4(child, 0)
    unit = 1 if sys.platform == "darwin" else 1024
    return os.waitstatus_to_exitcode(ended), usage.ru_maxrss * unit - held


@pytest.mark.timeout(120 + COUNT // 4)
def test_generated_pickles_change_nothing_and_cost_little(tmp_path, monkeypatch):
    canary = types.ModuleType("canary")
    canary.touched = touch
    canary.Touched = type("Touched", (), {"__setstate__": touch, "__new__": touch})
    monkeypatch.setitem(sys.modules, "canary", canary)
    monkeypatch.chdir(tmp_path)
    world, n_read, most = World(), 0, 0.0
    for seed in range(COUNT):
        content = Writer(seed).pickle()
        code, size = status(lambda content=content: read(content, world))
        assert code in (0, 1), (seed, code)
        assert size < MEMORY, seed
        n_read, most = n_read + (code == 0), max(most, size)
    assert not [*tmp_path.iterdir()]
    assert 0.1 < n_read / COUNT < 0.9, n_read
    print(f"{COUNT} pickles, {n_read} of them read, at most {most / 2**20:.0f} MB")


@pytest.mark.parametrize(
    "content",
    [
        *(b"}" + TUPLES + b"Ns", UNIT + TUPLES + b"\x85R", PAIRS[-1], b"}" + PAIRS[-1] + b"Ns"),
        *(ITSELF, HOLDER, LISTS, LONG[-1], b"}\x94" * 10**6),
        pickle.dumps(gymnasium.spaces.Box(0, 1, (9,))).replace(b"K\t", b"J\xff\xff\xff\x7f", 1),
    ],
    ids=range(10),
)
def test_a_small_pickle_that_would_cost_much_is_refused(content):
    code, size = status(lambda: read(b"\x80\x04" + content + b".", World()))
    assert (code, size < MEMORY) == (1, True)
