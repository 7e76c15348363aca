"""What no controller can do: a lower bound of the height that a falling, tumbling vehicle loses before it can climb."""

from __future__ import annotations

import math

import numba
import numpy as np
import numpy.typing as npt

from sb3_quad.simulation.state import QuadcopterState
from sb3_quad.vehicles.vehicle import Vehicle, load_vehicle

FloatArray = npt.NDArray[np.float64]
HORIZON = 20.0  # s; a fall that is not over by then counts as lost height until then


def least_height_lost(state: QuadcopterState, vehicle: str | Vehicle = "itm") -> FloatArray:
    """A lower bound, m, shape (n,), of the height lost from a state until it no longer falls, whatever flies it.

    A start is physically lost where the bound exceeds the height it has. It gives the vehicle more than it has, so the
    reverse does not follow. From the present rotor speeds each rotor may take, at any time, any thrust between what it
    would have after rising and after falling since now (Eq. 4.1; the delay is left out), even where one command could not
    ask for both. The turn and the thrust are bounded each by itself, and a turn need not be braked:

    - roll and pitch rate together, s, grow by at most the greatest angular acceleration of those thrusts and by
      gyroscopic coupling to the yaw rate, which is bounded likewise;
    - the thrust axis is within ∫∫ a of where its present motion alone would carry it on its great circle, with a the
      greatest acceleration of the axis across the sphere (on a sphere, neighbouring great circles diverge at most as
      fast as straight lines do), and within ∫ s of where it is;
    - the thrust is the greatest possible while the axis may point upwards, else the least, and as upright as it may be.

    No drag and no external forces, as in the environments.
    """
    v = load_vehicle(vehicle)
    lost = np.empty(state.n)
    speeds = np.array(v.rotor_speed_range)
    body = np.array([v.mass, v.gravity, *v.inertia, v.thrust_coefficient, v.motor_gain, v.physics_step])
    _least_height_lost(state.array, v.mixer, speeds, body, lost)
    return lost


@numba.njit(cache=True, error_model="numpy")
def _greatest_accelerations(low, high, mixer, ixx, iyy, izz):  # type: ignore[no-untyped-def]
    """Of roll and pitch together, and of yaw, rad/s², with every rotor's thrust anywhere between low and high."""
    tilting, yawing = 0.0, 0.0
    for pattern in range(16):  # the corners of the box, where a convex function is greatest
        x, y, z = 0.0, 0.0, 0.0
        for k in range(4):
            thrust = high[k] if pattern >> k & 1 else low[k]
            x, y, z = x + mixer[1, k] * thrust, y + mixer[2, k] * thrust, z + mixer[3, k] * thrust
        tilting, yawing = max(tilting, math.sqrt((x / ixx) ** 2 + (y / iyy) ** 2)), max(yawing, abs(z) / izz)
    return tilting, yawing


@numba.njit(cache=True, error_model="numpy")
def _least_height_lost(x, mixer, speeds, body, lost):  # type: ignore[no-untyped-def]
    mass, g, ixx, iyy, izz, lift, motor, dt = body
    coupling = abs((iyy - izz) / ixx + (izz - ixx) / iyy) / 2  # of s to yaw: |p q| is at most s² / 2
    yaw_coupling = abs(ixx - iyy) / izz / 2
    bending = max(abs(iyy + izz - ixx) / iyy, abs(ixx + izz - iyy) / ixx)  # of the axis' path, by a yawing body
    rising, falling, low, high = np.empty(4), np.empty(4), np.empty(4), np.empty(4)
    for i in range(x.shape[1]):
        w, qx, qy, qz = x[3, i], x[4, i], x[5, i], x[6, i]
        p, q = x[10, i], x[11, i]
        upright = 1.0 - 2.0 * (qx * qx + qy * qy)
        # d R33 / dt, and the great circle's R33 = upright cos(s0 t) + slope sin(s0 t) / s0
        slope = 2.0 * (qx * qz - w * qy) * q - 2.0 * (qy * qz + w * qx) * p
        start = math.sqrt(p * p + q * q)
        s, yaw = start, abs(x[12, i])
        tilt = math.acos(min(1.0, max(-1.0, upright)))
        turned, strayed, stray_rate = 0.0, 0.0, 0.0
        velocity, height, lowest = x[9, i], 0.0, 0.0
        for k in range(4):
            rising[k] = falling[k] = x[13 + k, i]
        for step in range(int(HORIZON / dt)):
            total_low, total_high = 0.0, 0.0
            for k in range(4):
                rising[k] += motor * dt * (speeds[1] - rising[k])
                falling[k] += motor * dt * (speeds[0] - falling[k])
                low[k], high[k] = lift * falling[k] ** 2, lift * rising[k] ** 2
                total_low, total_high = total_low + low[k], total_high + high[k]
            time = step * dt
            swung = upright * math.cos(start * time) + (slope * math.sin(start * time) / start if start > 0.0 else 0.0)
            carried = math.acos(min(1.0, max(-1.0, swung)))
            cosine = math.cos(max(0.0, tilt - turned, carried - strayed))
            velocity += dt * ((total_high if cosine > 0.0 else total_low) * cosine / mass - g)
            height += dt * velocity
            lowest = min(lowest, height)
            tilting, yawing = _greatest_accelerations(low, high, mixer, ixx, iyy, izz)
            stray_rate += dt * (tilting + bending * yaw * s)
            s, yaw = s + dt * (tilting + coupling * yaw * s), yaw + dt * (yawing + yaw_coupling * s * s)
            strayed += dt * stray_rate
            turned += dt * s
            if velocity >= 0.0 and turned > tilt:
                break
        lost[i] = -lowest
