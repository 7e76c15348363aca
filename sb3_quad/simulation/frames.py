"""What a policy sees beside the present features: the last action, earlier frames, and the integral
of the position error.

A frame is the scaled features of a control step, with ``last_action`` followed by the action that
led there. An observation is the frames of some ages, one after the other. The compiled functions
keep the frames of a row and make observations of them.
"""

from typing import Any

from numba import float32
from pydantic import Field, PositiveFloat, field_validator

from sb3_quad.base.validate import Frozen
from sb3_quad.simulation.compiled import compiled
from sb3_quad.simulation.observation import OBSERVATION_SIZE, F

MAX_AGE = 1000  # control steps


class PositionIntegral(Frozen):
    """s += ``gain`` e dt where e is shorter than ``distance`` and v than ``speed``; each component
    stays within ±``limit``.

    e is the observed position relative to the target, v the observed velocity; s is zero at an
    episode's start. The policy sees e + s in place of e, also in earlier frames. It flies to where
    e + s is zero, so that neither a constant force nor a bias of its own leaves an error. It need
    not have been trained with the integral.
    """

    gain: PositiveFloat = Field(default=0.5, le=100, description="1/s")
    distance: PositiveFloat = Field(default=1.0, le=1e3, description="m")
    speed: PositiveFloat = Field(default=1.5, le=1e3, description="m/s")
    limit: PositiveFloat = Field(default=3.0, le=1e3, description="m")

    def numbers(self, control_step: float) -> list[float]:
        """What :func:`integrate_position` reads: gain dt, distance², speed², limit."""
        return [self.gain * control_step, self.distance**2, self.speed**2, self.limit]


class ObservationSettings(Frozen):
    """What an observation is made of; the default is the 18 features alone."""

    last_action: bool = Field(
        default=False,
        description="whether a frame ends with the action before it, clipped to [-1, 1]",
    )
    history: tuple[int, ...] | None = Field(
        default=None,
        description="ages of the frames, control steps, such as [0, 1, 2, 4]; zeros before the episode began",
    )
    position_integral: PositionIntegral | None = Field(
        default=None, description="see PositionIntegral; {} for its defaults"
    )

    @field_validator("history", mode="before")
    @classmethod
    def _ages(cls, value: Any) -> Any:
        if isinstance(value, (list, tuple)) and any(isinstance(age, bool) for age in value):
            raise ValueError(f"{list(value)}: must be ages, whole control steps")
        return value

    @field_validator("history")
    @classmethod
    def _rises(cls, value: tuple[int, ...] | None) -> tuple[int, ...] | None:
        if value is not None and (
            not value or value[0] != 0 or list(value) != sorted(set(value)) or value[-1] > MAX_AGE
        ):
            raise ValueError(
                f"{list(value)}: must rise from 0, the present frame, to at most {MAX_AGE}"
            )
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
        return len(self.ages) * self.frame_size

    @property
    def is_extended(self) -> bool:
        """Whether an observation is more than the present features."""
        return self.last_action or self.ages != (0,) or self.position_integral is not None


@compiled
def store_action(i, step, action, frames):
    """Keep the action (4,) that led row i to control step ``step``, in place; ``frames`` as in
    :func:`observe_frames`.
    """
    slot = step % frames.shape[1]
    for k in range(frames.shape[2] - OBSERVATION_SIZE):
        frames[i, slot, OBSERVATION_SIZE + k] = min(max(action[k], float32(-1.0)), float32(1.0))


@compiled
def clear_frames(i, frames, integral):
    """Clear the last action and the integral as row i begins an episode, in place."""
    for k in range(frames.shape[2] - OBSERVATION_SIZE):
        frames[i, 0, OBSERVATION_SIZE + k] = 0.0
    for axis in range(integral.shape[0]):
        integral[axis, i] = 0.0


@compiled
def integrate_position(i, feature, lane, mean, inverse_std, numbers, integral):
    """Advance the position integral of row i by a control step, in place, from its scaled features
    (OBSERVATION_SIZE, lanes).

    :param numbers: float64 (4,), :meth:`PositionIntegral.numbers`.
    """
    error2 = speed2 = 0.0
    for axis in range(3):
        k, m = F.position + axis, F.velocity + axis
        e = feature[k, lane] / inverse_std[k, lane] + mean[k, lane]
        v = feature[m, lane] / inverse_std[m, lane] + mean[m, lane]
        error2 += e * e
        speed2 += v * v
    if error2 < numbers[1] and speed2 < numbers[2]:
        for axis in range(3):
            k = F.position + axis
            e = feature[k, lane] / inverse_std[k, lane] + mean[k, lane]
            integral[axis, i] = min(
                max(integral[axis, i] + numbers[0] * e, -numbers[3]), numbers[3]
            )


@compiled
def observe_frames(i, step, feature, lane, inverse_std, integral, ages, frames, out):
    """Keep row i's present frame and write its observation, in place.

    :param step: control steps since the episode began.
    :param feature: scaled features, float32 (OBSERVATION_SIZE, lanes), of which ``lane`` is the
        row's.
    :param integral: float64 (3, n), or (0, n) without.
    :param ages: int64, of the observed frames, control steps.
    :param frames: float32 (n, depth, frame_size), the frames of the latest control steps, step s in
        slot s % depth.
    :param out: float32 (n, size).
    """
    depth, size = frames.shape[1], frames.shape[2]
    slot = step % depth
    for k in range(OBSERVATION_SIZE):
        frames[i, slot, k] = feature[k, lane]
    for axis in range(integral.shape[0]):
        k = F.position + axis
        frames[i, slot, k] += float32(integral[axis, i]) * inverse_std[k, lane]
    at = 0
    for age in ages:
        if age <= step:
            then = (step - age) % depth
            for k in range(size):
                out[i, at + k] = frames[i, then, k]
        else:
            for k in range(size):
                out[i, at + k] = 0.0
        at += size
