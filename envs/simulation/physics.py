"""The physics of one control step of a block: the rotors (Eq. 4.1), the external wrench, and
PyBullet's integrator.

The rotors are computed here even if PyBullet moves the body.

A physics step is what PyBullet computes for the floating base of a multibody. First come the
explicit updates v += dt F/m and ω += dt I⁻¹(τ - ω×Iω). Then the world components of v and ω are
limited to ±100. Last, the new velocities move position and attitude, the attitude by the exact
exponential of ω dt. The difference from PyBullet is rounding (1e-12 over 400 control steps).

The body rates are kept in the body frame: a rotation about ω leaves ω as it is, so PyBullet's
world-frame update is the same.

Functions with a ``lane`` compute one vehicle of a block, the others a whole block.
"""

import math

from sb3_quad.base.compiled import LANES, called, fast, inlined, inner
from sb3_quad.envs.simulation.aerodynamics import (
    air_force,
    air_moment,
    rotor_momentum,
    scale_thrusts,
    speed_sum,
)
from sb3_quad.envs.simulation.rate_loop import control_rates
from sb3_quad.envs.simulation.vectors import (
    add,
    dot,
    four,
    matvec,
    multiply,
    scaled,
    store,
    subtract,
    transposed,
    vector,
)

MAX_COORDINATE_VELOCITY = 100.0  # btMultiBody's m_maxCoordinateVelocity, m/s and rad/s


@inlined
def rotation_rows(qw, qx, qy, qz):
    """Return the rotation matrix of a unit quaternion, body to world, row by row."""
    return (
        (1.0 - 2.0 * (qy * qy + qz * qz), 2.0 * (qx * qy - qw * qz), 2.0 * (qx * qz + qw * qy)),
        (2.0 * (qx * qy + qw * qz), 1.0 - 2.0 * (qx * qx + qz * qz), 2.0 * (qy * qz - qw * qx)),
        (2.0 * (qx * qz - qw * qy), 2.0 * (qy * qz + qw * qx), 1.0 - 2.0 * (qx * qx + qy * qy)),
    )


@inlined
def rotation(quaternion, lane):
    """Return the rotation matrix of a lane, body to world, row by row."""
    qw, qx, qy, qz = four(quaternion, lane)
    return rotation_rows(qw, qx, qy, qz)


@inlined
def to_world(r, a):
    """Rotate a vector from the body frame to the world frame."""
    return matvec(r, a)


@inlined
def to_body(r, a):
    """Rotate a vector from the world frame to the body frame."""
    return matvec(transposed(r), a)


@fast
def command_rotors(b):
    """Replace the actions in ``b.command`` by the rotor speeds that they command."""
    for lane in range(LANES):
        for k in range(4):
            b.command[k, lane] = rotor_speed(b, lane, b.command[k, lane])
        limit_speeds(b, b.command, lane)


@inlined
def rotor_speed(b, lane, action):
    """Return the rotor speed that an action commands, rad/s (Eqs. 3.18 and 2.4)."""
    bounded = min(max(action, -1.0), 1.0)
    return math.sqrt(b.square_middle[lane] + b.square_half_range[lane] * bounded)


@inlined
def limit_speeds(b, speeds, lane):
    """Limit the commanded rotor speeds of a lane, (4, LANES), to what its battery allows, in place.

    If each rotor saturates by itself, its speed is clipped to the greatest one. If the saturation
    is shared, the excess of the fastest command is subtracted from all four, down to zero: their
    differences, and so the moments, stay.
    """
    greatest = b.greatest_speed[lane]
    s0, s1, s2, s3 = four(speeds, lane)
    excess = max(max(s0, s1, s2, s3) - greatest, 0.0) * b.shared_saturation[lane]
    for k in range(4):
        speeds[k, lane] = max(min(speeds[k, lane] - excess, greatest), 0.0)


@fast
def command_by_rates(b):
    """Let the rate loop command the rotors for a physics step."""
    control_rates(b)
    for lane in range(LANES):
        for k in range(4):
            b.wanted_speeds[k, lane] = b.command[k, lane]
        limit_speeds(b, b.wanted_speeds, lane)


@inlined
def motor_factor(gain, exact, dt):
    """Return the share of its error that a rotor speed loses in a physics step.

    It is km dt (Eq. 4.1), or with exact motors 1 - exp(-km dt), here by the (2, 2) Padé
    approximant, which is off by (km dt)⁵ / 720.
    """
    x = gain * dt
    return x / (1.0 + exact * (x / 2.0 + x * x / 12.0))


@inlined
def turn_rotors(b, lane):
    """Advance the rotor speeds of a lane by a physics step (Eq. 4.1), in place.

    Their thrusts in that step, N (Eq. 2.4), are written to ``b.thrust``. With the new speed Ω a
    thrust is kF Ω²; with exact motors it is that of the step's middle, kF Ω Ω_old.
    """
    # Read both factors whichever is used: otherwise LLVM does not vectorise the loop over lanes.
    speeding_up = b.motor[0, lane]
    slowing_down = b.motor[1, lane]
    for k in range(4):
        old = b.rotor_speeds[k, lane]
        missing = b.wanted_speeds[k, lane] - old
        new = old + missing * (speeding_up if missing > 0.0 else slowing_down)
        middle = new + b.exact_motors[lane] * (old - new)
        b.thrust[k, lane] = b.thrust_coefficient[lane] * new * middle
        b.rotor_speeds[k, lane] = new


@inlined
def total_thrust(b, lane):
    """Return the sum of the rotor thrusts, N."""
    f0, f1, f2, f3 = four(b.thrust, lane)
    return (f0 + f1) + (f2 + f3)


@inlined
def moment(b, axis, lane):
    """Return the moment of the rotor thrusts about a body axis, N m (Eq. 2.7, any layout)."""
    a0, a1, a2, a3 = four(b.arm[axis], lane)
    f0, f1, f2, f3 = four(b.thrust, lane)
    return (a0 * f0 + a1 * f1) + (a2 * f2 + a3 * f3)


@inlined
def _push(rows, lane, is_pushed):
    return vector(rows, lane) if is_pushed else (0.0, 0.0, 0.0)


@inlined
def _accelerate(b, lane, per_second, in_air, is_pushed):
    """Advance rotor speeds, velocity and body rates of a lane by a physics step, in place.

    :param per_second: 1 / dt, 1/s.
    :param in_air: a constant, whether the terms of :mod:`.aerodynamics` act; ``is_pushed``,
        likewise, see :func:`fly`.
    """
    momentum = 0.0
    if in_air:
        momentum = rotor_momentum(b, b.rotor_speeds, lane)
    # The rotors come first: their thrusts are those of this physics step.
    turn_rotors(b, lane)
    r = rotation(b.quaternion, lane)
    if in_air:
        scale_thrusts(b, b.position[2, lane], lane)

    # The force without gravity, first in the body frame. Drag is that of the airspeed.
    v = vector(b.velocity, lane)
    airspeed = to_body(r, subtract(v, _push(b.wind, lane, is_pushed)))
    drag = multiply(vector(b.drag, lane), airspeed)
    fx, fy, fz = subtract(_push(b.force_body, lane, is_pushed), drag)
    total = 0.0
    if in_air:
        total = speed_sum(b.rotor_speeds, lane)
        fx, fy, fz = add((fx, fy, fz), air_force(b, airspeed, total, lane))
    force = to_world(r, (fx, fy, fz + total_thrust(b, lane)))
    force = add(_push(b.force_world, lane, is_pushed), force)
    fall = (0.0, 0.0, b.fall[lane])
    v = add(v, subtract(scaled(b.velocity_gain[lane], force), fall))

    # Euler's equations in the body frame
    torque = to_body(r, _push(b.torque_world, lane, is_pushed))
    w = vector(b.body_rates, lane)
    wx, wy, wz = w
    in_body = _push(b.torque_body, lane, is_pushed)
    gyroscopic = multiply(vector(b.gyro, lane), (wy * wz, wz * wx, wx * wy))
    moments = moment(b, 0, lane), moment(b, 1, lane), moment(b, 2, lane)
    torque = add(torque, add(subtract(in_body, gyroscopic), moments))
    if in_air:
        after = rotor_momentum(b, b.rotor_speeds, lane)
        reaction = 0.0, 0.0, (momentum - after) * per_second
        torque = add(torque, add(air_moment(b, airspeed, w, total, after, lane), reaction))
    w = add(w, multiply(vector(b.rates_gain, lane), torque))

    store(b.velocity, lane, v)
    store(b.body_rates, lane, w)
    b.speed2[lane] = max(dot(w, w), dot(v, v))


@fast
def accelerate(b, is_pushed):
    """Advance rotor speeds, velocities and body rates by a physics step without air, in place."""
    if is_pushed:
        for lane in range(LANES):
            _accelerate(b, lane, 1.0, False, True)
    else:
        for lane in range(LANES):
            _accelerate(b, lane, 1.0, False, False)


@inner(fastmath=True, forceinline=False)
def accelerate_in_air(b, dt, is_pushed):
    """Advance them with the terms of :mod:`.aerodynamics`. It is not a part of its caller, which
    would then fly more slowly without air.
    """
    per_second = 1.0 / dt
    if is_pushed:
        for lane in range(LANES):
            _accelerate(b, lane, per_second, True, True)
    else:
        for lane in range(LANES):
            _accelerate(b, lane, per_second, True, False)


@fast
def _may_exceed(b):
    """Return whether some velocity may exceed PyBullet's limit."""
    over = 0
    for lane in range(LANES):
        over += b.speed2[lane] > MAX_COORDINATE_VELOCITY * MAX_COORDINATE_VELOCITY
    return over > 0


@inner
def _limited(a):
    low, high = -MAX_COORDINATE_VELOCITY, MAX_COORDINATE_VELOCITY
    x, y, z = a
    return min(max(x, low), high), min(max(y, low), high), min(max(z, low), high)


@called
def limit_velocities(b):
    """Limit each world component of v and ω as PyBullet does, in the rare lanes that exceed it."""
    for lane in range(LANES):
        store(b.velocity, lane, _limited(vector(b.velocity, lane)))
        w = vector(b.body_rates, lane)
        if dot(w, w) > MAX_COORDINATE_VELOCITY * MAX_COORDINATE_VELOCITY:
            r = rotation(b.quaternion, lane)
            store(b.body_rates, lane, to_body(r, _limited(to_world(r, w))))


@inlined
def quaternion_product(q, a):
    """Return the product of two quaternions."""
    qw, qx, qy, qz = q
    aw, ax, ay, az = a
    return (
        qw * aw - qx * ax - qy * ay - qz * az,
        qw * ax + qx * aw + qy * az - qz * ay,
        qw * ay - qx * az + qy * aw + qz * ax,
        qw * az + qx * ay - qy * ax + qz * aw,
    )


@inlined
def sinc_and_cosine(h2):
    """Return sin(h)/h and cos(h) of h², by their series, for h up to 0.2166."""
    # Horner's scheme, from the last term to the first
    sinc = 1.0 - h2 / 42.0 * (1.0 - h2 / 72.0 * (1.0 - h2 / 110.0))
    sinc = 1.0 - h2 / 6.0 * (1.0 - h2 / 20.0 * sinc)
    cosine = 1.0 - h2 / 56.0 * (1.0 - h2 / 90.0 * (1.0 - h2 / 132.0))
    cosine = 1.0 - h2 / 2.0 * (1.0 - h2 / 12.0 * (1.0 - h2 / 30.0 * cosine))
    return sinc, cosine


@fast
def move(b, dt):
    """Move position and attitude by the new velocities, in place.

    h = dt |ω| / 2 stays below 0.2166, since a physics step is at most 0.0025 s and the limit of 100
    lets no greater ω through. There the series of sin(h)/h to h¹⁰ and of cos(h) to h¹² are exact to
    double precision. The new quaternion is off unit norm by rounding only; one step of Newton's
    method corrects it.
    """
    for lane in range(LANES):
        way = scaled(dt, vector(b.velocity, lane))
        store(b.position, lane, add(vector(b.position, lane), way))
        h = scaled(0.5 * dt, vector(b.body_rates, lane))
        sinc, cosine = sinc_and_cosine(dot(h, h))
        w, x, y, z = quaternion_product(four(b.quaternion, lane), (cosine, *scaled(sinc, h)))
        scale = 1.5 - 0.5 * (w * w + x * x + y * y + z * z)
        b.quaternion[0, lane] = w * scale
        store(b.quaternion[1:], lane, scaled(scale, (x, y, z)))


@inlined
def fly(b, physics_step, substeps, in_air, by_rates, is_pushed):
    """Compute the physics steps of one control step of a loaded block, in place.

    :param by_rates: whether the rate loop commands the rotors.
    :param is_pushed: whether a wrench or wind acts; otherwise neither has to be loaded.
    """
    for _ in range(substeps):
        if by_rates:
            command_by_rates(b)
        if in_air:
            accelerate_in_air(b, physics_step, is_pushed)
        else:
            accelerate(b, is_pushed)
        if _may_exceed(b):
            limit_velocities(b)
        move(b, physics_step)
