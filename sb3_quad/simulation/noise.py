"""The observation noise as data: in proportion to each feature (thesis 3.3.1), and a part that is there at the target, too."""

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import Field, NonNegativeFloat

from sb3_quad.base.arrays import FloatArray
from sb3_quad.base.validate import Frozen, validate


class Noise(Frozen):
    """Standard deviations of a feature x with scale σ (Eq. 3.16): √((relative x)² + (additive σ)²).

    That is the sum of two independent normal disturbances; one number for short is ``relative``.
    """

    relative: NonNegativeFloat = Field(default=0.0, description="in shares of the feature itself, 0.05 in the thesis")
    additive: NonNegativeFloat = Field(default=0.0, description="in shares of σ, the same wherever the vehicle is")


NoiseLevel = Noise | Annotated[float, Field(ge=0)]


def levels(noise: Any) -> tuple[FloatArray | float, FloatArray | float]:
    """The relative and the additive level of what environments are given: a number or array, a :class:`Noise` or its fields.

    :raises ConfigError: an unknown field, or a negative number.
    """
    if isinstance(noise, Mapping):
        noise = validate(Noise, noise, "noise")
    return (noise.relative, noise.additive) if isinstance(noise, Noise) else (noise, 0.0)


def in_words(noise: Any) -> str:
    """Such as ``5 %``, or ``5 % and 2 % of σ``."""
    relative, additive = levels(noise)
    return f"{100 * relative:g} %" + (f" and {100 * additive:g} % of σ" if additive else "")
