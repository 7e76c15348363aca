"""The kinds of numbers that parameter files hold."""

from __future__ import annotations

import math
from typing import Annotated

from pydantic import AfterValidator, Field


def _finite(value: float) -> float:
    if not math.isfinite(value):
        raise ValueError("must be a finite number")
    return value


Finite = Annotated[float, AfterValidator(_finite)]
Positive = Annotated[Finite, Field(gt=0)]
Share = Annotated[Finite, Field(ge=0, le=1)]
