"""The adjoint of a control step: carry the gradient of a flight's cost from the state after the
step to the state before it.

``gradient`` arrays, float64 (MOVING, LANES), hold the derivative of the cost with respect to
the first ``MOVING`` rows of a block's state. Each function here undoes one function of
:mod:`.physics` or :mod:`.observation`: it turns the gradient with respect to the results into the
gradient with respect to the arguments.

The states between the physics steps of a control step are computed again: that costs less than
keeping them. Where PyBullet limits a velocity to 100 the derivative is taken as 1.
"""

import math

from sb3_quad.simulation.compiled import LANES, compiled
from sb3_quad.simulation.observation import OBSERVATION_SIZE, F, heading_of
from sb3_quad.simulation.physics import (
    fly,
    four,
    quaternion_product,
    rotation,
    sinc_and_cosine,
    store,
    to_body,
    to_world,
    total_thrust,
    vector,
)
from sb3_quad.simulation.state import X

MOVING = X.target  # the rows of the state that a flight changes


@compiled(inline="always")
def _add_rotation(quaternion, gradient, lane, x, y, z):
    """Add the gradient with respect to a quaternion, given that with respect to its rotation
    matrix, row by row.
    """
    qw, qx, qy, qz = four(quaternion, lane)
    (x0, x1, x2), (y0, y1, y2), (z0, z1, z2) = x, y, z
    k = X.quaternion
    gradient[k, lane] += 2.0 * (qz * (y0 - x1) + qy * (x2 - z0) + qx * (z1 - y2))
    gradient[k + 1, lane] += 2.0 * (
        qy * (x1 + y0) + qz * (x2 + z0) - 2.0 * qx * (y1 + z2) + qw * (z1 - y2)
    )
    gradient[k + 2, lane] += 2.0 * (
        qx * (x1 + y0) + qz * (y2 + z1) - 2.0 * qy * (x0 + z2) + qw * (x2 - z0)
    )
    gradient[k + 3, lane] += 2.0 * (
        qx * (x2 + z0) + qy * (y2 + z1) - 2.0 * qz * (x0 + y1) + qw * (y0 - x1)
    )


@compiled(inline="always")
def _add(gradient, row, lane, x, y, z):
    gradient[row, lane] += x
    gradient[row + 1, lane] += y
    gradient[row + 2, lane] += z


@compiled(fastmath=True)
def undo_move(before, after, gradient, dt):
    """Undo :func:`.physics.move`, in place.

    :param before: the state before the physics step, (MOVING, LANES), of which the attitude counts.
    :param after: the state after it, of which the body rates count.
    """
    half_step = 0.5 * dt
    k = X.quaternion
    for lane in range(LANES):
        for axis in range(3):
            gradient[X.velocity + axis, lane] += dt * gradient[X.position + axis, lane]

        # The new quaternion is n = q a, with a = (cos |h|, h sin |h| / |h|) and h = dt ω / 2.
        wx, wy, wz = vector(after[X.body_rates :], lane)
        hx, hy, hz = half_step * wx, half_step * wy, half_step * wz
        h2 = hx * hx + hy * hy + hz * hz
        sinc, cosine = sinc_and_cosine(h2)
        ax, ay, az = sinc * hx, sinc * hy, sinc * hz
        qw, qx, qy, qz = four(before[k:], lane)
        nw, nx, ny, nz = quaternion_product(qw, qx, qy, qz, cosine, ax, ay, az)

        # n is scaled by s = 1.5 - |n|² / 2, so the gradient g becomes s g - n (n g).
        gw, gx, gy, gz = four(gradient[k:], lane)
        scale = 1.5 - 0.5 * (nw * nw + nx * nx + ny * ny + nz * nz)
        along = nw * gw + nx * gx + ny * gy + nz * gz
        gw = scale * gw - along * nw
        gx = scale * gx - along * nx
        gy = scale * gy - along * ny
        gz = scale * gz - along * nz

        # A product with a quaternion is undone by one with its conjugate: g a* for q, q* g for a.
        tw, tx, ty, tz = quaternion_product(qw, -qx, -qy, -qz, gw, gx, gy, gz)
        gw, gx, gy, gz = quaternion_product(gw, gx, gy, gz, cosine, -ax, -ay, -az)
        gradient[k, lane] = gw
        store(gradient[k + 1 :], lane, gx, gy, gz)

        # (cos |h| - sin |h| / |h|) / |h|², the slope of the sinc over |h|, by Horner's scheme.
        slope = 1.0 - h2 / 28.0 * (1.0 - h2 / 54.0 * (1.0 - h2 / 88.0))
        slope = (h2 / 10.0 * slope - 1.0) / 3.0
        along = slope * (hx * tx + hy * ty + hz * tz) - sinc * tw
        _add(
            gradient,
            X.body_rates,
            lane,
            half_step * (sinc * tx + along * hx),
            half_step * (sinc * ty + along * hy),
            half_step * (sinc * tz + along * hz),
        )


@compiled(fastmath=True)
def undo_accelerate(b, before, after, gradient, grad_wanted):
    """Undo :func:`.physics.accelerate`, in place.

    :param b: a block whose vehicle, wrench, wind and wanted speeds are loaded.
    :param before: the state before the physics step, (MOVING, LANES), and ``after`` that after it.
    :param grad_wanted: (4, LANES), the gradient with respect to the wanted rotor speeds is added.
    """
    for lane in range(LANES):
        r = rotation(before[X.quaternion :], lane)

        # With respect to the torque in the body frame, and through the gyroscopic terms to the body
        # rates
        gain_x, gain_y, gain_z = vector(b.rates_gain, lane)
        tx, ty, tz = vector(gradient[X.body_rates :], lane)
        tx, ty, tz = gain_x * tx, gain_y * ty, gain_z * tz
        wx, wy, wz = vector(before[X.body_rates :], lane)
        gx, gy, gz = vector(b.gyro, lane)
        gx, gy, gz = gx * tx, gy * ty, gz * tz
        _add(
            gradient,
            X.body_rates,
            lane,
            -(gy * wz + gz * wy),
            -(gx * wz + gz * wx),
            -(gx * wy + gy * wx),
        )

        # With respect to the force: p in the world frame, c in the body frame
        px, py, pz = vector(gradient[X.velocity :], lane)
        gain = b.velocity_gain[lane]
        px, py, pz = gain * px, gain * py, gain * pz
        cx, cy, cz = to_body(r, px, py, pz)

        # With respect to the rotors: each thrust acts along the body's z axis and about all
        # three axes.
        for k in range(4):
            old, new = before[X.rotor_speeds + k, lane], after[X.rotor_speeds + k, lane]
            grad_thrust = (
                cz + b.arm[0, k, lane] * tx + b.arm[1, k, lane] * ty + b.arm[2, k, lane] * tz
            )
            lift, exact = b.lift[lane], b.exact[lane]
            grad_thrust *= lift
            b.thrust[k, lane] = lift * new * (new + exact * (old - new))
            grad_new = gradient[X.rotor_speeds + k, lane]
            grad_new += grad_thrust * (2.0 * new * (1.0 - exact) + exact * old)
            speeding_up, slowing_down = b.motor[0, lane], b.motor[1, lane]
            factor = speeding_up if b.wanted_speeds[k, lane] > old else slowing_down
            grad_wanted[k, lane] += factor * grad_new
            gradient[X.rotor_speeds + k, lane] = (
                1.0 - factor
            ) * grad_new + grad_thrust * exact * new

        # The force in the body frame, as it was: drag of the airspeed u, and the thrusts.
        vx, vy, vz = vector(before[X.velocity :], lane)
        wind_x, wind_y, wind_z = vector(b.wind, lane)
        ux, uy, uz = vx - wind_x, vy - wind_y, vz - wind_z
        bx, by, bz = to_body(r, ux, uy, uz)
        dx, dy, dz = vector(b.drag, lane)
        fx, fy, fz = vector(b.force_body, lane)
        fx -= dx * bx
        fy -= dy * by
        fz += total_thrust(b, lane) - dz * bz

        # With respect to the velocity, through the drag, and to the attitude: forces, drag and
        # torques turn.
        cx, cy, cz = -dx * cx, -dy * cy, -dz * cz
        x, y, z = to_world(r, cx, cy, cz)
        _add(gradient, X.velocity, lane, x, y, z)
        ox, oy, oz = vector(b.torque_world, lane)
        _add_rotation(
            before[X.quaternion :],
            gradient,
            lane,
            (px * fx + ux * cx + ox * tx, px * fy + ux * cy + ox * ty, px * fz + ux * cz + ox * tz),
            (py * fx + uy * cx + oy * tx, py * fy + uy * cy + oy * ty, py * fz + uy * cz + oy * tz),
            (pz * fx + uz * cx + oz * tx, pz * fy + uz * cy + oz * ty, pz * fz + uz * cz + oz * tz),
        )


@compiled
def undo_flight(b, substep_states, gradient, grad_wanted, dt, substeps):
    """Undo :func:`.physics.fly`: the physics steps of a control step, the last one first.

    :param b: a block with the state before the control step; its flight is computed again.
    :param substep_states: memory for the states in between, (substeps + 1, MOVING, LANES).
    :param grad_wanted: (4, LANES), is set to the gradient with respect to the wanted rotor speeds.
    """
    for substep in range(substeps):
        substep_states[substep] = b.state[:MOVING]
        fly(b, dt, 1)
    substep_states[substeps] = b.state[:MOVING]
    grad_wanted[:, :] = 0.0
    for substep in range(substeps - 1, -1, -1):
        undo_move(substep_states[substep], substep_states[substep + 1], gradient, dt)
        undo_accelerate(
            b, substep_states[substep], substep_states[substep + 1], gradient, grad_wanted
        )


@compiled
def undo_limits(b, grad_speed):
    """Undo :func:`.physics.limit_speeds`, in place.

    :param b: a block with the speeds before it, ``command``, and after it, ``wanted_speeds``.
    :param grad_speed: (4, LANES), with respect to the speeds after it.
    """
    for lane in range(LANES):
        fastest = 0
        for k in range(4):
            if b.command[k, lane] > b.command[fastest, lane]:
                fastest = k
        greatest = b.greatest_speed[lane]
        if b.command[fastest, lane] <= greatest:
            continue
        is_shared = b.shared[lane] > 0.0
        taken = 0.0
        for k in range(4):
            # What is taken off all may stop a rotor.
            stops = b.wanted_speeds[k, lane] == 0.0
            if stops or (b.command[k, lane] > greatest and not is_shared):
                grad_speed[k, lane] = 0.0
            taken += grad_speed[k, lane]
        if is_shared:
            grad_speed[fastest, lane] -= taken


@compiled(fastmath=True)
def undo_noise(b, grad_feature):
    """Undo noise and scaling of the features (Eq. 3.16), in place.

    :param b: a block whose features without noise, noise and scaling are computed.
    :param grad_feature: float64 (OBSERVATION_SIZE, LANES), with respect to the scaled features.
    """
    for k in range(OBSERVATION_SIZE):
        for lane in range(LANES):
            level, noise = b.noise_level[lane], b.noise[k, lane]
            slope = 1.0 + level * noise
            if b.additive[lane] > 0.0:
                relative = level * b.feature[k, lane]
                fixed = b.additive[lane] / b.inverse_std[k, lane]
                both = math.sqrt(relative * relative + fixed * fixed)
                slope = 1.0 + noise * level * relative / both
            grad_feature[k, lane] *= slope * b.inverse_std[k, lane]


@compiled(fastmath=True)
def undo_relation(b, grad_feature):
    """Undo what :func:`.observation.features` does for a reference that moves, in place."""
    f = grad_feature
    for lane in range(LANES):
        cosine, sine = heading_of(b, lane)
        rate = b.target_heading_rate[0, lane]
        for row in range(3):
            k = F.rotation + 3 * row
            x, y = f[k, lane], f[k + 1, lane]
            f[k, lane] = cosine * x - sine * y
            f[k + 1, lane] = sine * x + cosine * y
            f[k + 2, lane] -= rate * f[F.body_rates + row, lane]
            for axis in range(3):
                f[k + axis, lane] -= b.target_velocity[axis, lane] * f[F.velocity + row, lane]
        x, y = f[F.position, lane], f[F.position + 1, lane]
        f[F.position, lane] = cosine * x - sine * y
        f[F.position + 1, lane] = sine * x + cosine * y


@compiled(fastmath=True)
def undo_features(b, grad_feature, gradient, for_px4):
    """Undo :func:`.observation.features`: add to the gradient with respect to the state of a
    loaded block.

    :param grad_feature: float64 (OBSERVATION_SIZE, LANES), with respect to the features in
        their units.
    :param for_px4: whether the velocity has world axes.
    """
    f = grad_feature
    for lane in range(LANES):
        r = rotation(b.quaternion, lane)
        for k in range(3):
            gradient[X.position + k, lane] += f[F.position + k, lane]
            gradient[X.body_rates + k, lane] += f[F.body_rates + k, lane]
        # The observed velocity is Rᵀ v, or v itself, which the attitude does not turn.
        gx, gy, gz = vector(f[F.velocity :], lane)
        x, y, z = gx, gy, gz
        vx = vy = vz = 0.0
        if not for_px4:
            x, y, z = to_world(r, gx, gy, gz)
            vx, vy, vz = vector(b.velocity, lane)
        _add(gradient, X.velocity, lane, x, y, z)
        # The observed matrix is Rᵀ, row by row: its columns are the rows of R.
        m = F.rotation
        _add_rotation(
            b.quaternion,
            gradient,
            lane,
            (f[m, lane] + vx * gx, f[m + 3, lane] + vx * gy, f[m + 6, lane] + vx * gz),
            (f[m + 1, lane] + vy * gx, f[m + 4, lane] + vy * gy, f[m + 7, lane] + vy * gz),
            (f[m + 2, lane] + vz * gx, f[m + 5, lane] + vz * gy, f[m + 8, lane] + vz * gz),
        )
