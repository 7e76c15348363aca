"""The observation noise as data: in proportion to each feature (thesis 3.3.1), and a part that is there at the target, too."""

from typing import Any

import numpy as np
from pydantic import Field, NonNegativeFloat

from sb3_quad.base.arrays import FloatArray
from sb3_quad.base.validate import Frozen


class Noise(Frozen):
    """Standard deviations of a feature x with scale σ (Eq. 3.16): √((relative x)² + (additive σ)²).

    That is the sum of two independent normal disturbances; one number for short is ``relative``.
    """

    relative: NonNegativeFloat = Field(default=0.0, description="in shares of the feature itself, 0.05 in the thesis")
    additive: NonNegativeFloat = Field(default=0.0, description="in shares of σ, the same wherever the vehicle is")


NoiseLevel = NonNegativeFloat | list[NonNegativeFloat] | Noise


def levels(noise: Any) -> tuple[FloatArray, FloatArray]:
    """The relative and the additive level of a valid ``NoiseLevel``, () or (rows,) each."""
    relative, additive = (noise.relative, noise.additive) if isinstance(noise, Noise) else (noise, 0.0)
    return np.asarray(relative, np.float64), np.asarray(additive)


def in_words(noise: Any) -> str:
    """Such as ``5 %``, or ``5 % and 2 % of σ``; of several rows the mean."""
    relative, additive = (100 * level.mean() for level in levels(noise))
    return f"{relative:g} %" + (f" and {additive:g} % of σ" if additive else "")
