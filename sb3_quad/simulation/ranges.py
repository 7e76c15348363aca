"""Ranges of numbers that are sampled for each episode."""

import math
from typing import Any, Literal

from pydantic import Field, NonNegativeFloat, PositiveFloat, model_validator

from sb3_quad.base.validate import Frozen
from sb3_quad.simulation.compiled import compiled

FIXED, UNIFORM, LOG_UNIFORM, CUBE_ROOT = range(4)
_KINDS = {"uniform": UNIFORM, "log_uniform": LOG_UNIFORM, "uniform_cube_root": CUBE_ROOT}
FIXED_NUMBERS = (0.0, 0.0, float(FIXED))  # of a range that is left out


class Range(Frozen):
    """Numbers from ``low`` to ``high``; ``[low, high]`` for short, or one number."""

    low: float = Field(description="the least number")
    high: float = Field(description="the greatest number, at least low")
    distribution: Literal["uniform", "log_uniform", "uniform_cube_root"] = Field(
        default="uniform", description="of the number, of its logarithm (low > 0), or of its cube root"
    )

    @model_validator(mode="before")
    @classmethod
    def _for_short(cls, data: Any) -> Any:
        if isinstance(data, (int, float)) and not isinstance(data, bool):
            return {"low": data, "high": data}
        if isinstance(data, (list, tuple)):
            if len(data) != 2:
                raise ValueError(f"{list(data)!r}: must be [low, high]")
            return dict(zip(("low", "high"), data, strict=True))
        return data

    @model_validator(mode="after")
    def _rises(self) -> "Range":
        if self.low > self.high:
            raise ValueError(f"[{self.low:g}, {self.high:g}]: the first number exceeds the second")
        if self.distribution == "log_uniform" and self.low <= 0.0:
            raise ValueError(f"[{self.low:g}, {self.high:g}]: log_uniform numbers are greater than 0")
        return self

    def numbers(self) -> list[float]:
        """Low, high, and how to sample between them."""
        return [self.low, self.high, _KINDS[self.distribution]]


class NonNegativeRange(Range):
    """A :class:`Range` of numbers from 0."""

    low: NonNegativeFloat = Field(description="the least number, at least 0")


class PositiveRange(Range):
    """A :class:`Range` of numbers above 0."""

    low: PositiveFloat = Field(description="the least number, above 0")


@compiled
def between(table, k, u, nominal):
    """The number that u in (0, 1) stands for in the range at ``table[k : k + 3]``; ``nominal`` if the range is FIXED."""
    low, high, kind = table[k], table[k + 1], table[k + 2]
    if kind == FIXED:
        return nominal
    if kind == CUBE_ROOT:
        return (low ** (1.0 / 3.0) + (high ** (1.0 / 3.0) - low ** (1.0 / 3.0)) * u) ** 3
    return low * math.exp(u * math.log(high / low)) if kind == LOG_UNIFORM else low + (high - low) * u
