"""The settings that a search varies, with the values that each may have, from YAML; docs/tune.md
lists them.

Keys are those of the settings. ``policy_kwargs.net_arch`` is an entry of a mapping, and
``n_minibatches`` stands for the ``batch_size`` that divides a rollout into this many. If the
settings have ``lin_x``, the x is varied. A setting for which only whole numbers are valid gets
whole numbers; others get four significant digits.
"""

import json
import math
from typing import Any, NamedTuple

from optuna.distributions import (
    BaseDistribution,
    CategoricalDistribution,
    FloatDistribution,
    IntDistribution,
)
from optuna.trial import create_trial
from pydantic import Field

from sb3_quad.base.errors import ConfigError, raised_as, unknown
from sb3_quad.base.literals import parse_number, parse_value
from sb3_quad.base.types import StrDict, StrMapping, StrPath
from sb3_quad.base.validate import Frozen, validate
from sb3_quad.base.yaml_files import YamlFolder
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.training.algorithms import constructor_parameters, takes_whole
from sb3_quad.training.config import TrainingConfig, build_config

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
    """A number around that of the settings, at most this many times larger or smaller."""

    around: float = Field(gt=1)


class SearchSpace(NamedTuple):
    """The settings that are varied, by name, and those that stay.

    :param config: the settings that a search starts from.
    :param dimensions: the distributions that Optuna samples from. Values of lists that are not
        plain appear as JSON.
    """

    config: TrainingConfig
    dimensions: dict[str, Any]

    def values(self, parameters: StrMapping) -> StrDict:
        """Return the values of the varied settings that some parameters stand for."""
        values = {}
        for name, parameter in parameters.items():
            values[name] = parameter
            if isinstance(parameter, str) and parameter[:1] in ("[", "{"):
                values[name] = json.loads(parameter)
            elif isinstance(self.dimensions[name], FloatDistribution):
                rounded = f"{parameter:.4g}"
                is_linear = str(_current(self.config, name)).startswith(LINEAR)
                values[name] = LINEAR + rounded if is_linear else float(rounded)
        return values

    def settings(self, parameters: StrMapping) -> StrDict:
        """Return all settings of a trial with these parameters, as in YAML."""
        changed = dict(self.config.settings)
        for name, value in self.values(parameters).items():
            outer, _, inner = name.partition(".")
            if inner:
                value = {**_entries(changed.get(outer)), inner: value}
            if outer == "env_kwargs":
                self._pin(changed, inner)
            changed[outer] = value
        if MINIBATCHES in changed:
            # All have the same size, except that the last may be smaller.
            count = changed.pop(MINIBATCHES)
            config = build_config(self.config.algo, self.config.env_id, changed)
            changed["batch_size"] = math.ceil(config.rollout / count)
        return changed

    def _pin(self, settings: StrDict, name: str) -> None:
        """Keep the original value of a varied environment keyword in evaluations, so that all
        trials are evaluated on the same episodes.

        Keywords that an agent's observations and rotors depend on stay as in its training.
        """
        base = _entries(self.config.settings.get("env_kwargs"))
        if self.config.task:
            base = {**self.config.flight_settings.model_dump(mode="json"), **base}
        evaluated = _entries(settings.get("eval_env_kwargs"))
        if name in base and name not in FlightSettings().observed:
            settings["eval_env_kwargs"] = {name: base[name], **evaluated}

    def start(self) -> StrDict | None:
        """Return the parameters that stand for the given settings; None if one of these is outside
        the space.
        """
        start = {}
        for name, dimension in self.dimensions.items():
            value = _current(self.config, name)
            if isinstance(dimension, CategoricalDistribution):
                start[name] = _label(value)
            else:
                start[name] = _number_of(value)
        try:
            # Optuna checks that the list or the range includes the value.
            create_trial(value=0.0, params=start, distributions=self.dimensions)
        except ValueError:
            return None
        return start


def load_space(config: TrainingConfig, source: StrPath | None = None) -> SearchSpace:
    """Load the space of a search around some settings.

    :param source: a YAML file; None: the package's own for the algorithm.
    :raises ConfigError: an unreadable file, an unknown setting, invalid bounds.
    """
    content, where = SPACES.read(source or config.algo)
    if not content:
        raise ConfigError(
            f"{where}: must hold settings with their ranges, such as 'learning_rate: {{around: 5}}'"
        )
    # The algorithm's arguments and the training's own settings may vary.
    valid = [*constructor_parameters(config.algorithm), *JOB_SETTINGS]
    if {"n_steps", "batch_size"} <= {*valid} and not config.is_off_policy:
        valid.append(MINIBATCHES)
    dimensions = {}
    for name, values in content.items():
        # Any entry of a mapping may vary.
        outer, _, inner = str(name).partition(".")
        if name not in valid and not (inner and outer in MAPPINGS):
            raise ConfigError(f"{where}: {unknown(f'setting of {config.algo}', name, valid)}")
        dimensions[name] = _dimension(config, name, values, f"{where}: {name}")
    if MINIBATCHES in content and "batch_size" in content:
        raise ConfigError(f"{where}: {MINIBATCHES} sets batch_size; remove one of them")
    return SearchSpace(config, dimensions)


def _current(config: TrainingConfig, name: str) -> Any:
    """Return the value of some settings under a name of a search space, or else the algorithm's
    default.
    """
    outer, _, inner = name.partition(".")
    # An entry of a mapping, such as policy_kwargs.net_arch.
    if inner:
        return _entries(config.settings.get(outer)).get(inner)
    if name == MINIBATCHES:
        return round(config.rollout / (config.keyword("batch_size") or 1))
    if name in config.settings:
        return config.settings[name]
    if name in JOB_SETTINGS:
        return getattr(config, name)
    return config.keyword(name)


def _dimension(config: TrainingConfig, name: str, values: Any, where: str) -> BaseDistribution:
    if isinstance(values, list) and values:
        return CategoricalDistribution([_label(value) for value in values])
    if not isinstance(values, dict):
        raise ConfigError(
            f"{where}: {values!r} must be {{low: …, high: …}}, {{around: …}} or a list of values"
        )
    parameter = constructor_parameters(config.algorithm).get(name)
    whole = name in (MINIBATCHES, "n_envs") or (parameter is not None and takes_whole(parameter))
    if "around" in values:
        around = validate(Factor, values, where).around
        value = _current(config, name)
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
        values = {"low": low, "high": high, "log": True}
    # The fields of an interval are the arguments of Optuna's distributions.
    interval = validate(WholeInterval if whole else Interval, values, where)
    with raised_as(ConfigError, where):
        return (IntDistribution if whole else FloatDistribution)(**dict(interval))


def _entries(value: Any) -> StrDict:
    """Return a mapping of the settings with its values as written, even one like ``dict(…)``."""
    if isinstance(value, str):
        value = parse_value(value)
    return value or {}


def _label(value: Any) -> Any:
    """Return a value of a list as Optuna stores it: a plain one unchanged, others as JSON."""
    if isinstance(value, (list, dict)):
        return json.dumps(value)
    return value


def _number_of(value: Any) -> float | None:
    """Return a number, including that of ``lin_x``; None for anything else."""
    number = parse_number(str(value).removeprefix(LINEAR))
    return None if isinstance(number, str) else number
