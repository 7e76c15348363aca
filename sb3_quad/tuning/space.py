"""The settings that a search varies, with the values that each may have, from YAML; docs/tune.md
lists them.

Keys are those of the settings. ``policy_kwargs.net_arch`` is an entry of a mapping, and
``n_minibatches`` stands for the ``batch_size`` that divides a rollout into so many. Where the
settings have ``lin_x``, the x is varied. A setting for which only whole numbers are valid gets
whole numbers, others get four significant digits.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
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
from sb3_quad.base.types import StrDict, StrMapping, StrPath
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
    """A number around that of the settings, at most so many times as large or small."""

    around: float = Field(gt=1)


@dataclass(frozen=True)
class SearchSpace:
    """The settings that are varied, by name, and those that stay.

    :param algo: the algorithm whose settings these are.
    :param base: all settings, as a search starts from them.
    :param dimensions: the distributions that Optuna samples from. Values of lists that are not
        plain ones are there as JSON.
    """

    algo: str
    base: StrMapping
    dimensions: Mapping[str, BaseDistribution]

    def settings(self, parameters: StrMapping) -> StrDict:
        """Return all settings of a trial with these parameters, as YAML holds them."""
        changed = dict(self.base)
        for name, parameter in parameters.items():
            outer, dot, inner = name.partition(".")
            value = self._setting(name, parameter)
            if dot:
                value = {**_plain(changed.get(outer)), inner: value}
            changed[outer] = value
        if MINIBATCHES in changed:
            # All of the same size, but for the last, which may be smaller.
            count = changed.pop(MINIBATCHES)
            changed["batch_size"] = math.ceil(_rollout(self.algo, changed) / count)
        return changed

    def start(self) -> StrDict | None:
        """Return the parameters that stand for the settings as they are; None if one of these lies
        outside the space.
        """
        start: StrDict = {}
        for name, dimension in self.dimensions.items():
            # A list must hold the value, a range must include it.
            value = current(self.algo, self.base, name)
            if isinstance(dimension, CategoricalDistribution):
                start[name] = _label(value)
                if start[name] not in dimension.choices:
                    return None
                continue
            number = _number_of(value)
            if number is None or not dimension.low <= number <= dimension.high:  # type: ignore[attr-defined]
                return None
            start[name] = int(number) if isinstance(dimension, IntDistribution) else float(number)
        return start

    def _setting(self, name: str, parameter: Any) -> Any:
        """Return the value that a parameter stands for."""
        dimension = self.dimensions[name]
        if isinstance(dimension, CategoricalDistribution):
            if isinstance(parameter, str) and parameter[:1] in ("[", "{"):
                return json.loads(parameter)
            return parameter
        if not isinstance(dimension, FloatDistribution):
            return parameter
        # Four digits, but not beyond a bound.
        rounded = min(max(float(f"{parameter:.4g}"), dimension.low), dimension.high)
        present = current(self.algo, self.base, name)
        if isinstance(present, str) and present.startswith(LINEAR):
            return f"{LINEAR}{rounded:.4g}"
        return float(f"{rounded:.4g}")


def load_space(algo: str, settings: StrMapping, source: StrPath | None = None) -> SearchSpace:
    """Load the space of a search around some settings.

    :param source: a YAML file; None: the package's own for the algorithm.
    :raises ConfigError: an unreadable file, an unknown setting, bounds that are not any.
    """
    content, where = SPACES.read(source or algo)
    if not content:
        raise ConfigError(
            f"{where}: must hold settings with their ranges, such as 'learning_rate: {{around: 5}}'"
        )
    # The algorithm's arguments and the training's own settings may vary.
    parameters = constructor_parameters(get_algorithm(algo))
    valid = [*parameters, *JOB_SETTINGS]
    if {"n_steps", "batch_size"} <= parameters.keys() and not is_off_policy(get_algorithm(algo)):
        valid.append(MINIBATCHES)
    # Of mappings, any entry may vary.
    for name in content:
        outer, _, inner = str(name).partition(".")
        if name not in valid and not (inner and outer in MAPPINGS):
            raise ConfigError(f"{where}: {unknown(f'setting of {algo}', name, valid)}")
    if MINIBATCHES in content and "batch_size" in content:
        raise ConfigError(f"{where}: {MINIBATCHES} sets batch_size; remove one of them")
    dimensions = {
        name: _dimension(algo, settings, name, values, f"{where}: {name}")
        for name, values in content.items()
    }
    return SearchSpace(algo, settings, dimensions)


def current(algo: str, settings: StrMapping, name: str) -> Any:
    """Return the value that some settings have under a name of a search space, or else the
    algorithm's default.
    """
    outer, dot, inner = name.partition(".")
    # An entry of a mapping, such as policy_kwargs.net_arch.
    if dot:
        return _plain(settings.get(outer)).get(inner)
    if name == MINIBATCHES:
        batch_size = _number_of(current(algo, settings, "batch_size")) or 1
        return round(_rollout(algo, settings) / batch_size)
    if name in settings:
        return settings[name]
    parameter = constructor_parameters(get_algorithm(algo)).get(name)
    if parameter is None:
        return 1 if name == "n_envs" else None
    return parameter.default


def _dimension(
    algo: str, settings: StrMapping, name: str, values: Any, where: str
) -> BaseDistribution:
    if isinstance(values, list) and values:
        return CategoricalDistribution([_label(value) for value in values])
    if not isinstance(values, dict):
        raise ConfigError(
            f"{where}: {values!r} must be {{low: …, high: …}}, {{around: …}} or a list of values"
        )
    parameter = constructor_parameters(get_algorithm(algo)).get(name)
    whole = name in (MINIBATCHES, "n_envs") or (parameter is not None and takes_whole(parameter))
    # Both kinds of ranges become bounds; whole numbers get whole bounds.
    if "around" in values:
        bounds = _around(current(algo, settings, name), values, whole, where)
    else:
        bounds = validate(Interval, values, where)
    try:
        if not (whole or bounds.whole):
            return FloatDistribution(bounds.low, bounds.high, bounds.log)
        if bounds.low.is_integer() and bounds.high.is_integer():
            return IntDistribution(int(bounds.low), int(bounds.high), bounds.log)
    except ValueError as error:
        raise ConfigError(f"{where}: {error}") from None
    raise ConfigError(f"{where}: low {bounds.low:g} and high {bounds.high:g} must be whole numbers")


def _around(value: Any, factor: Any, whole: bool, where: str) -> Interval:
    """Return the interval of ``around``, from the setting's present value."""
    around = validate(Factor, factor, where).around
    middle = _number_of(value)
    if middle is None or middle <= 0:
        raise ConfigError(
            f"{where}: around needs a number above 0 in the settings, not {value!r}; "
            "give low and high"
        )
    if whole:
        low = max(1, math.floor(middle / around))
        return Interval(low=low, high=math.ceil(middle * around), log=True)
    return Interval(low=middle / around, high=middle * around, log=True)


def _rollout(algo: str, settings: StrMapping) -> float:
    """Return the timesteps of a rollout of all environments."""
    factors = [_number_of(current(algo, settings, name)) or 1 for name in ("n_steps", "n_envs")]
    return math.prod(factors)


def _plain(value: Any) -> StrDict:
    """Return a mapping of the settings with its values as written, also one like ``dict(…)``."""
    if isinstance(value, str):
        value = parse_value(value)
    return dict(value) if isinstance(value, dict) else {}


def _label(value: Any) -> Any:
    """Return a value of a list as Optuna holds it: a plain one as it is, others as JSON."""
    if isinstance(value, (bool, int, float, str, type(None))):
        return value
    return json.dumps(value)


def _number_of(value: Any) -> float | None:
    """Return a number, also that of ``lin_x``; None for anything else."""
    if isinstance(value, str):
        value = value.removeprefix(LINEAR)
    number = parse_number(value)
    if isinstance(number, bool) or not isinstance(number, (int, float)):
        return None
    return number
