"""What a search varies, from YAML: settings and the values that each may have.

======================================  ==================================================================================
value                                   meaning
======================================  ==================================================================================
``{low: 0.98, high: 0.999}``            a number between the two; ``log: true``: on a logarithmic scale
``{around: 5}``                         a number from a fifth of what the settings have to five times that, logarithmic
``[mse, nll, huber]``                   one of these, which may be lists and mappings too
======================================  ==================================================================================

Keys are those of the settings. ``policy_kwargs.net_arch`` is an entry of a mapping, and ``n_minibatches`` stands for the
``batch_size`` that divides a rollout into so many. Where the settings have ``lin_x``, the x is varied.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from sb3_quad.base.errors import ConfigError, unknown
from sb3_quad.settings.algorithms import constructor_parameters, get_algorithm
from sb3_quad.settings.config import TrainingConfig, read_yaml
from sb3_quad.settings.literals import parse_value
from sb3_quad.settings.values import takes_whole
from sb3_quad.tuning.dimensions import LINEAR, Choice, Interval, Parameter, number_of

if TYPE_CHECKING:
    from optuna import Trial

PACKAGE = "sb3_quad.zoo_configs.search_spaces"
MINIBATCHES = "n_minibatches"
MAPPINGS = ("policy_kwargs", "env_kwargs")
JOB_SETTINGS = ("n_envs", "expert")


class Bounds(BaseModel):
    """A number between two others."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    low: float
    high: float
    log: bool = False


class Factor(BaseModel):
    """A number around what the settings have."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    around: float = Field(gt=1)


@dataclass(frozen=True)
class SearchSpace:
    """The settings that are varied, by name, beside those that stay.

    :param config: the settings it starts from.
    """

    config: TrainingConfig
    dimensions: Mapping[str, Interval | Choice]

    def suggest(self, trial: Trial) -> dict[str, Any]:
        """All settings of a trial: plain values, as YAML holds them."""
        return self.settings({name: each.suggest(trial, name) for name, each in self.dimensions.items()})

    def settings(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """The settings with some values in them."""
        changed = dict(self.config.settings)
        for name, value in values.items():
            outer, dot, inner = name.partition(".")
            if dot:
                changed[outer] = {**_plain(changed.get(outer)), inner: value}
            elif name != MINIBATCHES:
                changed[name] = value
        if MINIBATCHES in values:
            rollout = _number(self._current(changed, "n_steps")) * _number(changed.get("n_envs", 1))
            changed["batch_size"] = math.ceil(rollout / values[MINIBATCHES])  # of all but the last, which may be smaller
        return changed

    def start(self) -> dict[str, Parameter] | None:
        """The parameters that stand for the settings as they are; None if one of these lies outside the space."""
        try:
            return {name: each.parameter(self._current(self.config.settings, name)) for name, each in self.dimensions.items()}
        except ValueError:
            return None

    def _current(self, settings: Mapping[str, Any], name: str) -> Any:
        return current(self.config.algo, settings, name)

    def describe(self) -> dict[str, str]:
        """The space in words, by name."""
        return {name: repr(each) for name, each in self.dimensions.items()}


def load_space(config: TrainingConfig, file: str | Path | None = None) -> SearchSpace:
    """What a search varies around some settings.

    :param file: a YAML file; None: the package's own for the algorithm.
    :raises ConfigError: an unreadable file, a setting that is none, bounds that are none.
    """
    if file is None:
        where = f"search_spaces/{config.algo}.yml"
        text = resources.files(PACKAGE).joinpath(f"{config.algo}.yml").read_text(encoding="utf-8")
    else:
        where = str(file)
        try:
            text = Path(file).read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(f"search space {where}: cannot be read ({error})") from None
    content = read_yaml(text, where)
    if not isinstance(content, dict) or not content:
        raise ConfigError(f"{where}: must hold settings with their ranges, such as 'learning_rate: {{around: 5}}'")
    _check_names(config, content, where)
    return SearchSpace(config, {name: _dimension(config, name, given, f"{where}: {name}") for name, given in content.items()})


def current(algo: str, settings: Mapping[str, Any], name: str) -> Any:
    """What some settings have under a name of a search space: theirs, or else the algorithm's default."""
    outer, dot, inner = name.partition(".")
    if dot:
        return _plain(settings.get(outer)).get(inner)
    parameters = constructor_parameters(get_algorithm(algo))
    if name == MINIBATCHES:
        sizes = [_number(current(algo, settings, key)) for key in ("n_steps", "n_envs", "batch_size")]
        return round(sizes[0] * sizes[1] / sizes[2])
    default = {"n_envs": 1, **{key: each.default for key, each in parameters.items()}}
    return settings.get(name, default.get(name))


def _check_names(config: TrainingConfig, content: Mapping[Any, Any], where: str) -> None:
    algorithm = get_algorithm(config.algo)
    divides = [MINIBATCHES] if {"n_steps", "batch_size"} <= (given := constructor_parameters(algorithm)).keys() else []
    valid = [*given, *JOB_SETTINGS, *divides]
    for name in content:
        outer, dot, inner = str(name).partition(".")
        if not (name in valid or (dot and inner and outer in MAPPINGS)):
            raise ConfigError(f"{where}: {unknown(f'setting of {config.algo}', name, valid)}")
    if MINIBATCHES in content and "batch_size" in content:
        raise ConfigError(f"{where}: {MINIBATCHES} says what batch_size is; leave one of them away")


def _dimension(config: TrainingConfig, name: str, given: Any, where: str) -> Interval | Choice:
    if isinstance(given, list):
        if not given:
            raise ConfigError(f"{where}: the list is empty")
        return Choice(tuple(given))
    if not isinstance(given, dict):
        raise ConfigError(f"{where}: {given!r} must be {{low: …, high: …}}, {{around: …}} or a list of values")
    value = current(config.algo, config.settings, name)
    schedule = isinstance(value, str) and value.startswith(LINEAR)
    parameter = constructor_parameters(get_algorithm(config.algo)).get(name)
    whole = name in (MINIBATCHES, "n_envs") or (parameter is not None and takes_whole(parameter))
    try:
        if "around" in given:
            factor = Factor.model_validate(given).around
            middle = number_of(value)
            if middle is None or middle <= 0:
                raise ConfigError(f"{where}: around needs a number above 0 in the settings, not {value!r}; give low and high")
            low, high, log = middle / factor, middle * factor, True
            if whole:
                low, high = max(1, math.floor(low)), math.ceil(high)
        else:
            bounds = Bounds.model_validate(given)
            low, high, log = bounds.low, bounds.high, bounds.log
    except ValidationError as error:
        raise ConfigError(f"{where}: {_explain(error)}") from None
    if low >= high:
        raise ConfigError(f"{where}: low {low:g} must be below high {high:g}")
    if log and low <= 0:
        raise ConfigError(f"{where}: low {low:g} must be above 0 on a logarithmic scale")
    if whole and (low != int(low) or high != int(high)):
        raise ConfigError(f"{where}: low {low:g} and high {high:g} must be whole numbers")
    return Interval(low, high, log, whole, schedule)


def _explain(error: ValidationError) -> str:
    item = error.errors()[0]
    return f"{'.'.join(str(part) for part in item['loc'])}: {item['msg']}"


def _plain(value: Any) -> dict[str, Any]:
    """A mapping of the settings with its values as they are written, also one written ``dict(…)``."""
    found = parse_value(value) if isinstance(value, str) else value
    return dict(found) if isinstance(found, dict) else {}


def _number(value: Any) -> float:
    number = number_of(value)
    return 1.0 if number is None else number
