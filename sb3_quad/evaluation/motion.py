"""How steadily flights go: when a vehicle is stable again, and how far beside the straight way to its target it gets."""

import numpy as np

from sb3_quad.base.arrays import BoolArray
from sb3_quad.simulation.state import QuadcopterState

TILT, RATE, HOLD = np.radians(45.0), 2.0, 0.2  # stable: tilt (rad), roll and pitch rate (rad/s) below these, for so long (s)


class Motion:
    """Watches n flights, step by step.

    ``stabilised`` (n,): s until the tilt has come below 45° and the turning about the body's x and y axes below 2 rad/s, both
    for 0.2 s at least, of which the beginning counts; NaN if that never was. The thesis reads such a time from Fig. 4.9.
    ``sideways`` (n,): the largest distance from the straight line through start and target, m, on the way and beyond: the
    oscillations of 4.3.1; NaN where both are one point.

    :param state: at the start.
    :param control_step: s.
    """

    def __init__(self, state: QuadcopterState, control_step: float) -> None:
        way = state.target - state.position
        length = np.linalg.norm(way, axis=1, keepdims=True)
        self._start, self._control_step = state.position.copy(), control_step
        self._direction = np.divide(way, length, out=np.zeros_like(way), where=length > 0.0)
        self._since = np.zeros(state.n)  # when the present stable time began
        self._stable = np.ones(state.n, dtype=np.bool_)
        self.stabilised = np.full(state.n, np.nan)
        self.sideways = np.where(length[:, 0] > 0.0, 0.0, np.nan)
        self.see(0, state, np.ones(state.n, dtype=np.bool_))

    def see(self, step: int, state: QuadcopterState, flying: BoolArray) -> None:
        """The state after control step ``step``; only flights (n,) that go on count."""
        time, before = step * self._control_step, self._stable
        self._stable = _upright(state) & (np.hypot(*state.body_rates.T[:2]) < RATE)
        self._since[self._stable & ~before] = time
        held = flying & self._stable & (time - self._since > HOLD - 0.5 * self._control_step)
        new = held & np.isnan(self.stabilised)
        self.stabilised[new] = self._since[new]
        flown = state.position - self._start
        beside = np.linalg.norm(flown - (flown * self._direction).sum(axis=1, keepdims=True) * self._direction, axis=1)
        self.sideways[flying] = np.maximum(self.sideways, beside)[flying]


def _upright(state: QuadcopterState) -> BoolArray:
    x, y = state.quaternion.T[1:3]
    upright: BoolArray = 1.0 - 2.0 * (x * x + y * y) > np.cos(TILT)
    return upright
