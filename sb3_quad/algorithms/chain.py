"""The chain of wrappers between an agent and the simulator: what it changes, and what is unknown.

This is the only place that looks into wrappers. Those of Gymnasium and Stable-Baselines3 are known
by name. Any other that touches observations or actions is tried: a copy of the environment flies
for a while, and what enters and leaves the copy is compared with what the simulator in it gets and
gives. A copy is only possible of an environment of this package that lives in this process.
"""

import copy
import random
import warnings
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

import gymnasium
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecEnv,
    VecEnvWrapper,
    VecNormalize,
    VecTransposeImage,
)

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.plugins import FLIGHT_SETTINGS
from sb3_quad.base.types import AnyArray, Float32Array

WRAPPERS = "wrappers"
"""The attribute by which a model's zips say behind which wrappers it was trained: those that change
what it sees or does. A zip without it does not say.
"""
# What a wrapper changes, by a letter. Rewards, the length of episodes and pictures are no matter.
WORDS = {
    "o": "observations",
    "s": "scale of actions",
    "a": "actions",
    "r": "steps for each action",
    "?": "unknown",
}
_NAMES = {
    "": "Wrapper VecEnvWrapper RewardWrapper OrderEnforcing PassiveEnvChecker TimeLimit Autoreset"
    " RecordEpisodeStatistics RecordVideo HumanRendering RenderCollection AddWhiteNoise"
    " ObstructView ClipReward NormalizeReward TransformReward Monitor VecMonitor VecCheckNan"
    " VecVideoRecorder VecNormalize ClipRewardEnv",
    "o": "ObservationWrapper TransformObservation FilterObservation FlattenObservation"
    " GrayscaleObservation ReshapeObservation RescaleObservation DtypeObservation"
    " ResizeObservation NormalizeObservation TimeAwareObservation FrameStackObservation"
    " DelayObservation DiscretizeObservation AddRenderObservation VecExtractDictObs VecFrameStack"
    " WarpFrame",
    "s": "RescaleAction",
    "a": "ClipAction StickyAction StickyActionEnv DiscretizeAction",
    "r": "RepeatAction",
    "or": "MaxAndSkipObservation MaxAndSkipEnv AtariPreprocessing",
}
_KNOWN = {name: changes for changes, names in _NAMES.items() for name in names.split()}
_MAKERS = ("gymnasium", "stable_baselines3")
# A wrapper that has its own version of one of these does something that its base does not.
_METHODS = {"step", "reset", "step_async", "step_wait", "action", "observation"}
# The only one of them that a subclass of these is meant to have.
_MEANT = {"ObservationWrapper": {"observation"}, "ActionWrapper": {"action"}}
# The mark of a VecTransposeImage that SB3 has added by itself.
TURNED = "turned_by_sb3"
# Control steps of a trial, and the rows that it flies in all of them together.
N_STEPS = 200
_ROWS_OF_BODIES = 800


@dataclass(frozen=True)
class Chain:
    """The wrappers that change what an agent sees or does, or may change it.

    :ivar links: the letters of what a wrapper changes (``WORDS``), by its name, from the outermost
        inwards. VecNormalize is not among them: a model has its statistics. Nor is
        VecTransposeImage, which SB3 adds to environments of pictures.
    :ivar outside: the wrappers around a VecNormalize that change observations, or may change them.
    :ivar names: all wrappers.
    """

    links: dict[str, str]
    outside: tuple[str, ...] = ()
    names: frozenset[str] = frozenset()

    @property
    def changes(self) -> str:
        """The letters of all wrappers."""
        return "".join(self.links.values())

    @property
    def record(self) -> list[str]:
        """Each wrapper with what it changes, as zips hold it."""
        return [
            f"{name} ({', '.join(WORDS[letter] for letter in letters)})"
            for name, letters in self.links.items()
        ]

    def __str__(self) -> str:
        return ", ".join(self.record)

    def refuse_inner_statistics(self) -> None:
        """:raises ConfigError: a wrapper around VecNormalize that may change observations."""
        if self.outside:
            raise ConfigError(
                f"{', '.join(self.outside)}: is around VecNormalize, by which raw observations are"
                " normalised without it; make VecNormalize the outermost wrapper"
            )


def limits_of(space: spaces.Box) -> Float32Array:
    """Return the lower and the upper limits of actions, (2, action_dim)."""
    return np.stack([space.low.ravel(), space.high.ravel()]).astype(np.float32)


_described: "WeakKeyDictionary[VecEnv, Chain]" = WeakKeyDictionary()


def describe(env: VecEnv) -> Chain:
    """Return what lies between an environment and its simulator.

    Where a wrapper is not known and no copy can be flown, it stays unknown.
    """
    if env not in _described:
        _described[env] = _describe(env)
    return _described[env]


def _describe(env: VecEnv) -> Chain:
    outer, inner = _around_statistics(env)
    links = {type(wrapper).__name__: _changes(wrapper) for wrapper in outer} | _links(inner)
    outside = [type(wrapper).__name__ for wrapper in outer if {*_changes(wrapper)} & {*"o?"}]
    if "?" in links.values() and not outer:
        known = {*"".join(links.values())}
        found = try_out(env, at_random)
        for name, letters in links.items():
            # Whether it changes what others change as well cannot be told.
            if letters == "?" and found is not None and not known & {*"oar"}:
                links[name] = "".join(sorted(found[0] - known))
    changing = {name: letters for name, letters in links.items() if letters}
    return Chain(changing, tuple(outside), frozenset(links))


def _around_statistics(env: VecEnv) -> tuple[list[VecEnvWrapper], VecEnv]:
    """Return the wrappers around VecNormalize and what it wraps; without it, none and ``env``.

    Pictures are transposed outside of it.
    """
    outer: list[VecEnvWrapper] = []
    at: Any = env
    while isinstance(at, VecEnvWrapper):
        if isinstance(at, VecNormalize) and at.norm_obs:
            return [wrapper for wrapper in outer if _changes(wrapper)], at.venv
        outer.append(at)
        at = at.venv
    return [], env


def _links(env: VecEnv) -> dict[str, str]:
    """Return what each wrapper changes, by its name."""
    links = {}
    at: Any = env
    while isinstance(at, VecEnvWrapper):
        links[type(at).__name__] = _changes(at)
        at = at.venv
    for row in getattr(at, "envs", ()):
        while isinstance(row, gymnasium.Wrapper):
            links[type(row).__name__] = _changes(row)
            row = row.env
    if isinstance(at, SubprocVecEnv):
        # "<Outer<Inner<Env<id>>>>", or "<Outer<Inner<Env instance>>>"
        names = at.env_method("__str__", indices=[0])[0].strip("<>").split("<")
        for name in names[: -1 if names[-1].endswith(" instance") else -2]:
            links[name] = _KNOWN.get(name, "?")
    return links


def _changes(wrapper: Any) -> str:
    """Return the letters of what a wrapper changes."""
    if isinstance(wrapper, VecTransposeImage):
        return ""
    own: set[str] = set()
    for kind in type(wrapper).__mro__:
        maker = kind.__module__.partition(".")[0]
        if maker == "sb3_quad":
            return ""
        if maker in _MAKERS:
            own -= _MEANT.get(kind.__name__, set())
            return "?" if own else _KNOWN.get(kind.__name__, "?")
        own |= _METHODS & vars(kind).keys()
    return "?"


def chain_of(model: Any) -> list[str] | None:
    """Return the record of the wrappers that a model was trained behind; None: it does not say."""
    env = model.get_env() if isinstance(model, BaseAlgorithm) else None
    if env is not None:
        return describe(env).record
    if hasattr(model, WRAPPERS):
        return read_record(getattr(model, WRAPPERS))
    return [] if hasattr(model, FLIGHT_SETTINGS) else None


def read_record(record: Any) -> list[str]:
    """Return the record in a zip, which may be a stranger's."""
    texts = [*map(str, record if isinstance(record, list) else [record])]
    return [text if text.isprintable() else WORDS["?"] for text in texts]


def note_chain(model: Any, env: VecEnv | None) -> Any:
    """Let a model's zips say behind which wrappers it is trained.

    :return: how ``env`` says that it flies; None if it does not say it, or if that would not
        describe its agents, because wrappers change what they see or do.
    """
    if env is None:
        return None
    chain = describe(env)
    setattr(model, WRAPPERS, chain.record)
    if chain.links or not env.has_attr(FLIGHT_SETTINGS):
        return None
    return env.get_attr(FLIGHT_SETTINGS, [0])[0]


def refuse_wrapped(name: str, model: Any, here: list[str]) -> None:
    """Check that an agent flies behind the wrappers that it was trained behind.

    :param name: what the message calls it.
    :param model: its model, or the record in its zip.
    :param here: the record of where it is to fly.
    :raises ConfigError: it was trained behind other wrappers, one of which it names.
    """
    theirs = model if isinstance(model, list) else chain_of(model)
    if theirs and theirs != here:
        raise ConfigError(
            f"{name}: was trained with wrappers that change what it sees or does, or may do so"
            f" ({', '.join(theirs)}), without which it flies otherwise; use it in an environment"
            " that has them, such as by evaluate_policy, or train without them"
        )


def refuse_other_wrappers(model: Any, env: VecEnv) -> None:
    """Check that a model is evaluated behind the wrappers that it learns behind.

    :raises ConfigError: one side has a wrapper that changes something, and the other has not.
    """
    ours, theirs = describe(model.get_env()), describe(env)
    for has, lacks, where in ((ours, theirs, "evaluation"), (theirs, ours, "training")):
        missing = has.links.keys() - lacks.names
        if missing:
            raise ConfigError(
                f"{', '.join(sorted(missing))}: the environment of the {where} lacks this wrapper,"
                " which changes what an agent sees or does"
            )


# A trial


class _Vectorised(VecEnvWrapper):
    """Notes what reaches the batch, and what leaves it."""

    def __init__(self, venv: VecEnv) -> None:
        super().__init__(venv)
        self.heard: list[AnyArray] = []
        self.rewards: list[float] = []

    def reset(self) -> Any:
        observation: Any = self.venv.reset()
        self.seen = observation.copy()
        return observation

    def step_async(self, actions: AnyArray) -> None:
        self.heard.append(np.array(actions))
        self.venv.step_async(actions)

    def step_wait(self) -> Any:
        results: Any = self.venv.step_wait()
        self.seen = results[0].copy()
        self.rewards.append(float(results[1].mean()))
        return results


class _Single(gymnasium.Wrapper[Any, Any, Any, Any]):
    """The same for a row."""

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        self.heard: list[AnyArray] = []
        self.rewards: list[float] = []

    def reset(self, **keywords: Any) -> Any:
        results = self.env.reset(**keywords)
        self.seen = np.array(results[0])
        return results

    def step(self, action: Any) -> Any:
        self.heard.append(np.array(action))
        results = self.env.step(action)
        self.seen = np.array(results[0])
        self.rewards.append(float(results[1]))
        return results


class Trial:
    """A copy of an environment below its VecNormalize, to be flown in its place.

    :ivar env: the copy. It has the wrappers that may change something, unless ``bare``.
    """

    def __init__(self, env: VecEnv, bare: bool = False) -> None:
        self._memo: dict[int, Any] = {}
        self._bare = bare
        _, at = _around_statistics(env)
        wrappers = []
        while isinstance(at, VecEnvWrapper):
            wrappers.append(at)
            at = at.venv
        self.taps: list[Any]
        if isinstance(at, DummyVecEnv):
            rows = [self._row(row) for row in at.envs]
            made: VecEnv = DummyVecEnv([lambda row=row: row for row in rows])  # type: ignore[misc]
        else:
            made = _Vectorised(copy.deepcopy(at))
            self.taps = [made]
        self.n_steps = N_STEPS
        if isinstance(at, DummyVecEnv):
            self.taps = [self._memo[id(row.unwrapped)] for row in at.envs]
            self.n_steps = min(max(_ROWS_OF_BODIES // at.num_envs, 50), N_STEPS)
        self._memo[id(at)] = made
        for wrapper in reversed(wrappers):
            made = self._put(wrapper, wrapper.venv, made)
        self.env = made

    def _row(self, row: Any) -> Any:
        """Return a copy of a row's environment."""
        if isinstance(row, gymnasium.Wrapper):
            return self._put(row, row.env, self._row(row.env))
        self._memo[id(row)] = _Single(copy.deepcopy(row))
        return self._memo[id(row)]

    def _put(self, wrapper: Any, below: Any, made: Any) -> Any:
        """Return a copy of a wrapper around the copy of what it wraps, or the latter alone if the
        wrapper changes nothing.
        """
        self._memo[id(below)] = made
        if self._bare or not _changes(wrapper):
            return made
        # SB3's wrappers cannot be copied as a whole, nor what they note of their class.
        twin = object.__new__(type(wrapper))
        self._memo[id(wrapper)] = twin
        for name, value in vars(wrapper).items():
            is_of_class = name == "class_attributes"
            vars(twin)[name] = value if is_of_class else copy.deepcopy(value, self._memo)
        return twin

    def fly(self, act: Callable[[Any], AnyArray]) -> set[str]:
        """Fly, and return the letters of what the wrappers change.

        :param act: returns the actions for observations.
        """
        inner: Any = self.taps[0].action_space
        outer: Any = self.env.action_space
        low, high = limits_of(outer)
        least, most = limits_of(inner)
        found: set[str] = set() if np.array_equal((low, high), (least, most)) else {"s"}
        is_batch = isinstance(self.taps[0], _Vectorised)
        observation: Any = self.env.reset()
        for _ in range(self.n_steps):
            actions = np.asarray(act(observation))
            flat = actions.reshape(self.env.num_envs, -1)
            expected = least + (flat - low) / (high - low) * (most - least)
            for tap in self.taps:
                tap.heard.clear()
            observation = self.env.step(actions)[0]
            rows = zip(
                self.taps,
                [expected] if is_batch else expected,
                [observation] if is_batch else observation,
                strict=True,
            )
            for tap, wanted, shown in rows:
                found |= _differences(tap, wanted, shown, inner)
        return found

    def reward(self) -> float:
        """Return the mean sum of the simulator's rewards in the steps of a trial."""
        return float(np.mean([sum(tap.rewards[: self.n_steps]) for tap in self.taps]))


def _differences(tap: Any, wanted: AnyArray, shown: Any, space: spaces.Box) -> set[str]:
    """Return the letters of what differs between both ends of the chain in a step."""
    found: set[str] = set()
    if len(tap.heard) != 1:
        found.add("r")
    for actions in tap.heard:
        reached = actions.reshape(wanted.shape) if actions.size == wanted.size else np.nan
        reached = np.clip(reached, space.low.flat[0], space.high.flat[0])
        if not np.allclose(reached, wanted, atol=1e-4):
            found.add("a")
    if not np.array_equal(tap.seen, shown):
        found.add("o")
    return found


def try_out(
    env: VecEnv, pilot: Callable[[VecEnv], Callable[[Any], AnyArray]], bare: bool = False
) -> tuple[set[str], float] | None:
    """Fly a copy of an environment, which stays as it is, like all random numbers.

    :param pilot: returns what acts in the copy.
    :param bare: without its wrappers.
    :return: the letters of what the wrappers change, and the return in the simulator's rewards.
        None: no copy can be made, or it fails.
    """
    at: Any = env.unwrapped
    if isinstance(at, SubprocVecEnv) or not at.has_attr(FLIGHT_SETTINGS):
        return None
    if "human" in at.get_attr("render_mode"):
        return None
    # A user's wrapper may raise anything.
    with untouched(), suppress(Exception):
        trial = Trial(env, bare)
        with closing(trial.env):
            found = trial.fly(pilot(trial.env))
        return found, trial.reward()
    return None


def at_random(env: VecEnv) -> Callable[[Any], AnyArray]:
    """Return a pilot of random actions."""
    space: Any = env.action_space
    shape = (env.num_envs, *space.shape)
    rng = np.random.default_rng(0)
    return lambda observation: rng.uniform(space.low, space.high, shape).astype(space.dtype)


@contextmanager
def untouched() -> Iterator[None]:
    """Leave the global random numbers as they are, and warn of nothing."""
    kept = np.random.get_state(), random.getstate()  # noqa: NPY002
    with th.random.fork_rng(devices=[]), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            yield
        finally:
            np.random.set_state(kept[0])  # noqa: NPY002
            random.setstate(kept[1])
