"""What a search varies, from YAML: settings and the values that each may have, as docs/tune.md
lists them.

Keys are those of the settings. ``policy_kwargs.net_arch`` is an entry of a mapping, and
``n_minibatches`` stands for the ``batch_size`` that divides a rollout into so many. Where the
settings have ``lin_x``, the x is varied. Settings of which only whole numbers are known to fit get
whole numbers, others four significant digits.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from optuna.distributions import (
    BaseDistribution,
    CategoricalDistribution,
    FloatDistribution,
    IntDistribution,
)
from pydantic import Field

from sb3_quad.base.errors import ConfigError, unknown
from sb3_quad.base.literals import parse_number, parse_value
from sb3_quad.base.validate import Frozen, validate
from sb3_quad.base.yaml_files import YamlFolder
from sb3_quad.training.algorithms import (
    constructor_parameters,
    get_algorithm,
    is_off_policy,
    takes_whole,
)

SPACES = YamlFolder("search space", "sb3_quad.zoo_configs.search_spaces", ".yml")
MINIBATCHES = "n_minibatches"
MAPPINGS = ("policy_kwargs", "env_kwargs")
JOB_SETTINGS = ("n_envs", "expert")
LINEAR = "lin_"


class Interval(Frozen):
    """A number between two others; ``whole``: a whole one also where the setting need not be."""

    low: float
    high: float
    log: bool = False
    whole: bool = False


class Factor(Frozen):
    """A number around the one that the settings have, at most so many times as great or small."""

    around: float = Field(gt=1)


@dataclass(frozen=True)
class SearchSpace:
    """The settings that are varied, by name, beside those that stay.

    :param algo: the algorithm whose settings these are.
    :param base: all settings, as a search starts from them.
    :param dimensions: what Optuna samples from. Values of lists that are no plain ones are there as
        JSON.
    """

    algo: str
    base: Mapping[str, Any]
    dimensions: Mapping[str, BaseDistribution]

    def settings(self, parameters: Mapping[str, Any]) -> dict[str, Any]:
        """All settings of a trial with these parameters: plain values, as YAML holds them."""
        changed = dict(self.base)
        for name, parameter in parameters.items():
            outer, dot, inner = name.partition(".")
            value = self._setting(name, parameter)
            changed[outer] = {**_plain(changed.get(outer)), inner: value} if dot else value
        if MINIBATCHES in changed:  # of the same size, but for the last, which may be smaller
            changed["batch_size"] = math.ceil(
                _rollout(self.algo, changed) / changed.pop(MINIBATCHES)
            )
        return changed

    def start(self) -> dict[str, Any] | None:
        """The parameters that stand for the settings as they are; None if one of these lies outside
        the space.
        """
        found: dict[str, Any] = {}
        for name, each in self.dimensions.items():
            value = current(self.algo, self.base, name)
            if isinstance(each, CategoricalDistribution):
                found[name], inside = _label(value), _label(value) in each.choices
            else:
                number, whole = _number_of(value), isinstance(each, IntDistribution)
                inside = number is not None and each.low <= number <= each.high  # type: ignore[attr-defined]
                found[name] = number if number is None else int(number) if whole else float(number)
            if not inside:
                return None
        return found

    def _setting(self, name: str, parameter: Any) -> Any:
        """The value that a parameter stands for."""
        dimension = self.dimensions[name]
        if isinstance(dimension, CategoricalDistribution):
            return (
                json.loads(parameter)
                if isinstance(parameter, str) and parameter[:1] in ("[", "{")
                else parameter
            )
        if not isinstance(dimension, FloatDistribution):
            return parameter
        written = f"{min(max(float(f'{parameter:.4g}'), dimension.low), dimension.high):.4g}"
        present = current(self.algo, self.base, name)
        return (
            f"{LINEAR}{written}"
            if isinstance(present, str) and present.startswith(LINEAR)
            else float(written)
        )


def load_space(
    algo: str, settings: Mapping[str, Any], source: str | Path | None = None
) -> SearchSpace:
    """What a search varies around some settings.

    :param source: a YAML file; None: the package's own for the algorithm.
    :raises ConfigError: an unreadable file, a setting that is none, bounds that are none.
    """
    content, where = SPACES.read(source or algo)
    if not content:
        raise ConfigError(
            f"{where}: must hold settings with their ranges, such as 'learning_rate: {{around: 5}}'"
        )
    parameters = constructor_parameters(get_algorithm(algo))
    on_policy = {"n_steps", "batch_size"} <= parameters.keys() and not is_off_policy(
        get_algorithm(algo)
    )
    valid = [*parameters, *JOB_SETTINGS, *([MINIBATCHES] if on_policy else [])]
    for name in content:
        outer, dot, inner = str(name).partition(".")
        if not (name in valid or (dot and inner and outer in MAPPINGS)):
            raise ConfigError(f"{where}: {unknown(f'setting of {algo}', name, valid)}")
    if MINIBATCHES in content and "batch_size" in content:
        raise ConfigError(f"{where}: {MINIBATCHES} says what batch_size is; leave one of them away")
    dimensions = {
        name: _dimension(algo, settings, name, given, f"{where}: {name}")
        for name, given in content.items()
    }
    return SearchSpace(algo, settings, dimensions)


def current(algo: str, settings: Mapping[str, Any], name: str) -> Any:
    """What some settings have under a name of a search space: theirs, or else the algorithm's
    default.
    """
    outer, dot, inner = name.partition(".")
    if dot:
        return _plain(settings.get(outer)).get(inner)
    if name == MINIBATCHES:
        return round(
            _rollout(algo, settings) / (_number_of(current(algo, settings, "batch_size")) or 1)
        )
    parameters = constructor_parameters(get_algorithm(algo))
    default = {"n_envs": 1, **{key: each.default for key, each in parameters.items()}}
    return settings.get(name, default.get(name))


def _dimension(
    algo: str, settings: Mapping[str, Any], name: str, given: Any, where: str
) -> BaseDistribution:
    if isinstance(given, list) and given:
        return CategoricalDistribution([_label(value) for value in given])
    if not isinstance(given, dict):
        raise ConfigError(
            f"{where}: {given!r} must be {{low: …, high: …}}, {{around: …}} or a list of values"
        )
    value = current(algo, settings, name)
    parameter = constructor_parameters(get_algorithm(algo)).get(name)
    whole = name in (MINIBATCHES, "n_envs") or (parameter is not None and takes_whole(parameter))
    if "around" in given:
        factor, middle = validate(Factor, given, where).around, _number_of(value)
        if middle is None or middle <= 0:
            raise ConfigError(
                f"{where}: around needs a number above 0 in the settings, not {value!r}; give low and high"
            )
        bounds = Interval(low=middle / factor, high=middle * factor, log=True)
        if whole:
            bounds = Interval(
                low=max(1, math.floor(bounds.low)), high=math.ceil(bounds.high), log=True
            )
    else:
        bounds = validate(Interval, given, where)
    whole = whole or bounds.whole
    if whole and not (bounds.low.is_integer() and bounds.high.is_integer()):
        raise ConfigError(
            f"{where}: low {bounds.low:g} and high {bounds.high:g} must be whole numbers"
        )
    try:
        if whole:
            return IntDistribution(int(bounds.low), int(bounds.high), bounds.log)
        return FloatDistribution(bounds.low, bounds.high, bounds.log)
    except ValueError as error:
        raise ConfigError(f"{where}: {error}") from None


def _rollout(algo: str, settings: Mapping[str, Any]) -> float:
    return math.prod(_number_of(current(algo, settings, key)) or 1 for key in ("n_steps", "n_envs"))


def _plain(value: Any) -> dict[str, Any]:
    """A mapping of the settings with its values as they are written, also one written ``dict(…)``."""
    found = parse_value(value) if isinstance(value, str) else value
    return dict(found) if isinstance(found, dict) else {}


def _label(value: Any) -> Any:
    """A value of a list as Optuna holds it: a plain one as it is, others as JSON."""
    return value if isinstance(value, (bool, int, float, str, type(None))) else json.dumps(value)


def _number_of(value: Any) -> float | None:
    """A number, also that of ``lin_x``; None if there is none."""
    number = parse_number(value.removeprefix(LINEAR) if isinstance(value, str) else value)
    return None if isinstance(number, bool) or not isinstance(number, (int, float)) else number
