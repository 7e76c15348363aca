"""The rotors of one quadcopter through one control step, for a simulator that moves the body itself."""

from __future__ import annotations

import math

from sb3_quad.simulation.engine.blocks import P_ARM, P_HALF, P_LIFT, P_MIDDLE, P_MOTOR
from sb3_quad.simulation.engine.lowlevel import compiled

NOT_FINITE, BODY_FRAME_ONLY, WORLD_FRAME_TOO = 0, 1, 2


@compiled
def rotor_wrenches(state, queue, action, wrench, vehicles, physics_step, out):
    """Advance delay and motors of vehicle 0 and write what acts on its body in each physics step; in place.

    The same lines as in ``control_step``: motors do not feel the body, so that all physics steps of a control step can be
    worked out before the body moves.

    :param action: float32 (4,), clipped to [-1, 1].
    :param wrench: (12, 1); its body-frame parts are added to ``out``.
    :param out: (substeps, 2, 3), force (N) and torque (N m) at the centre of mass, body frame.
    :return: ``NOT_FINITE`` (the action, and nothing has changed), ``BODY_FRAME_ONLY``, or ``WORLD_FRAME_TOO`` where
        ``wrench`` has world-frame parts besides.
    """
    for j in range(4):
        if not math.isfinite(action[j]):
            return NOT_FINITE
    delay = queue.shape[0]
    thrust_coefficient, motor_gain = vehicles[P_LIFT, 0], vehicles[P_MOTOR, 0]
    for step in range(out.shape[0]):
        for axis in range(3):
            out[step, 0, axis] = wrench[3 + axis, 0]
            out[step, 1, axis] = wrench[9 + axis, 0]
    for j in range(4):
        clipped = min(max(float(action[j]), -1.0), 1.0)
        command = math.sqrt((vehicles[P_MIDDLE, 0] + vehicles[P_HALF, 0] * clipped) / thrust_coefficient)  # Eqs. 3.18, 2.4
        wanted = command
        if delay > 0:
            wanted = queue[0, j, 0]
            for k in range(delay - 1):
                queue[k, j, 0] = queue[k + 1, j, 0]
            queue[delay - 1, j, 0] = command
        speed = state[13 + j, 0]
        for step in range(out.shape[0]):
            speed += motor_gain * (wanted - speed) * physics_step  # Eq. 4.1
            thrust = thrust_coefficient * speed * speed
            out[step, 0, 2] += thrust
            for axis in range(3):
                out[step, 1, axis] += vehicles[P_ARM + 4 * axis + j, 0] * thrust  # Eq. 2.7, any layout
        state[13 + j, 0] = speed
    for axis in range(3):
        if wrench[axis, 0] != 0.0 or wrench[6 + axis, 0] != 0.0:
            return WORLD_FRAME_TOO
    return BODY_FRAME_ONLY


@compiled
def write_body(state, position, quaternion, velocity, angular_velocity):
    """Write a simulator's pose and velocity into the state of vehicle 0, in place.

    :param position: (x, y, z), world frame, m.
    :param quaternion: (x, y, z, w), body to world.
    :param velocity: world frame, m/s.
    :param angular_velocity: WORLD frame, rad/s; the state holds it in the body frame.
    """
    x, y, z, w = quaternion
    a, b, c = angular_velocity
    for axis in range(3):
        state[axis, 0] = position[axis]
        state[7 + axis, 0] = velocity[axis]
    state[3, 0], state[4, 0], state[5, 0], state[6, 0] = w, x, y, z
    state[10, 0] = (1 - 2 * (y * y + z * z)) * a + 2 * (x * y + w * z) * b + 2 * (x * z - w * y) * c
    state[11, 0] = 2 * (x * y - w * z) * a + (1 - 2 * (x * x + z * z)) * b + 2 * (y * z + w * x) * c
    state[12, 0] = 2 * (x * z + w * y) * a + 2 * (y * z - w * x) * b + (1 - 2 * (x * x + y * y)) * c
