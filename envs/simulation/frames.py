"""The parts of an observation besides the present features: the last action, earlier frames, and
the integral of the position error.

A frame consists of the scaled features of a control step, followed, with ``last_action``, by the
action that led there. An observation is the frames of several ages, one after the other. The
compiled functions keep the frames of a row and build observations from them.
"""

from typing import Annotated

from numba import float32
from pydantic import Field, PositiveFloat, field_validator

from sb3_quad.base.compiled import inlined, inner
from sb3_quad.base.validate import Frozen
from sb3_quad.envs.simulation.observation import OBSERVATION_SIZE, F

MAX_AGE = 1000  # control steps
# Neither true nor 1.0 is an age.
Age = Annotated[int, Field(strict=True, ge=0, le=MAX_AGE)]


class PositionIntegral(Frozen):
    """An integral s of the position error e, the observed position relative to the target.

    s += ``gain`` e dt in each control step in which e is shorter than ``distance`` and the observed
    speed less than ``speed``. Each component stays within ±``limit``, and s is zero when an episode
    starts. The policy sees e + s in place of e, also in earlier frames. It flies to where e + s is
    zero, so neither a constant force nor a bias of the policy leaves a steady error. A policy that
    was trained without the integral can fly with it.
    """

    gain: PositiveFloat = Field(default=0.5, le=100)
    """1/s"""
    distance: PositiveFloat = Field(default=1.0, le=1e3)
    """m"""
    speed: PositiveFloat = Field(default=1.5, le=1e3)
    """m/s"""
    limit: PositiveFloat = Field(default=3.0, le=1e3)
    """m"""

    def numbers(self, control_step: float) -> list[float]:
        """Return gain dt, distance², speed² and limit, which :func:`integrate_position` reads.

        :param control_step: dt, s.
        """
        return [self.gain * control_step, self.distance**2, self.speed**2, self.limit]


class ObservationSettings(Frozen):
    """The content of an observation; by default the 18 features alone."""

    last_action: bool = False
    """whether a frame ends with the action that led to it, clipped to [-1, 1]"""
    history: tuple[Age, ...] | None = None
    """ages of the frames, control steps, such as [0, 1, 2, 4]; zeros before the episode"""
    position_integral: PositionIntegral | None = None
    """fields of PositionIntegral; {} for its defaults"""
    preview: tuple[Age, ...] | None = None
    """control steps ahead, such as [0, 5, 10, 20], whose acceleration of the reference is seen"""

    @field_validator("history")
    @classmethod
    def _check_history(cls, value: tuple[int, ...] | None) -> tuple[int, ...] | None:
        # Sorting them together with the present frame changes nothing only if they rise from it.
        if value is not None and list(value) != sorted({0, *value}):
            raise ValueError(f"{list(value)}: must rise from 0, the present frame")
        return value

    @property
    def ages(self) -> tuple[int, ...]:
        """Ages of the observed frames, control steps."""
        return self.history or (0,)

    @property
    def frame_size(self) -> int:
        """Numbers in a frame."""
        return OBSERVATION_SIZE + 4 * self.last_action

    @property
    def size(self) -> int:
        """Numbers in an observation."""
        return len(self.ages) * self.frame_size + 3 * len(self.preview or ())

    @property
    def is_extended(self) -> bool:
        """Whether an observation is more than the present features."""
        return self.last_action or self.ages != (0,) or self.position_integral is not None


@inner
def store_action(i, step, action, frames):
    """Keep the action (4,) that led row i to control step ``step``, in place.

    :param frames: see :func:`observe_frames`.
    """
    slot = step % frames.shape[1]
    for k in range(frames.shape[2] - OBSERVATION_SIZE):
        frames[i, slot, OBSERVATION_SIZE + k] = min(max(action[k], float32(-1.0)), float32(1.0))


@inner
def clear_frames(i, frames, integral):
    """Clear the last action and the integral as row i begins an episode, in place."""
    for k in range(OBSERVATION_SIZE, frames.shape[2]):
        frames[i, 0, k] = 0.0
    for axis in range(integral.shape[0]):
        integral[axis, i] = 0.0


@inner
def integrate_position(b, i, lane, numbers, integral):
    """Advance the position integral of row i by a control step, in place.

    :param b: a block whose scaled features are computed; row i is in ``lane``.
    :param numbers: float64 (4,), :meth:`PositionIntegral.numbers`.
    """
    gain_dt = numbers[0]
    limit = numbers[3]
    e2 = v2 = 0.0
    for axis in range(3):
        e = _unscaled(b, F.position + axis, lane)
        v = _unscaled(b, F.velocity + axis, lane)
        e2 += e * e
        v2 += v * v
    if e2 < numbers[1] and v2 < numbers[2]:
        for axis in range(3):
            e = _unscaled(b, F.position + axis, lane)
            integral[axis, i] = min(max(integral[axis, i] + gain_dt * e, -limit), limit)


@inlined
def _unscaled(b, k, lane):
    return b.feature[k, lane] / b.inverse_std[k, lane] + b.mean[k, lane]


@inner
def observe_frames(b, i, step, lane, integral, ages, frames, out):
    """Keep row i's present frame and write its observation, in place.

    :param b: a block whose scaled features are computed; row i is in ``lane``.
    :param step: control steps since the episode began.
    :param integral: float64 (3, n), or (0, n) if there is none.
    :param ages: int64, ages of the observed frames, control steps.
    :param frames: float32 (n, depth, frame_size), the frames of the latest control steps, step s in
        slot s % depth.
    :param out: float32 (n, size).
    """
    _, depth, size = frames.shape
    slot = step % depth
    for k in range(OBSERVATION_SIZE):
        frames[i, slot, k] = b.feature[k, lane]
    for axis in range(integral.shape[0]):
        k = F.position + axis
        frames[i, slot, k] += float32(integral[axis, i]) * b.inverse_std[k, lane]
    at = 0
    for age in ages:
        # Frames from before the episode are zeros.
        for k in range(size):
            out[i, at + k] = frames[i, (step - age) % depth, k] if age <= step else 0.0
        at += size
