"""Forces and moments of air and turning rotors besides linear drag, and their derivatives.

With the airspeed v and the body rates ω in the body frame, the sum Σ of the rotor speeds and the
angular momentum H of the rotors about the body's z axis:

- rotor drag -k Σ v along each axis (k_d, k_z of RotorPy: Folk, Paulos and Kumar, "RotorPy", 2023;
  its cause, blade flapping and induced drag: Martin and Salaün, ICRA 2010);
- translational lift h (vx² + vy²) along z (four times RotorPy's k_h; Svacha et al., ICUAS 2017);
- a moment by airspeed, a Σ vy about x and -b Σ vx about y: positive numbers turn the thrust against
  the airspeed (RotorPy's k_flap, with the other sign);
- damping -d ω, since rotors flap as the body turns (Pounds, Mahony and Corke, "Modelling and
  control of a large quadrotor robot", 2010);
- the rotors' moments: -ω × H e_z, and -dH/dt about z;
- near the ground, thrust times 1 / (1 - (R / 4z)²) (Cheeseman and Bennett, "The effect of the
  ground on a helicopter rotor in forward flight", 1955), constant below z = R / 2.

The functions compute one lane of a block whose ``air`` is loaded.
"""

from sb3_quad.base.compiled import inlined
from sb3_quad.envs.simulation.vectors import add, four, multiply, scaled, vector

# Keeps a height that is divided by above 0, m
_LOWEST = 1e-9


@inlined
def speed_sum(speeds, lane):
    """Return Σ of rotor speeds, (4, LANES), rad/s."""
    s0, s1, s2, s3 = four(speeds, lane)
    return (s0 + s1) + (s2 + s3)


@inlined
def rotor_momentum(b, speeds, lane):
    """Return H of rotor speeds, (4, LANES), N m s."""
    j0, j1, j2, j3 = four(b.spin, lane)
    s0, s1, s2, s3 = four(speeds, lane)
    return (j0 * s0 + j1 * s1) + (j2 * s2 + j3 * s3)


@inlined
def ground_effect(radius, height):
    """Return the factor of the thrust at a height, m, and its derivative by the height, divided by
    it, 1/m.
    """
    lowest = max(height, 0.5 * radius, _LOWEST)
    square = 16.0 * lowest * lowest
    room = square - radius * radius
    slope = -2.0 * radius * radius / (lowest * room)
    return square / room, slope if height > 0.5 * radius else 0.0


@inlined
def scale_thrusts(b, height, lane):
    """Multiply the thrusts of a lane by the rotors' own factors and the ground effect, in place."""
    factor, _ = ground_effect(b.ground_effect_radius[lane], height)
    for k in range(4):
        b.thrust[k, lane] *= factor * b.thrust_factor[k, lane]


@inlined
def air_force(b, v, total, lane):
    """Return rotor drag and translational lift, body frame, N.

    :param v: airspeed, body frame, m/s; ``total`` Σ, rad/s.
    """
    x, y, z = scaled(-total, multiply(vector(b.rotor_drag, lane), v))
    return x, y, z + b.translational_lift[lane] * (v[0] * v[0] + v[1] * v[1])


@inlined
def air_moment(b, v, w, total, momentum, lane):
    """Return the moments by airspeed and body rates, body frame, N m.

    :param w: body rates, rad/s; ``momentum`` H, N m s.
    """
    x, y, z = multiply(vector(b.rate_damping, lane), w)
    roll = b.airspeed_moment[0, lane] * total * v[1] - momentum * w[1]
    pitch = momentum * w[0] - b.airspeed_moment[1, lane] * total * v[0]
    return roll - x, pitch - y, -z


@inlined
def air_vjp(b, v, w, total, momentum, force, torque, lane):
    """Vector-Jacobian product of :func:`air_force` and :func:`air_moment`.

    :param force: gradient with respect to the force; ``torque``, to the moment.
    :return: gradients with respect to v, w, Σ and H.
    """
    roll, pitch = b.airspeed_moment[0, lane], b.airspeed_moment[1, lane]
    drag = multiply(vector(b.rotor_drag, lane), force)
    lift = 2.0 * b.translational_lift[lane] * force[2]
    by_moment = lift * v[0] - pitch * total * torque[1], lift * v[1] + roll * total * torque[0], 0.0
    grad_v = add(scaled(-total, drag), by_moment)
    damped = multiply(vector(b.rate_damping, lane), torque)
    turned = momentum * torque[1], -momentum * torque[0], 0.0
    grad_w = add(scaled(-1.0, damped), turned)
    grad_total = roll * v[1] * torque[0] - pitch * v[0] * torque[1]
    grad_total -= drag[0] * v[0] + drag[1] * v[1] + drag[2] * v[2]
    grad_momentum = w[0] * torque[1] - w[1] * torque[0]
    return grad_v, grad_w, grad_total, grad_momentum
