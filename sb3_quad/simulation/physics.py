"""The physics of one control step of a block: the rotors (Eq. 4.1), the external wrench, and
PyBullet's integrator.

The rotors are the same where PyBullet moves the body.

A physics step is what PyBullet computes for the floating base of a multibody. First come the
explicit updates v += dt F/m and ω += dt I⁻¹(τ - ω×Iω). Then the world components of v and ω are
limited to ±100. Last, the new velocities move position and attitude, the attitude by the exact
exponential of ω dt. The difference from PyBullet is rounding (1e-12 over 400 control steps).

The body rates are kept in the body frame: a rotation about ω leaves ω as it is, so PyBullet's
world-frame update is the same.

Functions with a ``lane`` compute one vehicle of a block, the others a whole block. The loops over
three axes are written out where each axis has a formula of its own.
"""

import math

from sb3_quad.simulation.compiled import LANES, compiled, fast, inlined

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
def vector(rows, lane):
    """Return x, y and z of a lane."""
    return rows[0, lane], rows[1, lane], rows[2, lane]


@inlined
def four(rows, lane):
    """Return the four numbers of a lane, such as those of its quaternion."""
    return rows[0, lane], rows[1, lane], rows[2, lane], rows[3, lane]


@inlined
def store(rows, lane, x, y, z):
    """Write x, y and z of a lane."""
    rows[0, lane] = x
    rows[1, lane] = y
    rows[2, lane] = z


@inlined
def to_world(r, x, y, z):
    """Rotate a vector from the body frame to the world frame."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = r
    return xx * x + xy * y + xz * z, yx * x + yy * y + yz * z, zx * x + zy * y + zz * z


@inlined
def to_body(r, x, y, z):
    """Rotate a vector from the world frame to the body frame."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = r
    return xx * x + yx * y + zx * z, xy * x + yy * y + zy * z, xz * x + yz * y + zz * z


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
    return math.sqrt(b.thrust_middle[lane] + b.thrust_half_range[lane] * bounded)


@inlined
def limit_speeds(b, speeds, lane):
    """Keep the commanded rotor speeds of a lane, (4, LANES), to what its battery allows, in place.

    With a saturation of each, a rotor takes the greatest speed alone. With a shared one, what the
    fastest command exceeds it by is taken off all four, down to zero: their differences, and so the
    moments, stay.
    """
    greatest = b.greatest_speed[lane]
    s0, s1, s2, s3 = four(speeds, lane)
    excess = max(max(max(s0, s1), max(s2, s3)) - greatest, 0.0) * b.shared[lane]
    for k in range(4):
        speeds[k, lane] = max(min(speeds[k, lane] - excess, greatest), 0.0)


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
    # Both factors are read whichever is taken: else LLVM does not vectorise the loop over lanes.
    speeding_up = b.motor[0, lane]
    slowing_down = b.motor[1, lane]
    for k in range(4):
        old = b.rotor_speeds[k, lane]
        missing = b.wanted_speeds[k, lane] - old
        new = old + missing * (speeding_up if missing > 0.0 else slowing_down)
        b.thrust[k, lane] = b.lift[lane] * new * (new + b.exact[lane] * (old - new))
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


@fast
def accelerate(b):
    """Advance rotor speeds, velocities and body rates by a physics step, in place.

    :return: whether some velocity may exceed PyBullet's limit.
    """
    v = b.velocity
    w = b.body_rates
    for lane in range(LANES):
        # The rotors come first: their thrusts are those of this physics step.
        turn_rotors(b, lane)
        r = rotation(b.quaternion, lane)

        # The force without gravity, first in the body frame. Drag is that of the airspeed.
        vx, vy, vz = vector(v, lane)
        wind_x, wind_y, wind_z = vector(b.wind, lane)
        ux, uy, uz = to_body(r, vx - wind_x, vy - wind_y, vz - wind_z)
        fx = b.force_body[0, lane] - b.drag[0, lane] * ux
        fy = b.force_body[1, lane] - b.drag[1, lane] * uy
        fz = b.force_body[2, lane] - b.drag[2, lane] * uz + total_thrust(b, lane)
        fx, fy, fz = to_world(r, fx, fy, fz)
        vx += b.velocity_gain[lane] * (b.force_world[0, lane] + fx)
        vy += b.velocity_gain[lane] * (b.force_world[1, lane] + fy)
        vz += b.velocity_gain[lane] * (b.force_world[2, lane] + fz) - b.fall[lane]

        # Euler's equations in the body frame
        gx, gy, gz = vector(b.torque_world, lane)
        tx, ty, tz = to_body(r, gx, gy, gz)
        wx, wy, wz = vector(w, lane)
        tx += b.torque_body[0, lane] - b.gyro[0, lane] * wy * wz + moment(b, 0, lane)
        ty += b.torque_body[1, lane] - b.gyro[1, lane] * wz * wx + moment(b, 1, lane)
        tz += b.torque_body[2, lane] - b.gyro[2, lane] * wx * wy + moment(b, 2, lane)
        wx += b.rates_gain[0, lane] * tx
        wy += b.rates_gain[1, lane] * ty
        wz += b.rates_gain[2, lane] * tz

        store(v, lane, vx, vy, vz)
        store(w, lane, wx, wy, wz)
        b.speed2[lane] = max(wx * wx + wy * wy + wz * wz, vx * vx + vy * vy + vz * vz)
    # In a loop of its own: a sum over lanes keeps the one above from being vectorised.
    over = 0
    for lane in range(LANES):
        over += b.speed2[lane] > MAX_COORDINATE_VELOCITY * MAX_COORDINATE_VELOCITY
    return over > 0


@compiled
def _limit(value):
    return min(max(value, -MAX_COORDINATE_VELOCITY), MAX_COORDINATE_VELOCITY)


@compiled
def limit_velocities(b):
    """Limit each world component of v and ω as PyBullet does, in the rare lanes that exceed it."""
    v = b.velocity
    w = b.body_rates
    for lane in range(LANES):
        for k in range(3):
            v[k, lane] = _limit(v[k, lane])
        wx, wy, wz = vector(w, lane)
        if wx * wx + wy * wy + wz * wz <= MAX_COORDINATE_VELOCITY * MAX_COORDINATE_VELOCITY:
            continue
        r = rotation(b.quaternion, lane)
        wx, wy, wz = to_world(r, wx, wy, wz)
        wx, wy, wz = to_body(r, _limit(wx), _limit(wy), _limit(wz))
        store(w, lane, wx, wy, wz)


@inlined
def quaternion_product(qw, qx, qy, qz, aw, ax, ay, az):
    """Return the product of two quaternions."""
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
    q = b.quaternion
    half_step = 0.5 * dt
    for lane in range(LANES):
        for k in range(3):
            b.position[k, lane] += dt * b.velocity[k, lane]
        wx, wy, wz = vector(b.body_rates, lane)
        hx = half_step * wx
        hy = half_step * wy
        hz = half_step * wz
        sinc, cosine = sinc_and_cosine(hx * hx + hy * hy + hz * hz)
        qw, qx, qy, qz = four(q, lane)
        nw, nx, ny, nz = quaternion_product(qw, qx, qy, qz, cosine, sinc * hx, sinc * hy, sinc * hz)
        scale = 1.5 - 0.5 * (nw * nw + nx * nx + ny * ny + nz * nz)
        q[0, lane] = nw * scale
        store(q[1:], lane, nx * scale, ny * scale, nz * scale)


@inlined
def fly(b, physics_step, substeps):
    """Compute the physics steps of one control step of a loaded block, in place."""
    for _ in range(substeps):
        if accelerate(b):
            limit_velocities(b)
        move(b, physics_step)
