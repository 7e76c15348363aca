"""The rotors of one quadcopter through one control step, for a simulator that moves the body itself."""

import math

from sb3_quad.simulation.compiled import compiled
from sb3_quad.simulation.rotation import rotation_rows
from sb3_quad.simulation.state import P, W, X

NOT_FINITE, BODY_FRAME_ONLY, WORLD_FRAME_TOO = range(3)


@compiled
def rotor_wrenches(state, queue, action, wrench, vehicles, physics_step, out):
    """Advance delay and motors of vehicle 0 and write what acts on its body in each physics step; in place.

    The same lines as in :mod:`.physics`: motors do not feel the body, so that all physics steps of a control step can be
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
    delay = int(vehicles[P.delay, 0])
    thrust_coefficient, motor_gain = vehicles[P.thrust_coefficient, 0], vehicles[P.motor_gain, 0]
    for step in range(out.shape[0]):
        for axis in range(3):
            out[step, 0, axis] = wrench[W.force_body + axis, 0]
            out[step, 1, axis] = wrench[W.torque_body + axis, 0]
    for j in range(4):
        clipped = min(max(float(action[j]), -1.0), 1.0)
        thrust = vehicles[P.thrust_middle, 0] + vehicles[P.thrust_half_range, 0] * clipped  # Eq. 3.18
        command = math.sqrt(thrust / thrust_coefficient)  # Eq. 2.4
        wanted = command
        if delay > 0:
            wanted = queue[0, j, 0]
            for k in range(delay - 1):
                queue[k, j, 0] = queue[k + 1, j, 0]
            queue[delay - 1, j, 0] = command
        speed = state[X.rotor_speeds + j, 0]
        for step in range(out.shape[0]):
            speed += motor_gain * (wanted - speed) * physics_step  # Eq. 4.1
            thrust = thrust_coefficient * speed * speed
            out[step, 0, 2] += thrust
            for axis in range(3):
                out[step, 1, axis] += vehicles[P.roll_arm_0 + 4 * axis + j, 0] * thrust  # Eq. 2.7, any layout
        state[X.rotor_speeds + j, 0] = speed
    for axis in range(3):
        if wrench[W.force_world + axis, 0] != 0.0 or wrench[W.torque_world + axis, 0] != 0.0:
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
        state[X.position + axis, 0] = position[axis]
        state[X.velocity + axis, 0] = velocity[axis]
    state[X.quaternion, 0], state[X.quaternion + 1, 0] = w, x
    state[X.quaternion + 2, 0], state[X.quaternion + 3, 0] = y, z
    (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = rotation_rows(w, x, y, z)
    state[X.body_rates, 0] = r00 * a + r10 * b + r20 * c
    state[X.body_rates + 1, 0] = r01 * a + r11 * b + r21 * c
    state[X.body_rates + 2, 0] = r02 * a + r12 * b + r22 * c
