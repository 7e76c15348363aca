"""One setting that is varied: between two numbers, or among a few values."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from sb3_quad.settings.literals import parse_number

if TYPE_CHECKING:
    from optuna import Trial

LINEAR = "lin_"
Parameter = float | int | str | bool | None


@dataclass(frozen=True)
class Interval:
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

    def suggest(self, trial: Trial, name: str) -> Any:
        """The value of a setting in a trial, as the settings hold it."""
        if self.whole:
            return trial.suggest_int(name, int(self.low), int(self.high), log=self.log)
        value = trial.suggest_float(name, self.low, self.high, log=self.log)
        written = f"{min(max(float(f'{value:.4g}'), self.low), self.high):.4g}"
        return f"{LINEAR}{written}" if self.schedule else float(written)

    def parameter(self, value: Any) -> Parameter:
        """The parameter that stands for the value of a setting.

        :raises ValueError: the value lies outside.
        """
        number = number_of(value)
        if number is None or not self.low <= number <= self.high:
            raise ValueError(f"{value!r} is not between {self.low:g} and {self.high:g}")
        return int(number) if self.whole else float(number)


@dataclass(frozen=True)
class Choice:
    """One of several values, which may be lists and mappings too."""

    values: tuple[Any, ...]

    def suggest(self, trial: Trial, name: str) -> Any:
        """The value of a setting in a trial, as the settings hold it."""
        labels = [_label(value) for value in self.values]
        return self.values[labels.index(trial.suggest_categorical(name, labels))]

    def parameter(self, value: Any) -> Parameter:
        """The parameter that stands for the value of a setting.

        :raises ValueError: the value is none of these.
        """
        labels = [_label(each) for each in self.values]
        return labels[labels.index(_label(value))]


def number_of(value: Any) -> float | None:
    """A number, also that of ``lin_x``; None if there is none."""
    number = parse_number(value.removeprefix(LINEAR) if isinstance(value, str) else value)
    return None if isinstance(number, bool) or not isinstance(number, (int, float)) else number


def _label(value: Any) -> Parameter:
    """A value as Optuna holds it: plain ones as they are, others as JSON."""
    return value if value is None or isinstance(value, (bool, int, float, str)) else json.dumps(value, default=str)
