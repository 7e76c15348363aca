"""The settings that a search varies, with the values that each may have, from YAML; docs/tune.md
lists them.

Keys are those of the settings. ``policy_kwargs.net_arch`` is an entry of a mapping, and
``n_minibatches`` stands for the ``batch_size`` that divides a rollout into so many. Where the
settings have ``lin_x``, the x is varied. A setting for which only whole numbers are valid gets
whole numbers, others get four significant digits.
"""

import json
import math
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
    """A number between two others."""

    low: float
    high: float
    log: bool = False


class WholeInterval(Interval):
    """A whole number between two others."""

    low: int
    high: int


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
    dimensions: dict[str, Any]

    def settings(self, parameters: StrMapping) -> StrDict:
        """Return all settings of a trial with these parameters, as YAML holds them."""
        changed = dict(self.base)
        for name, parameter in parameters.items():
            outer, _, inner = name.partition(".")
            value = self._setting(name, parameter)
            if inner:
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
                value = _label(value)
                inside = value in dimension.choices
            else:
                value = _number_of(value)
                inside = value is not None and dimension.low <= value <= dimension.high
            if not inside:
                return None
            start[name] = value
        return start

    def _setting(self, name: str, parameter: Any) -> Any:
        """Return the value that a parameter stands for."""
        dimension = self.dimensions[name]
        if isinstance(parameter, str) and parameter[:1] in ("[", "{"):
            return json.loads(parameter)
        if not isinstance(dimension, FloatDistribution):
            return parameter
        rounded = f"{parameter:.4g}"
        if str(current(self.algo, self.base, name)).startswith(LINEAR):
            return LINEAR + rounded
        return float(rounded)


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
    dimensions = {}
    for name, values in content.items():
        dimensions[name] = _dimension(algo, settings, name, values, f"{where}: {name}")
    return SearchSpace(algo, settings, dimensions)


def current(algo: str, settings: StrMapping, name: str) -> Any:
    """Return the value that some settings have under a name of a search space, or else the
    algorithm's default.
    """
    outer, _, inner = name.partition(".")
    # An entry of a mapping, such as policy_kwargs.net_arch.
    if inner:
        return _plain(settings.get(outer)).get(inner)
    if name == MINIBATCHES:
        batch_size = _number_of(current(algo, settings, "batch_size")) or 1
        return round(_rollout(algo, settings) / batch_size)
    if name in settings:
        return settings[name]
    # A setting of the training is no parameter: there is one environment by default.
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
    if "around" in values:
        values = _around(current(algo, settings, name), values, whole, where)
    # The fields of an interval are the arguments of Optuna's distributions.
    interval = validate(WholeInterval if whole else Interval, values, where)
    try:
        return (IntDistribution if whole else FloatDistribution)(**dict(interval))
    except ValueError as error:
        raise ConfigError(f"{where}: {error}") from None


def _around(value: Any, factor: Any, whole: bool, where: str) -> StrDict:
    """Return the bounds of ``around``, from the setting's present value."""
    around = validate(Factor, factor, where).around
    middle = _number_of(value)
    if middle is None or middle <= 0:
        raise ConfigError(
            f"{where}: around needs a number above 0 in the settings, not {value!r}; "
            "give low and high"
        )
    low = middle / around
    high = middle * around
    if whole:
        low = max(1, math.floor(low))
        high = math.ceil(high)
    return {"low": low, "high": high, "log": True}


def _rollout(algo: str, settings: StrMapping) -> float:
    """Return the timesteps of a rollout of all environments."""
    n_steps = _number_of(current(algo, settings, "n_steps")) or 1
    return n_steps * (_number_of(current(algo, settings, "n_envs")) or 1)


def _plain(value: Any) -> StrDict:
    """Return a mapping of the settings with its values as written, also one like ``dict(…)``."""
    if isinstance(value, str):
        value = parse_value(value)
    return dict(value) if isinstance(value, dict) else {}


def _label(value: Any) -> Any:
    """Return a value of a list as Optuna holds it: a plain one as it is, others as JSON."""
    if isinstance(value, (list, dict)):
        return json.dumps(value)
    return value


def _number_of(value: Any) -> float | None:
    """Return a number, also that of ``lin_x``; None for anything else."""
    number = parse_number(value.removeprefix(LINEAR) if isinstance(value, str) else value)
    # True and False are numbers to Python.
    return number if type(number) in (int, float) else None
