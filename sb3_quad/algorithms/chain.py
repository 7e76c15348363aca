"""The chain of wrappers between an agent and the simulator: what it changes, and what is unknown.

This is the only place that looks into wrappers. Those of Gymnasium, Stable-Baselines3, its contrib
and rl_zoo3 are known by name. Any other that touches observations or actions may change both,
unless its class says what it changes by an attribute ``changes``, such as ``changes = ""`` for a
reward of your own.
"""

import copy
import re
from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

import gymnasium
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import (
    SubprocVecEnv,
    VecEnv,
    VecEnvWrapper,
    VecNormalize,
    unwrap_vec_normalize,
)

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.plugins import FLIGHT_SETTINGS
from sb3_quad.base.types import Float32Array

WRAPPERS = "wrappers"
"""The attribute by which a model's zips say behind which wrappers it was trained: those that change
what it sees or does, or may do so. A zip without it does not say.
"""
# What a wrapper changes, by letters: observations; actions; or, as labels allow for, the scale of
# actions or how often each is repeated. Nothing else matters to an agent in flight.
_NAMES = {
    "": "Wrapper VecEnvWrapper RewardWrapper OrderEnforcing PassiveEnvChecker TimeLimit Autoreset"
    " RecordEpisodeStatistics RecordVideo HumanRendering RenderCollection AddWhiteNoise"
    " ObstructView ClipReward NormalizeReward TransformReward Monitor VecMonitor VecCheckNan"
    " VecVideoRecorder VecNormalize VecTransposeImage ClipRewardEnv PatchedTimeLimit"
    " TruncatedOnSuccessWrapper DelayedRewardWrapper",
    "o": "ObservationWrapper TransformObservation FilterObservation FlattenObservation"
    " GrayscaleObservation ReshapeObservation RescaleObservation DtypeObservation"
    " ResizeObservation NormalizeObservation TimeAwareObservation FrameStackObservation"
    " DelayObservation DiscretizeObservation AddRenderObservation VecExtractDictObs VecFrameStack"
    " WarpFrame TimeFeatureWrapper HistoryWrapper HistoryWrapperObsDict MaskVelocityWrapper"
    " YAMLCompatResizeObservation",
    "s": "RescaleAction RepeatAction FrameSkip",
    "a": "ClipAction StickyAction StickyActionEnv DiscretizeAction ActionNoiseWrapper"
    " ActionSmoothingWrapper",
    "os": "MaxAndSkipObservation MaxAndSkipEnv AtariPreprocessing",
}
_KNOWN = {name: letters for letters, names in _NAMES.items() for name in names.split()}
# A wrapper that is not known, and does not say, may do both.
_ANY = "oa"
_MAKERS = ("gymnasium", "stable_baselines3", "sb3_contrib", "rl_zoo3")
# A wrapper that has its own version of one of these does something that its base does not.
_METHODS = {"step", "reset", "step_async", "step_wait"}


@dataclass(frozen=True)
class Chain:
    """The wrappers between an agent and the simulator.

    :ivar links: what each wrapper changes, by its name, from the outermost inwards: "o" for
        observations, "a" for actions, "s" for their scale or repetition, "oa" if unknown.
    :ivar outside: the wrappers around a VecNormalize that change something, or may do so.
    """

    links: dict[str, str]
    outside: tuple[str, ...] = ()

    @property
    def changes(self) -> set[str]:
        """The letters of all wrappers."""
        return {*"".join(self.links.values())}

    @property
    def record(self) -> list[str]:
        """The names of the wrappers that change something, or may do so, as zips hold them."""
        return [name for name, letters in self.links.items() if letters]

    def refuse_inner_statistics(self) -> None:
        """:raises ConfigError: a wrapper around VecNormalize that may change something."""
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
    """Return what lies between an environment and its simulator."""
    if env not in _described:
        _described[env] = _describe(env)
    return _described[env]


def _describe(env: VecEnv) -> Chain:
    links: dict[str, str] = {}
    outside: list[str] = []
    at: Any = env
    while isinstance(at, VecEnvWrapper):
        if isinstance(at, VecNormalize) and at.norm_obs:
            outside = [name for name, letters in links.items() if letters]
        links[type(at).__name__] = _changes(at)
        at = at.venv
    for row in getattr(at, "envs", ()):
        while isinstance(row, gymnasium.Wrapper):
            links[type(row).__name__] = _changes(row)
            row = row.env
    if isinstance(at, SubprocVecEnv):
        # "<Outer<Inner<Env<id>>>>", or "<Outer<Inner<Env instance>>>"
        text = at.env_method("__str__", indices=[0])[0]
        links |= {name: _KNOWN.get(name, _ANY) for name in re.findall(r"(\w+)(?=<\w+[< ])", text)}
    return Chain(links, tuple(outside))


def _changes(wrapper: Any) -> str:
    """Return the letters for a wrapper."""
    declared = getattr(type(wrapper), "changes", None)
    if declared is not None:
        return str(declared)
    for kind in type(wrapper).__mro__:
        maker = kind.__module__.partition(".")[0]
        if maker == "sb3_quad":
            return ""
        if maker in _MAKERS:
            return _KNOWN.get(kind.__name__, _ANY)
        if _METHODS & vars(kind).keys():
            break
    return _ANY


def chain_of(model: Any) -> Any:
    """Return the record of the wrappers that a model was trained behind; None: it does not say.

    A stranger's may be anything.
    """
    env = model.get_env() if isinstance(model, BaseAlgorithm) else None
    if env is not None:
        return describe(env).record
    return getattr(model, WRAPPERS, [] if hasattr(model, FLIGHT_SETTINGS) else None)


def note_chain(model: Any, env: VecEnv | None) -> Any:
    """Let a model's zips say behind which wrappers it is trained.

    :return: how ``env`` says that it flies; None if it does not say it, or if that would not
        describe its agents, because wrappers change what they see or do.
    """
    if env is None:
        return None
    record = describe(env).record
    setattr(model, WRAPPERS, record)
    if record or not env.has_attr(FLIGHT_SETTINGS):
        return None
    return env.get_attr(FLIGHT_SETTINGS, [0])[0]


def refuse_wrapped(name: str, record: Any, here: list[str]) -> None:
    """Check that an agent flies behind the wrappers that it was trained behind.

    :param name: what the message calls it.
    :param record: that of its model or zip.
    :param here: that of where it is to fly.
    :raises ConfigError: it was trained behind others, and the message names them.
    """
    if record and record != here:
        raise ConfigError(
            f"{name}: was trained with wrappers that change what it sees or does, or may do so"
            f" ({record!r}), without which it flies otherwise; use it in an environment"
            " that has them, such as by evaluate_policy, or train without them; if a wrapper of"
            ' yours changes neither, let its class say so by changes = ""'
        )


def refuse_other_wrappers(model: Any, env: VecEnv) -> None:
    """Check that a model is evaluated behind the wrappers that it learns behind.

    :raises ConfigError: one side has a wrapper that changes something, and the other has not.
    """
    ours, theirs = describe(model.get_env()), describe(env)
    missing = {*ours.record, *theirs.record} - (ours.links.keys() & theirs.links.keys())
    if missing:
        raise ConfigError(
            f"{', '.join(sorted(missing))}: only one of the environments of training and evaluation"
            " has this wrapper, which changes what an agent sees or does"
        )


# Statistics

# The attribute of a model. It is the wrapper itself, which pickles its statistics, so that every
# zip of the model contains the current ones.
STATISTICS = "vec_normalize"


def statistics_of(model: Any) -> Any:
    """Return the VecNormalize whose observations a model was trained with; None: raw ones.

    :param model: an SB3 model, or any other controller, which has none.
    """
    statistics = getattr(model, "_vec_normalize_env", None) or getattr(model, STATISTICS, None)
    return statistics if getattr(statistics, "norm_obs", False) else None


def share_statistics(statistics: Any, env: Any, training: bool = False) -> None:
    """Let an environment normalise by the statistics of another VecNormalize.

    :param statistics: the other VecNormalize, or None.
    :param env: a VecEnv, or None.
    :param training: whether they continue to learn there; otherwise rewards stay raw, too, as in
        the environments of SB3's EvalCallback.
    :raises ConfigError: only one of the two normalises observations.
    """
    own = unwrap_vec_normalize(env)
    if getattr(statistics, "norm_obs", False) != getattr(own, "norm_obs", False):
        raise ConfigError(
            "VecNormalize: the agent and its environment must both have it, or neither "
            "(settings: normalize: true)"
        )
    if own is None:
        return
    for name in ("obs_rms", "ret_rms", "clip_obs", "epsilon"):
        if hasattr(statistics, name):
            setattr(own, name, copy.deepcopy(getattr(statistics, name)))
    if not training:
        own.training = False
        own.norm_reward = False
