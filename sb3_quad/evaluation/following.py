"""How well flights follow references that move or turn."""

import numpy as np

from sb3_quad.base.types import BoolArray, FloatArray
from sb3_quad.envs.simulation.state import QuadcopterState

SETTLED = 2.0  # time after which errors count, s
FOLLOWED = ("rms_error", "greatest_error", "path_error", "heading_error", "lag")


class Following:
    """Tracks how far n flights are from references that move or turn.

    With the error e = r - r_T and the reference's velocity v, over all that is flown after the
    first 2 s: ``rms_error`` is the root mean square of the length of e, ``greatest_error`` its
    greatest length, and ``path_error`` the root mean square of the part of e across v, or of all of
    e where v is zero; m. ``lag`` is -mean(e·v) / mean(v²), s: the delay with which the reference
    fits the flight best, as long as it is short. ``heading_error`` is the root mean square of the
    angle between the body's x axis, seen from above, and the commanded heading, degrees.

    ``moves`` (n,) says whose reference has moved or had a heading.

    :param control_step: s.
    """

    def __init__(self, n: int, control_step: float) -> None:
        self._first = SETTLED / control_step
        self.moves = np.zeros(n, bool)
        self._greatest = np.full(n, np.nan)
        self._sums = np.zeros((7, n))

    def update(self, step: int, state: QuadcopterState, flying: BoolArray) -> None:
        """See the state after control step ``step``; only the flights (n,) that continue count."""
        velocity = state.target_velocity
        speed = np.linalg.norm(velocity, axis=1)
        cosine, sine = state.target_heading.T
        # 1 where a heading is commanded, otherwise 0.
        commanded = np.hypot(cosine, sine)
        self.moves |= speed + commanded > 0.0
        if step < self._first:
            return
        error = state.position - state.target
        distance = state.distance
        along = (error * velocity).sum(axis=1)
        on_path = np.divide(along, speed, out=np.zeros_like(along), where=speed > 0.0)
        # The azimuth of the body's x axis, relative to the commanded heading.
        x, y = state.rotation[:, :2, 0].T
        turn = np.arctan2(cosine * y - sine * x, cosine * x + sine * y)
        np.fmax(self._greatest, distance, out=self._greatest, where=flying)
        squared = distance**2
        across = squared - on_path**2
        turns = commanded * turn**2
        counted = np.ones_like(along), squared, across, along, speed**2, commanded, turns
        self._sums += np.where(flying, counted, 0.0)

    def errors(self, survival: BoolArray) -> dict[str, FloatArray]:
        """Return the errors by name, (n,) each; NaN if a flight was lost or its target rested.

        :param survival: (n,).
        """
        steps, squares, across, along, speeds, commanded, turns = self._sums
        with np.errstate(divide="ignore", invalid="ignore"):
            errors = (
                np.sqrt(squares / steps),
                self._greatest,
                np.sqrt(np.maximum(across, 0.0) / steps),
                np.degrees(np.sqrt(turns / commanded)),
                -along / speeds,
            )
        return dict(zip(FOLLOWED, np.where(survival & self.moves, errors, np.nan), strict=True))
