"""The physics of one control step of a block: the rotors (Eq. 4.1), the external wrench, and
PyBullet's integrator.

The rotors are the same where PyBullet moves the body.

Per physics step, as PyBullet does it for the floating base of a multibody: v += dt F/m and ω += dt
I⁻¹(τ - ω×Iω), explicit; world components of v and ω cut at 100; then position and attitude by the
new velocities, the attitude by the exact exponential of ω dt. Against PyBullet the difference is
rounding (1e-12 over 400 control steps).

The body rates stay in the body frame: a rotation about ω leaves ω as it is, so that PyBullet's
world-frame sum is the same.
"""

import math

from sb3_quad.simulation.compiled import LANES, compiled

MAX_COORDINATE_VELOCITY = 100.0  # btMultiBody's m_maxCoordinateVelocity, m/s and rad/s


@compiled(inline="always")
def rotation_rows(qw, qx, qy, qz):
    """The rotation matrix of a unit quaternion, body to world, row by row."""
    return (
        (1.0 - 2.0 * (qy * qy + qz * qz), 2.0 * (qx * qy - qw * qz), 2.0 * (qx * qz + qw * qy)),
        (2.0 * (qx * qy + qw * qz), 1.0 - 2.0 * (qx * qx + qz * qz), 2.0 * (qy * qz - qw * qx)),
        (2.0 * (qx * qz - qw * qy), 2.0 * (qy * qz + qw * qx), 1.0 - 2.0 * (qx * qx + qy * qy)),
    )


@compiled(fastmath=True)
def command_rotors(b):
    """``b.command``: rotor speeds from actions (Eqs. 3.18 and 2.4), in place."""
    for lane in range(LANES):
        for k in range(4):
            action = min(max(b.command[k, lane], -1.0), 1.0)
            b.command[k, lane] = math.sqrt(
                b.thrust_middle[lane] + b.thrust_half_range[lane] * action
            )


@compiled(inline="always")
def motor_factor(gain, exact, dt):
    """Share of its error that a rotor speed loses in a physics step: km dt, or with exact motors 1
    - exp(-km dt).

    The exponential is (2, 2) Padé's, off by (km dt)⁵ / 720.
    """
    x = gain * dt
    return x / (1.0 + exact * (x / 2.0 + x * x / 12.0))


@compiled(inline="always")
def turn_rotors(b, lane):
    """The rotor speeds of a lane one physics step later (Eq. 4.1), in place; their thrusts in it, N
    (Eq. 2.4).

    A thrust is that of the new speed Ω, kF Ω², or with exact motors that of the step's middle, kF Ω
    Ω_old.
    """
    s, wanted, up, down = b.rotor_speeds, b.wanted_speeds, b.motor[0, lane], b.motor[1, lane]
    missing0, missing1 = wanted[0, lane] - s[0, lane], wanted[1, lane] - s[1, lane]
    missing2, missing3 = wanted[2, lane] - s[2, lane], wanted[3, lane] - s[3, lane]
    s0 = s[0, lane] + missing0 * (up if missing0 > 0.0 else down)
    s1 = s[1, lane] + missing1 * (up if missing1 > 0.0 else down)
    s2 = s[2, lane] + missing2 * (up if missing2 > 0.0 else down)
    s3 = s[3, lane] + missing3 * (up if missing3 > 0.0 else down)
    lift, exact = b.lift[lane], b.exact[lane]
    f0, f1 = (
        lift * s0 * (s0 + exact * (s[0, lane] - s0)),
        lift * s1 * (s1 + exact * (s[1, lane] - s1)),
    )
    f2, f3 = (
        lift * s2 * (s2 + exact * (s[2, lane] - s2)),
        lift * s3 * (s3 + exact * (s[3, lane] - s3)),
    )
    s[0, lane], s[1, lane], s[2, lane], s[3, lane] = s0, s1, s2, s3
    return f0, f1, f2, f3


@compiled(inline="always")
def moment(b, axis, lane, f0, f1, f2, f3):
    """The moment of rotor thrusts about a body axis, N m (Eq. 2.7, any layout)."""
    arm = b.arm
    return (arm[axis, 0, lane] * f0 + arm[axis, 1, lane] * f1) + (
        arm[axis, 2, lane] * f2 + arm[axis, 3, lane] * f3
    )


@compiled(fastmath=True)
def accelerate(b):
    """Rotor speeds, velocities and body rates after one physics step; whether some may exceed
    PyBullet's cut.
    """
    q, v, w, gyro, twist, largest = (
        b.quaternion,
        b.velocity,
        b.body_rates,
        b.gyro,
        b.twist,
        b.work[0],
    )
    drag, wind = b.drag, b.wind
    force_world, force_body, torque_world, torque_body = (
        b.force_world,
        b.force_body,
        b.torque_world,
        b.torque_body,
    )
    for lane in range(LANES):
        f0, f1, f2, f3 = turn_rotors(b, lane)
        (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = rotation_rows(
            q[0, lane], q[1, lane], q[2, lane], q[3, lane]
        )
        ux, uy, uz = (
            v[0, lane] - wind[0, lane],
            v[1, lane] - wind[1, lane],
            v[2, lane] - wind[2, lane],
        )
        fx = force_body[0, lane] - drag[0, lane] * (r00 * ux + r10 * uy + r20 * uz)
        fy = force_body[1, lane] - drag[1, lane] * (r01 * ux + r11 * uy + r21 * uz)
        fz = (
            force_body[2, lane]
            - drag[2, lane] * (r02 * ux + r12 * uy + r22 * uz)
            + ((f0 + f1) + (f2 + f3))
        )
        push = b.push[lane]
        vx = v[0, lane] + push * (force_world[0, lane] + r00 * fx + r01 * fy + r02 * fz)
        vy = v[1, lane] + push * (force_world[1, lane] + r10 * fx + r11 * fy + r12 * fz)
        vz = (
            v[2, lane]
            + push * (force_world[2, lane] + r20 * fx + r21 * fy + r22 * fz)
            - b.fall[lane]
        )
        v[0, lane], v[1, lane], v[2, lane] = vx, vy, vz

        gx, gy, gz = torque_world[0, lane], torque_world[1, lane], torque_world[2, lane]
        wx, wy, wz = w[0, lane], w[1, lane], w[2, lane]
        tx = torque_body[0, lane] + r00 * gx + r10 * gy + r20 * gz - gyro[0, lane] * wy * wz
        ty = torque_body[1, lane] + r01 * gx + r11 * gy + r21 * gz - gyro[1, lane] * wz * wx
        tz = torque_body[2, lane] + r02 * gx + r12 * gy + r22 * gz - gyro[2, lane] * wx * wy
        tx += moment(b, 0, lane, f0, f1, f2, f3)
        ty += moment(b, 1, lane, f0, f1, f2, f3)
        tz += moment(b, 2, lane, f0, f1, f2, f3)
        wx += twist[0, lane] * tx
        wy += twist[1, lane] * ty
        wz += twist[2, lane] * tz
        w[0, lane], w[1, lane], w[2, lane] = wx, wy, wz
        largest[lane] = max(wx * wx + wy * wy + wz * wz, vx * vx + vy * vy + vz * vz)
    over = 0
    for lane in range(LANES):
        over += largest[lane] > MAX_COORDINATE_VELOCITY * MAX_COORDINATE_VELOCITY
    return over > 0


@compiled
def _cut(value):
    return min(max(value, -MAX_COORDINATE_VELOCITY), MAX_COORDINATE_VELOCITY)


@compiled
def limit_velocities(b):
    """PyBullet's cut of each world component of v and ω, in the rare lanes that exceed it."""
    q, v, w = b.quaternion, b.velocity, b.body_rates
    for lane in range(LANES):
        for k in range(3):
            v[k, lane] = _cut(v[k, lane])
        x, y, z = w[0, lane], w[1, lane], w[2, lane]
        if x * x + y * y + z * z <= MAX_COORDINATE_VELOCITY * MAX_COORDINATE_VELOCITY:
            continue
        (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = rotation_rows(
            q[0, lane], q[1, lane], q[2, lane], q[3, lane]
        )
        wx = _cut(r00 * x + r01 * y + r02 * z)
        wy = _cut(r10 * x + r11 * y + r12 * z)
        wz = _cut(r20 * x + r21 * y + r22 * z)
        w[0, lane] = r00 * wx + r10 * wy + r20 * wz
        w[1, lane] = r01 * wx + r11 * wy + r21 * wz
        w[2, lane] = r02 * wx + r12 * wy + r22 * wz


@compiled(inline="always")
def _turned(qw, qx, qy, qz, aw, ax, ay, az):
    """The product of two quaternions."""
    return (
        qw * aw - qx * ax - qy * ay - qz * az,
        qw * ax + qx * aw + qy * az - qz * ay,
        qw * ay - qx * az + qy * aw + qz * ax,
        qw * az + qx * ay - qy * ax + qz * aw,
    )


@compiled(fastmath=True)
def move(b, dt):
    """Position and attitude by the new velocities.

    h = dt |ω| / 2 stays below 0.2166, since a physics step is at most 0.0025 s and the cut at 100
    lets no greater ω through. There sin(h)/h to h¹⁰ and cos(h) to h¹² are exact to double
    precision, and the new quaternion is off unit norm by rounding only, which one step of Newton's
    method takes back.
    """
    q, x, v, w, half_step = b.quaternion, b.position, b.velocity, b.body_rates, 0.5 * dt
    for lane in range(LANES):
        for k in range(3):
            x[k, lane] += dt * v[k, lane]
        ax, ay, az = half_step * w[0, lane], half_step * w[1, lane], half_step * w[2, lane]
        h2 = ax * ax + ay * ay + az * az
        sinc = 1.0 - h2 / 6.0 * (
            1.0 - h2 / 20.0 * (1.0 - h2 / 42.0 * (1.0 - h2 / 72.0 * (1.0 - h2 / 110.0)))
        )
        aw = 1.0 - h2 / 2.0 * (
            1.0
            - h2
            / 12.0
            * (1.0 - h2 / 30.0 * (1.0 - h2 / 56.0 * (1.0 - h2 / 90.0 * (1.0 - h2 / 132.0))))
        )
        ax *= sinc
        ay *= sinc
        az *= sinc
        nw, nx, ny, nz = _turned(q[0, lane], q[1, lane], q[2, lane], q[3, lane], aw, ax, ay, az)
        scale = 1.5 - 0.5 * (nw * nw + nx * nx + ny * ny + nz * nz)
        q[0, lane], q[1, lane], q[2, lane], q[3, lane] = (
            nw * scale,
            nx * scale,
            ny * scale,
            nz * scale,
        )


@compiled(inline="always")
def fly(b, physics_step, substeps):
    """The physics steps of one control step of a loaded block, in place."""
    for _ in range(substeps):
        if accelerate(b):
            limit_velocities(b)
        move(b, physics_step)
