"""The law of the geometric expert for a batch of vehicles, compiled.

docs/research/experts.md has it in formulas. Vectors are tuples; ``gains`` is a column of
``LawConstants.gains``, whose rows have names in ``G``.
"""

import math

import numpy as np

from sb3_quad.base.compiled import compiled, inner
from sb3_quad.envs.simulation.physics import rotation, to_body, to_world
from sb3_quad.envs.simulation.state import AHEAD, P, W, X
from sb3_quad.envs.simulation.vectors import (
    add,
    cross,
    divide,
    dot,
    subtract,
    vector_at,
)
from sb3_quad.experts.geometric_gains import G
from sb3_quad.experts.protocol import command_rates

# The greatest rate of a turn, in those from which the loop asks for the planned deceleration.
STOPPABLE = 1.2


@compiled
def fly_geometric(state, constants, wrench, by_rates, actions):
    """Write the actions of n vehicles, (n, 4).

    :param state: (STATE_SIZE, n).
    :param constants: ``LawConstants`` with n columns, or one for all vehicles.
    :param wrench: the external wrench to compensate, (WRENCH_SIZE, n) or (WRENCH_SIZE, 1).
    :param by_rates: whether actions command thrust and body rates rather than rotor thrusts.
    """
    tilting = np.empty(4)
    rates = np.empty(3)
    for i in range(actions.shape[0]):
        # A single column serves all vehicles.
        k = min(i, constants.gains.shape[1] - 1)
        j = min(i, wrench.shape[1] - 1)
        gains = constants.gains[:, k]
        mass = constants.vehicles[P.mass, k]
        g = constants.vehicles[P.gravity, k]
        inertia = vector_at(constants.vehicles, P.ixx, k)
        body_to_world = rotation(state[X.quaternion :], i)
        omega = vector_at(state, X.body_rates, i)

        # The effect of the external wrench: an acceleration in the world frame, a torque in the
        # body frame.
        pushed = to_world(body_to_world, vector_at(wrench, W.force_body, j))
        force = add(vector_at(wrench, W.force_world, j), pushed)
        turned = to_body(body_to_world, vector_at(wrench, W.torque_world, j))
        torque = add(vector_at(wrench, W.torque_body, j), turned)

        # The desired force of the rotors per mass, and its direction b as the body will see it when
        # the command acts. All motion is relative to the reference, whose acceleration pushes the
        # vehicle backwards.
        f = desired_force(
            subtract(vector_at(state, X.target, i), vector_at(state, X.position, i)),
            subtract(vector_at(state, X.velocity, i), vector_at(state, X.target_velocity, i)),
            subtract(
                divide(force, mass),
                reference_acceleration(state, i, constants.lag[k], gains[G.attitude]),
            ),
            gains,
            g,
        )
        size = math.sqrt(dot(f, f))
        b = divide(to_body(body_to_world, f), size)
        b = seen_later(b, omega, constants.lag[k])

        rate, nx, ny = desired_turn(b, omega, gains)
        if by_rates:
            yaw_rate = desired_yaw_rate(state, i, body_to_world, gains)
            loop = vector_at(constants.vehicles, P.rate_gain_x, k)
            # A vehicle with little torque could not stop from a rate far above the one from which
            # the loop asks for the planned deceleration.
            rate = min(rate, STOPPABLE * gains[G.angular_deceleration] * inertia[0] / loop[0])
            wanted = rate * nx, rate * ny, yaw_rate
            for axis in range(3):
                # A loop slower than the law gets more than the wanted rate, to be as quick. It
                # gives a moment if the rates differ by that over its gain.
                slowness = gains[G.body_rates] * inertia[axis] / loop[axis]
                lead = max(slowness - 1.0, 0.0) * (wanted[axis] - omega[axis])
                rates[axis] = wanted[axis] + lead - torque[axis] / loop[axis]
            command_rates(mass * size * b[2], rates, constants.vehicles[:, k], actions[i])
            continue

        # Moments for the turn, against the yaw rate, and against the external torque.
        mx, my = turn_moments(rate, nx, ny, omega, gains, inertia)
        mz = yaw_moment(state, i, body_to_world, omega[2], gains, inertia[2])
        moments = subtract((mx, my, mz), torque)
        allocate(
            mass * size * b[2],
            moments,
            constants.mixer_inverse[:, :, k],
            constants.vehicles[P.thrust_middle, k],
            constants.vehicles[P.thrust_half_range, k],
            tilting,
            actions[i],
        )


@inner
def reference_acceleration(state, i, lag, attitude):
    """Return the acceleration of the reference at the time when the vehicle can have it, world
    frame, m/s².

    Upwards, that is when a command acts; sideways, only after the vehicle has also turned.
    """
    now = vector_at(state, X.target_acceleration, i)
    dx, dy, dz = subtract(vector_at(state, X.target_ahead, i), now)
    upwards = lag / AHEAD
    sideways = upwards + 1.0 / (attitude * AHEAD)
    return add(now, (sideways * dx, sideways * dy, upwards * dz))


@inner
def yaw_moment(state, i, body_to_world, r, gains, izz):
    """Return the yaw moment against the yaw rate, or towards the commanded heading, N m.

    The heading is where the body's x axis points, seen from above.
    """
    cosine, sine, _ = vector_at(state, X.target_heading, i)
    if cosine == sine == 0.0:
        return -gains[G.yaw_rate] * izz * r
    # Critically damped, and as quick as roll and pitch.
    wanted = desired_yaw_rate(state, i, body_to_world, gains)
    return gains[G.body_rates] * izz * (wanted - r)


@inner
def desired_yaw_rate(state, i, body_to_world, gains):
    """Return the yaw rate towards the commanded heading, rad/s; 0 without one."""
    cosine, sine, rate = vector_at(state, X.target_heading, i)
    if cosine == sine == 0.0:
        return 0.0
    (x, _, _), (y, _, _), (_, _, upright) = body_to_world
    error = math.atan2(sine * x - cosine * y, cosine * x + sine * y)
    return upright * (rate + 0.25 * gains[G.body_rates] * error)


@inner
def desired_force(e, v, a, gains, g):
    """Return the desired force of the rotors per mass, world frame, m/s².

    :param e: vector to the target, m.
    :param v: velocity, m/s.
    :param a: acceleration by the external force, m/s².
    """
    ex, ey, ez = e
    vx, vy, vz = v
    ax, ay, az = a

    # Plan for less deceleration if the external force accelerates the vehicle towards the target.
    distance = math.sqrt(ex * ex + ey * ey)
    along = 0.0
    if distance > 0.0:
        along = (ax * ex + ay * ey) / distance
    brake = left_to_brake(gains[G.deceleration], along)
    if ez > 0.0:
        height_brake = left_to_brake(gains[G.height_deceleration], az)
    else:
        height_brake = left_to_brake(gains[G.descent_deceleration], -az)

    # Both components brake at once, so the path is a straight line.
    way = math.sqrt((distance / brake) ** 2 + (ez / height_brake) ** 2)
    speed = braking_profile(gains[G.position], way)
    climb_speed = braking_profile(gains[G.height_position], way)
    fx = gains[G.velocity] * (speed * ex - vx)
    fy = gains[G.velocity] * (speed * ey - vy)
    fz = max(-gains[G.descent], gains[G.height_velocity] * (climb_speed * ez - vz))

    # The force may be as large as the one that keeps the height at the greatest tilt. The largest λ
    # that keeps |λ (fx, fy, fz) + (0, 0, g) - a| within that solves a quadratic equation: λ² square
    # + 2 λ across = room.
    weight = g - az
    square = dot((fx, fy, fz), (fx, fy, fz))
    across = fz * weight - fx * ax - fy * ay
    limit = g * g * (1.0 + gains[G.tilt] * gains[G.tilt])
    room = limit - dot((weight, ax, ay), (weight, ax, ay))
    scale = 1.0
    if square + 2.0 * across > room:
        root = math.sqrt(max(0.0, across * across + square * max(0.0, room)))
        scale = max(0.0, root - across) / square

    # The force points upwards, so that it has a tilt.
    return scale * fx - ax, scale * fy - ay, max(0.1 * g, weight + scale * fz)


@inner
def braking_profile(gain, distance_by_deceleration):
    """Return the speed per distance from which the vehicle can still brake.

    Near the target it is the gain; far away it follows from the speed √(2 deceleration distance).
    """
    return 2.0 * gain / (1.0 + math.sqrt(1.0 + 2.0 * gain * gain * distance_by_deceleration))


@inner
def left_to_brake(deceleration, forward):
    """Return the deceleration to plan with if something else accelerates by ``forward``."""
    return max(0.1 * deceleration, deceleration - max(0.0, forward))


@inner
def seen_later(b, omega, time):
    """Return a direction fixed in the world as the body sees it after turning for some time.

    This is Rodrigues' formula for exp(-ω× t) b, with the present body rates ω.
    """
    rate = math.sqrt(dot(omega, omega))
    if rate < 1e-9:
        return b
    n = divide(omega, rate)
    n_cross_b = cross(n, b)
    cosine = math.cos(rate * time)
    sine = -math.sin(rate * time)
    shares = cosine, sine, dot(n, b) * (1.0 - cosine)
    return (
        dot(shares, (b[0], n_cross_b[0], n[0])),
        dot(shares, (b[1], n_cross_b[1], n[1])),
        dot(shares, (b[2], n_cross_b[2], n[2])),
    )


@inner
def desired_turn(b, omega, gains):
    """Return the rate, rad/s, at which the thrust has to turn to direction b, and x and y of the
    axis, body frame.
    """
    p, q, _ = omega
    deceleration = gains[G.angular_deceleration]

    # Turn by the angle α about the axis n, which is level in the body.
    sine = math.sqrt(b[0] * b[0] + b[1] * b[1])
    alpha = math.atan2(sine, b[2])
    nx = 1.0
    ny = 0.0
    if sine > 1e-9:
        nx = -b[1] / sine
        ny = b[0] / sine

    # Go the long way round if the present spin makes that quicker. What is compared is the time in
    # which a double integrator comes to rest at the direction, times the deceleration.
    along = p * nx + q * ny
    half_square = 0.5 * along * along
    short = -along + 2.0 * math.sqrt(half_square + deceleration * alpha)
    long = along + 2.0 * math.sqrt(half_square + deceleration * (2.0 * math.pi - alpha))
    if long < short:
        nx = -nx
        ny = -ny
        alpha = 2.0 * math.pi - alpha
    return alpha * braking_profile(gains[G.attitude], alpha / deceleration), nx, ny


@inner
def turn_moments(rate, nx, ny, omega, gains, inertia):
    """Return the roll and pitch moments for a turn, see :func:`desired_turn`, body frame, N m."""
    p, q, r = omega
    ixx, iyy, izz = inertia
    # The desired rates stay fixed in the world while the body yaws. Then add Euler's gyroscopic
    # terms.
    p_dot = gains[G.body_rates] * (rate * nx - p) + r * rate * ny
    q_dot = gains[G.body_rates] * (rate * ny - q) - r * rate * nx
    return ixx * p_dot + (izz - iyy) * q * r, iyy * q_dot + (ixx - izz) * r * p


@inner
def allocate(thrust, moments, mixer_inverse, thrust_middle, thrust_half_range, tilting, actions):
    """Write the actions of one vehicle that produce a thrust, N, and moments, N m.

    Roll and pitch take precedence over the thrust, and the thrust over yaw, all within the limits
    of every rotor, ``thrust_middle`` ± ``thrust_half_range``, N.

    :param tilting: scratch memory for the rotor thrusts that roll and pitch require, (4,), N.
    """
    low = thrust_middle - thrust_half_range
    high = thrust_middle + thrust_half_range

    # Rotors provide their shares of the thrust, and what roll and pitch require of them. All of it
    # is in terms of the whole thrust: the rotor with the greatest share bounds it from above, and
    # the one with the smallest from below. Scale what roll and pitch require until it fits; then
    # shift the thrust.
    shares = mixer_inverse[:, 0]
    least = 0.0
    most = 0.0
    for rotor in range(4):
        part = mixer_inverse[rotor, 1] * moments[0] + mixer_inverse[rotor, 2] * moments[1]
        tilting[rotor] = part / shares[rotor]
        least = min(least, tilting[rotor])
        most = max(most, tilting[rotor])
    highest = high / shares.max()
    lowest = min(highest, low / shares.min())
    scale = 1.0
    if most - least > highest - lowest:
        scale = (highest - lowest) / (most - least)
    thrust = min(highest - scale * most, max(lowest - scale * least, thrust))

    # The share of the yaw moment that every rotor has room for. The thrusts without yaw overwrite
    # those in ``tilting``.
    share = 1.0
    without_yaw = tilting
    for rotor in range(4):
        without_yaw[rotor] = shares[rotor] * (thrust + scale * tilting[rotor])
        yaw = mixer_inverse[rotor, 3] * moments[2]
        room = without_yaw[rotor] - low
        if yaw > 0.0:
            room = high - without_yaw[rotor]
        if abs(yaw) * share > room:
            share = max(0.0, room / abs(yaw))

    # Eq. 3.18: actions are thrusts between the limits, as numbers from -1 to 1.
    for rotor in range(4):
        yaw = share * mixer_inverse[rotor, 3] * moments[2]
        action = (without_yaw[rotor] + yaw - thrust_middle) / thrust_half_range
        actions[rotor] = min(1.0, max(-1.0, action))
