"""The adjoint of a control step: carry the gradient of a flight's cost from the state after the
step to the state before it.

``gradient`` arrays, float64 (CARRIED, LANES), hold the derivative of the cost with respect to
the first ``MOVING`` rows of a block's state, and to the filtered body rates of its rate loops. Each
function here is the vector-Jacobian product (vjp) of one function of :mod:`.physics`,
:mod:`.rate_loop` or :mod:`.observation`: it turns the gradient with respect to the results into the
gradient with respect to the arguments.

The states between the physics steps of a control step are computed again: that costs less than
keeping them. Where PyBullet limits a velocity to 100 the derivative is taken as 1.
"""

import math

from sb3_quad.base.compiled import LANES, fast, inlined, inner
from sb3_quad.envs.simulation.aerodynamics import (
    air_force,
    air_vjp,
    ground_effect,
    rotor_momentum,
    speed_sum,
)
from sb3_quad.envs.simulation.observation import OBSERVATION_SIZE, F, heading_of
from sb3_quad.envs.simulation.physics import (
    command_by_rates,
    fly,
    quaternion_product,
    rotation,
    sinc_and_cosine,
    to_body,
    to_world,
    total_thrust,
)
from sb3_quad.envs.simulation.rate_loop import room_for_yaw
from sb3_quad.envs.simulation.state import X
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
    turn,
    vector,
    vector_at,
)

MOVING = X.target  # the rows of the state that a flight changes
CARRIED = MOVING + 3  # with the filtered body rates of the rate loop


@inlined
def _add_rotation(quaternion, gradient, lane, matrix):
    """Add the gradient with respect to a quaternion, given that with respect to its rotation
    matrix.
    """
    qw, qx, qy, qz = four(quaternion, lane)
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = matrix
    x, y, z = subtract((zy, xz, yx), (yz, zx, xy))
    gradient[X.quaternion, lane] += 2.0 * (qx * x + qy * y + qz * z)
    turned = (
        qy * (xy + yx) + qz * (xz + zx) - 2.0 * qx * (yy + zz) + qw * x,
        qx * (xy + yx) + qz * (yz + zy) - 2.0 * qy * (xx + zz) + qw * y,
        qx * (xz + zx) + qy * (yz + zy) - 2.0 * qz * (xx + yy) + qw * z,
    )
    _add(gradient, X.quaternion + 1, lane, scaled(2.0, turned))


@inlined
def _add(gradient, row, lane, a):
    gradient[row, lane] += a[0]
    gradient[row + 1, lane] += a[1]
    gradient[row + 2, lane] += a[2]


@fast
def move_vjp(before, after, gradient, dt):
    """Vector-Jacobian product of :func:`.physics.move`, in place.

    :param before: the state before the physics step, (MOVING, LANES); only its attitude is read.
    :param after: the state after it; only its body rates are read.
    """
    half_step = 0.5 * dt
    k = X.quaternion
    for lane in range(LANES):
        _add(gradient, X.velocity, lane, scaled(dt, vector_at(gradient, X.position, lane)))

        # The new quaternion is n = q a, with a = (cos |h|, h sin |h| / |h|) and h = dt ω / 2.
        h = scaled(half_step, vector_at(after, X.body_rates, lane))
        h2 = dot(h, h)
        sinc, cosine = sinc_and_cosine(h2)
        ax, ay, az = scaled(sinc, h)
        qw, qx, qy, qz = four(before[k:], lane)
        n = quaternion_product((qw, qx, qy, qz), (cosine, ax, ay, az))
        nw, nx, ny, nz = n

        # n is scaled by s = 1.5 - |n|² / 2, so the gradient g becomes s g - n (n g).
        gw, gx, gy, gz = four(gradient[k:], lane)
        scale = 1.5 - 0.5 * (nw * nw + nx * nx + ny * ny + nz * nz)
        along = nw * gw + nx * gx + ny * gy + nz * gz
        g = (
            scale * gw - along * nw,
            scale * gx - along * nx,
            scale * gy - along * ny,
            scale * gz - along * nz,
        )

        # A product with a quaternion is undone by one with its conjugate: g a* for q, q* g for a.
        tw, tx, ty, tz = quaternion_product((qw, -qx, -qy, -qz), g)
        gw, gx, gy, gz = quaternion_product(g, (cosine, -ax, -ay, -az))
        gradient[k, lane] = gw
        store(gradient[k + 1 :], lane, (gx, gy, gz))

        # (cos |h| - sin |h| / |h|) / |h|², the slope of the sinc over |h|, by Horner's scheme.
        slope = 1.0 - h2 / 28.0 * (1.0 - h2 / 54.0 * (1.0 - h2 / 88.0))
        slope = (h2 / 10.0 * slope - 1.0) / 3.0
        t = tx, ty, tz
        along = slope * dot(h, t) - sinc * tw
        turned = add(scaled(sinc, t), scaled(along, h))
        _add(gradient, X.body_rates, lane, scaled(half_step, turned))


@inlined
def _accelerate_vjp(b, before, after, gradient, grad_wanted, lane, dt, in_air):
    """Vector-Jacobian product of a lane, see :func:`accelerate_vjp`.

    :param in_air: a constant, whether the terms of :mod:`.aerodynamics` act.
    """
    r = rotation(before[X.quaternion :], lane)

    # Gradient with respect to the torque in the body frame, and through the gyroscopic terms to
    # the body rates
    torque = multiply(vector(b.rates_gain, lane), vector(gradient[X.body_rates :], lane))
    w = vector(before[X.body_rates :], lane)
    wx, wy, wz = w
    gx, gy, gz = multiply(vector(b.gyro, lane), torque)
    gyroscopic = gy * wz + gz * wy, gx * wz + gz * wx, gx * wy + gy * wx
    _add(gradient, X.body_rates, lane, scaled(-1.0, gyroscopic))

    # Gradient with respect to the force, in the world frame and in the body frame
    push = vector(gradient[X.velocity :], lane)
    push = scaled(b.velocity_gain[lane], push)
    in_body = to_body(r, push)

    # The air: its force, and the gradients with respect to the airspeed in the body frame, the sum
    # of the rotor speeds, and the rotors' angular momentum before and after the step
    in_air_force = 0.0, 0.0, 0.0
    grad_v = 0.0, 0.0, 0.0
    by_total = by_old = by_momentum = by_height = 0.0
    ground, slope = 1.0, 0.0
    if in_air:
        v = to_body(r, subtract(vector(before[X.velocity :], lane), vector(b.wind, lane)))
        speeds = after[X.rotor_speeds :]
        total, momentum = speed_sum(speeds, lane), rotor_momentum(b, speeds, lane)
        in_air_force = air_force(b, v, total, lane)
        grad_v, grad_w, by_total, by_momentum = air_vjp(
            b, v, w, total, momentum, in_body, torque, lane
        )
        _add(gradient, X.body_rates, lane, grad_w)
        by_old = torque[2] / dt
        by_momentum -= by_old
        ground, slope = ground_effect(b.ground_effect_radius[lane], before[X.position + 2, lane])

    # Gradient with respect to the rotors: each thrust acts along the body's z axis and about
    # all three axes.
    for k in range(4):
        old, new = before[X.rotor_speeds + k, lane], after[X.rotor_speeds + k, lane]
        lift, exact = b.thrust_coefficient[lane], b.exact_motors[lane]
        if in_air:
            lift *= ground * b.thrust_factor[k, lane]
        grad_thrust = lift * (in_body[2] + dot(vector(b.arm[:, k], lane), torque))
        b.thrust[k, lane] = lift * new * (new + exact * (old - new))
        grad_new = gradient[X.rotor_speeds + k, lane]
        grad_new += grad_thrust * (2.0 * new * (1.0 - exact) + exact * old)
        if in_air:
            grad_new += by_total + b.spin[k, lane] * by_momentum
            by_height += grad_thrust * new * (new + exact * (old - new))
        speeding_up, slowing_down = b.motor[0, lane], b.motor[1, lane]
        factor = speeding_up if b.wanted_speeds[k, lane] > old else slowing_down
        grad_wanted[k, lane] += factor * grad_new
        gradient[X.rotor_speeds + k, lane] = (1.0 - factor) * grad_new + grad_thrust * exact * new
        if in_air:
            gradient[X.rotor_speeds + k, lane] += b.spin[k, lane] * by_old
    if in_air:
        gradient[X.position + 2, lane] += slope * by_height

    # Recompute the force in the body frame: drag from the airspeed, and the thrusts.
    airspeed = subtract(vector(before[X.velocity :], lane), vector(b.wind, lane))
    drag = vector(b.drag, lane)
    fx, fy, fz = subtract(vector(b.force_body, lane), multiply(drag, to_body(r, airspeed)))
    force = fx, fy, fz + total_thrust(b, lane)
    braked = multiply(scaled(-1.0, drag), in_body)
    if in_air:
        force, braked = add(force, in_air_force), add(braked, grad_v)

    # Gradient with respect to the velocity, through the drag, and to the attitude: forces, drag
    # and torques turn.
    _add(gradient, X.velocity, lane, to_world(r, braked))
    x, y, z = transposed((push, airspeed, vector(b.torque_world, lane)))
    turned = transposed((force, braked, torque))
    matrix = matvec(turned, x), matvec(turned, y), matvec(turned, z)
    _add_rotation(before[X.quaternion :], gradient, lane, matrix)


@fast
def accelerate_vjp(b, before, after, gradient, grad_wanted, dt, in_air):
    """Vector-Jacobian product of :func:`.physics.accelerate`, in place.

    :param b: a block whose vehicle, wrench, wind and wanted speeds are loaded.
    :param before: the state before the physics step, (MOVING, LANES), and ``after`` that after it.
    :param grad_wanted: (4, LANES), to which the gradient with respect to the wanted rotor speeds is
        added.
    """
    if in_air:
        for lane in range(LANES):
            _accelerate_vjp(b, before, after, gradient, grad_wanted, lane, dt, True)
    else:
        for lane in range(LANES):
            _accelerate_vjp(b, before, after, gradient, grad_wanted, lane, dt, False)


@inner
def flight_vjp(b, states, gradient, grad_wanted, grad_speed, dt, substeps, in_air, by_rates):
    """Vector-Jacobian product of :func:`.physics.fly`.

    It takes the physics steps of a control step, the last one first.

    :param b: a block with the state before the control step; its flight is computed again.
    :param states: memory for the states in between, (substeps + 1, CARRIED, LANES).
    :param grad_wanted: (4, LANES), is set to the gradient with respect to the wanted rotor speeds,
        or with ``by_rates`` to the commanded thrust and body rates.
    :param grad_speed: memory, (4, LANES).
    """
    for substep in range(substeps):
        states[substep, :MOVING] = b.state[:MOVING]
        states[substep, MOVING:] = b.filtered_rates
        fly(b, dt, 1, in_air, by_rates, True)
    states[substeps, :MOVING] = b.state[:MOVING]
    grad_wanted[:] = 0.0
    for substep in range(substeps - 1, -1, -1):
        before, after = states[substep], states[substep + 1]
        move_vjp(before, after, gradient, dt)
        if by_rates:
            b.state[:MOVING] = before[:MOVING]
            b.filtered_rates[:] = before[MOVING:]
            command_by_rates(b)
            grad_speed[:] = 0.0
            accelerate_vjp(b, before, after, gradient, grad_speed, dt, in_air)
            limits_vjp(b, grad_speed)
            control_rates_vjp(b, gradient, grad_speed, grad_wanted)
        else:
            accelerate_vjp(b, before, after, gradient, grad_wanted, dt, in_air)


@fast
def control_rates_vjp(b, gradient, grad_speed, grad_command):
    """Vector-Jacobian product of :func:`.rate_loop.control_rates`, in place.

    :param b: a block after it, with the rotor speeds in ``b.command``.
    :param grad_speed: (4, LANES), with respect to these speeds.
    :param grad_command: (4, LANES), to which the gradient with respect to the commanded thrust and
        body rates is added.
    """
    for lane in range(LANES):
        grad = grad_speed[:, lane]
        scale = b.tilt_scale[lane]
        # Thrusts, and the yaw moment, which ends where the first rotor has no room left
        grad_z = 0.0
        room, first = 1e9, 0
        for k in range(4):
            grad[k] *= 0.5 * b.square_per_thrust[lane] / b.command[k, lane]
            grad_z += b.mix[2, k, lane] * grad[k]
            own_room = room_for_yaw(b, lane, k)
            if own_room < room:
                room, first = own_room, k
        if abs(b.yaw[lane]) > room:
            if room > 0.0:
                # A rotor that adds thrust for the yaw has less room the more it gives.
                sign = -1.0 if b.mix[2, first, lane] > 0.0 else 1.0
                grad[first] += sign * b.yaw_per_thrust[first, lane] * grad_z
            grad_z = 0.0

        # The collective thrust is the commanded one, or what a limit of the rotors allows.
        grad_total = grad_scale = grad_most = grad_least = 0.0
        for k in range(4):
            grad[k] *= b.mix_share[k, lane]
            grad_total += grad[k]
            grad_scale += grad[k] * b.tilt[k, lane]
        most, least = b.most_tilt[lane], b.least_tilt[lane]
        if b.total[lane] < b.rate_command[0, lane]:
            grad_scale -= most * grad_total
            grad_most = -scale * grad_total
        elif b.total[lane] > b.rate_command[0, lane]:
            grad_scale -= least * grad_total
            grad_least = -scale * grad_total
        else:
            grad_command[0, lane] += grad_total
        if scale < 1.0:
            by_spread = grad_scale * scale / (most - least)
            grad_most -= by_spread
            grad_least += by_spread
        grad_x = grad_y = 0.0
        for k in range(4):
            grad_tilt = scale * grad[k]
            if b.tilt[k, lane] == most:
                grad_tilt += grad_most
            if b.tilt[k, lane] == least:
                grad_tilt += grad_least
            grad_x += b.mix[0, k, lane] * grad_tilt
            grad_y += b.mix[1, k, lane] * grad_tilt

        # The torque, by the commanded and the filtered body rates
        grad_torque = grad_x, grad_y, grad_z
        by_error = multiply(vector(b.rate_gain, lane), grad_torque)
        _add(grad_command, 1, lane, by_error)
        wx, wy, wz = vector(b.filtered_rates, lane)
        gx, gy, gz = multiply(vector(b.gyro, lane), grad_torque)
        gyroscopic = gy * wz + gz * wy, gx * wz + gz * wx, gx * wy + gy * wx
        filtered = add(vector_at(gradient, MOVING, lane), subtract(gyroscopic, by_error))
        share = b.filter_share[lane]
        _add(gradient, X.body_rates, lane, scaled(share, filtered))
        store(gradient[MOVING:], lane, scaled(1.0 - share, filtered))


@inner
def limits_vjp(b, grad_speed):
    """Vector-Jacobian product of :func:`.physics.limit_speeds`, in place.

    :param b: a block with the speeds before it, ``command``, and after it, ``wanted_speeds``.
    :param grad_speed: (4, LANES), with respect to the speeds after it.
    """
    for lane in range(LANES):
        speeds = b.command[:, lane]
        fastest = speeds.argmax()
        greatest = b.greatest_speed[lane]
        if speeds[fastest] <= greatest:
            continue
        is_shared = b.shared_saturation[lane] > 0.0
        taken = 0.0
        for k in range(4):
            # The reduction that all rotors share may stop a rotor.
            stops = b.wanted_speeds[k, lane] == 0.0
            if stops or (speeds[k] > greatest and not is_shared):
                grad_speed[k, lane] = 0.0
            taken += grad_speed[k, lane]
        if is_shared:
            grad_speed[fastest, lane] -= taken


@fast
def noise_vjp(b, grad_feature):
    """Vector-Jacobian product of noise and scaling of the features (Eq. 3.16), in place.

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


@fast
def relation_vjp(b, grad_feature):
    """Vector-Jacobian product of what :func:`.observation.features` does for a moving reference."""
    f = grad_feature
    for lane in range(LANES):
        cosine, sine = heading_of(b, lane)
        rate = b.target_heading_rate[0, lane]
        turn(f, F.position, lane, cosine, -sine)
        for row in range(3):
            k = F.rotation + 3 * row
            turn(f, k, lane, cosine, -sine)
            f[k + 2, lane] -= rate * f[F.body_rates + row, lane]
            _add(f, k, lane, scaled(-f[F.velocity + row, lane], vector(b.target_velocity, lane)))


# The features whose gradient it knows.
DIFFERENTIATED = {"position", "rotation", "velocity", "body_rates"}


@fast
def features_vjp(b, grad_feature, gradient):
    """Vector-Jacobian product of :func:`.observation.features`.

    It is added to the gradient with respect to the state of a loaded block.

    :param grad_feature: float64 (OBSERVATION_SIZE, LANES), with respect to the features in
        their units.
    """
    f = grad_feature
    for lane in range(LANES):
        r = rotation(b.quaternion, lane)
        _add(gradient, X.position, lane, vector_at(f, F.position, lane))
        _add(gradient, X.body_rates, lane, vector_at(f, F.body_rates, lane))
        # The observed velocity is Rᵀ v.
        observed = vector(f[F.velocity :], lane)
        v = vector(b.velocity, lane)
        _add(gradient, X.velocity, lane, to_world(r, observed))
        # The observed matrix is Rᵀ, row by row: its columns are the rows of R.
        x = add(_column(f, 0, lane), scaled(v[0], observed))
        y = add(_column(f, 1, lane), scaled(v[1], observed))
        z = add(_column(f, 2, lane), scaled(v[2], observed))
        _add_rotation(b.quaternion, gradient, lane, (x, y, z))


@inlined
def _column(f, k, lane):
    k += F.rotation
    return f[k, lane], f[k + 3, lane], f[k + 6, lane]
