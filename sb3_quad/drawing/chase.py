"""A camera that follows a vehicle towards its target."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from sb3_quad.drawing.backdrop import Camera
from sb3_quad.simulation.state import POSITION, TARGET

FloatArray = npt.NDArray[np.float64]

FIELD_OF_VIEW = math.radians(54.0)  # vertical
ELEVATIONS = math.radians(-45.0), math.radians(52.0)
ELEVATION_AT_TARGET = math.radians(-8.0)


class ChaseCamera:
    """Behind the vehicle as seen from its target and a little aside, so that both are in the picture.

    :param scale: the vehicle's size, in that of the default one.
    """

    def __init__(self, scale: float) -> None:
        self.scale = scale
        self.direction = np.array([1.0, 0.0, ELEVATION_AT_TARGET])  # course (x, y) and elevation, rad

    def reset(self, state: FloatArray) -> None:
        """A new flight: jump to where ``state``, a column of (STATE_SIZE, n), says."""
        self.direction[:] = 1.0, 0.0, ELEVATION_AT_TARGET
        self.turn(state, 1.0)

    def turn(self, state: FloatArray, share: float) -> None:
        """Turn towards the target by ``share`` of the angle; at the target, keep the course and level out."""
        error = state[TARGET] - state[POSITION]
        away = float(np.linalg.norm(error))
        across = float(np.hypot(*error[:2]))
        elevation = np.clip(math.atan2(error[2], across), *ELEVATIONS) if away > self.scale else ELEVATION_AT_TARGET
        if across > 0.3 * self.scale and away > self.scale:
            course = self.direction[:2] + share * (error[:2] / across - self.direction[:2])
            self.direction[:2] = _unit(course, error[:2] / across)
        self.direction[2] += share * (elevation - self.direction[2])

    def camera(self, state: FloatArray) -> Camera:
        """The camera for a column of ``state``."""
        position, target = state[POSITION], state[TARGET]
        level = np.array([*self.direction[:2], 0.0])
        aside = np.array([level[1], -level[0], 0.0])
        sine, cosine = math.sin(self.direction[2]), math.cos(self.direction[2])
        ahead = cosine * level + np.array([0.0, 0.0, sine])
        above = -sine * level + np.array([0.0, 0.0, cosine])
        over = 0.4 - 0.75 * max(float(self.direction[2]), 0.0)  # a target far above is seen past the vehicle from below
        eye = position + self.scale * (-1.3 * ahead + 0.35 * aside + over * above)
        eye[2] = max(eye[2], 0.15)
        to_vehicle = _unit(position - eye, ahead)
        point = eye + to_vehicle + _unit(target - eye, to_vehicle)
        if np.hypot(*(point - eye)[:2]) < 0.05:  # straight up or down has no horizon
            point = point + 0.1 * level
        return Camera.looking_at(eye, point, FIELD_OF_VIEW)


def _unit(vector: FloatArray, otherwise: FloatArray) -> FloatArray:
    """``vector`` as a unit vector, or ``otherwise`` where it has hardly a direction."""
    norm = float(np.linalg.norm(vector))
    return np.asarray(vector / norm) if norm > 1e-3 else otherwise
