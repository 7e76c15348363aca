"""What a search varies, from YAML: settings and the values that each may have.

======================================  ==================================================================================
value                                   meaning
======================================  ==================================================================================
``{low: 0.98, high: 0.999}``            a number between the two; ``log: true``: on a logarithmic scale
``{around: 5}``                         a number from a fifth of what the settings have to five times that, logarithmic
``[mse, nll, huber]``                   one of these, which may be lists and mappings too
======================================  ==================================================================================

Keys are those of the settings. ``policy_kwargs.net_arch`` is an entry of a mapping, and ``n_minibatches`` stands for the
``batch_size`` that divides a rollout into so many. Where the settings have ``lin_x``, the x is varied. Settings of which only
whole numbers are known to fit get whole numbers; ``whole: true`` beside ``low`` asks for them elsewhere.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from optuna import Trial
from pydantic import Field, model_validator

from sb3_quad.base.errors import ConfigError, unknown
from sb3_quad.base.literals import parse_number, parse_value
from sb3_quad.base.validate import Frozen, validate
from sb3_quad.base.yaml_files import YamlFolder
from sb3_quad.training.algorithms import constructor_parameters, get_algorithm, is_off_policy
from sb3_quad.training.values import takes_whole

SPACES = YamlFolder("search space", "sb3_quad.zoo_configs.search_spaces", ".yml")
MINIBATCHES = "n_minibatches"
MAPPINGS = ("policy_kwargs", "env_kwargs")
JOB_SETTINGS = ("n_envs", "expert")
LINEAR = "lin_"
Parameter = float | int | str | bool | None  # as Optuna holds it


class Factor(Frozen):
    """A number around what the settings have, on a logarithmic scale."""

    around: float = Field(gt=1)


class Interval(Frozen):
    """A number between two others.

    :param log: on a logarithmic scale.
    :param whole: whole numbers only; others have four significant digits.
    :param schedule: written ``lin_x``: falls linearly from x to 0 over the training.
    """

    low: float
    high: float
    log: bool = False
    whole: bool = False
    schedule: bool = False

    @model_validator(mode="after")
    def _check(self) -> "Interval":
        if self.low >= self.high:
            raise ValueError(f"low {self.low:g} must be below high {self.high:g}")
        if self.log and self.low <= 0:
            raise ValueError(f"low {self.low:g} must be above 0 on a logarithmic scale")
        if self.whole and not (self.low.is_integer() and self.high.is_integer()):
            raise ValueError(f"low {self.low:g} and high {self.high:g} must be whole numbers")
        return self

    def suggest(self, trial: Trial, name: str) -> Parameter:
        """What a trial has under a name."""
        if self.whole:
            return trial.suggest_int(name, int(self.low), int(self.high), log=self.log)
        return trial.suggest_float(name, self.low, self.high, log=self.log)

    def setting(self, parameter: Any) -> Any:
        """The value that a parameter stands for, as the settings hold it."""
        if self.whole:
            return parameter
        written = f"{min(max(float(f'{parameter:.4g}'), self.low), self.high):.4g}"
        return f"{LINEAR}{written}" if self.schedule else float(written)

    def parameter(self, setting: Any) -> Parameter:
        """The parameter that stands for a value of the settings.

        :raises ValueError: the value is not among those of the space.
        """
        number = _number_of(setting)
        if number is None or not self.low <= number <= self.high:
            raise ValueError(f"{setting!r} is not between {self.low:g} and {self.high:g}")
        return int(number) if self.whole else float(number)


class Choice(Frozen):
    """One of several values, which may be lists and mappings too. Its methods are those of :class:`Interval`."""

    values: tuple[Any, ...]

    @property
    def labels(self) -> list[Parameter]:
        """The values as Optuna holds them: plain ones as they are, others as JSON."""
        plain = (bool, int, float, str, type(None))
        return [value if isinstance(value, plain) else json.dumps(value, default=str) for value in self.values]

    def suggest(self, trial: Trial, name: str) -> Parameter:
        return trial.suggest_categorical(name, self.labels)

    def setting(self, parameter: Any) -> Any:
        return self.values[self.labels.index(parameter)]

    def parameter(self, setting: Any) -> Parameter:
        (label,) = Choice(values=(setting,)).labels
        return self.labels[self.labels.index(label)]


@dataclass(frozen=True)
class SearchSpace:
    """The settings that are varied, by name, beside those that stay.

    :param algo: the algorithm whose settings these are.
    :param base: all settings, as a search starts from them.
    """

    algo: str
    base: Mapping[str, Any]
    dimensions: Mapping[str, Interval | Choice]

    def suggest(self, trial: Trial) -> dict[str, Any]:
        """All settings of a trial: plain values, as YAML holds them."""
        return self.settings({name: each.suggest(trial, name) for name, each in self.dimensions.items()})

    def settings(self, parameters: Mapping[str, Parameter]) -> dict[str, Any]:
        """All settings of a trial with these parameters."""
        changed = dict(self.base)
        for name, parameter in parameters.items():
            outer, dot, inner = name.partition(".")
            value = self.dimensions[name].setting(parameter)
            changed[outer] = {**_plain(changed.get(outer)), inner: value} if dot else value
        if MINIBATCHES in changed:  # of the same size, but for the last, which may be smaller
            changed["batch_size"] = math.ceil(_rollout(self.algo, changed) / changed.pop(MINIBATCHES))
        return changed

    def start(self) -> dict[str, Parameter] | None:
        """The parameters that stand for the settings as they are; None if one of these lies outside the space."""
        try:
            return {name: each.parameter(current(self.algo, self.base, name)) for name, each in self.dimensions.items()}
        except ValueError:
            return None


def load_space(algo: str, settings: Mapping[str, Any], source: str | Path | None = None) -> SearchSpace:
    """What a search varies around some settings.

    :param source: a YAML file; None: the package's own for the algorithm.
    :raises ConfigError: an unreadable file, a setting that is none, bounds that are none.
    """
    content, where = SPACES.read(source or algo)
    if not content:
        raise ConfigError(f"{where}: must hold settings with their ranges, such as 'learning_rate: {{around: 5}}'")
    parameters = constructor_parameters(get_algorithm(algo))
    on_policy = {"n_steps", "batch_size"} <= parameters.keys() and not is_off_policy(get_algorithm(algo))
    divides = [MINIBATCHES] if on_policy else []
    valid = [*parameters, *JOB_SETTINGS, *divides]
    for name in content:
        outer, dot, inner = str(name).partition(".")
        if not (name in valid or (dot and inner and outer in MAPPINGS)):
            raise ConfigError(f"{where}: {unknown(f'setting of {algo}', name, valid)}")
    if MINIBATCHES in content and "batch_size" in content:
        raise ConfigError(f"{where}: {MINIBATCHES} says what batch_size is; leave one of them away")
    dimensions = {name: _dimension(algo, settings, name, given, f"{where}: {name}") for name, given in content.items()}
    return SearchSpace(algo, settings, dimensions)


def current(algo: str, settings: Mapping[str, Any], name: str) -> Any:
    """What some settings have under a name of a search space: theirs, or else the algorithm's default."""
    outer, dot, inner = name.partition(".")
    if dot:
        return _plain(settings.get(outer)).get(inner)
    if name == MINIBATCHES:
        return round(_rollout(algo, settings) / (_number_of(current(algo, settings, "batch_size")) or 1))
    parameters = constructor_parameters(get_algorithm(algo))
    default = {"n_envs": 1, **{key: each.default for key, each in parameters.items()}}
    return settings.get(name, default.get(name))


def _dimension(algo: str, settings: Mapping[str, Any], name: str, given: Any, where: str) -> Interval | Choice:
    if isinstance(given, list):
        if not given:
            raise ConfigError(f"{where}: the list is empty")
        return Choice(values=tuple(given))
    if not isinstance(given, dict):
        raise ConfigError(f"{where}: {given!r} must be {{low: …, high: …}}, {{around: …}} or a list of values")
    value = current(algo, settings, name)
    parameter = constructor_parameters(get_algorithm(algo)).get(name)
    whole = name in (MINIBATCHES, "n_envs") or (parameter is not None and takes_whole(parameter))
    schedule = isinstance(value, str) and value.startswith(LINEAR)
    if "around" not in given:
        return validate(Interval, {"whole": whole, "schedule": schedule, **given}, where)
    factor, middle = validate(Factor, given, where).around, _number_of(value)
    if middle is None or middle <= 0:
        raise ConfigError(f"{where}: around needs a number above 0 in the settings, not {value!r}; give low and high")
    low, high = middle / factor, middle * factor
    if whole:
        low, high = max(1, math.floor(low)), math.ceil(high)
    return Interval.model_construct(low=low, high=high, log=True, whole=whole, schedule=schedule)


def _rollout(algo: str, settings: Mapping[str, Any]) -> float:
    """Timesteps of a rollout."""
    return math.prod(_number_of(current(algo, settings, key)) or 1 for key in ("n_steps", "n_envs"))


def _plain(value: Any) -> dict[str, Any]:
    """A mapping of the settings with its values as they are written, also one written ``dict(…)``."""
    found = parse_value(value) if isinstance(value, str) else value
    return dict(found) if isinstance(found, dict) else {}


def _number_of(value: Any) -> float | None:
    """A number, also that of ``lin_x``; None if there is none."""
    number = parse_number(value.removeprefix(LINEAR) if isinstance(value, str) else value)
    return None if isinstance(number, bool) or not isinstance(number, (int, float)) else number
