"""The rate loop of a flight controller, which flies with ``action="rates"``, at each physics step.

The body rates ω pass a first-order filter (Betaflight's PT1). The torque is τ = J k (ω_c - ω_f) +
ω_f × J ω_f, with the commanded rates ω_c. The mixer is PX4's with airmode: roll and pitch come
before the collective thrust, which moves to make room for them, and yaw gets what the rotors have
left (Brescianini and D'Andrea, "Tilt-prioritized quadrocopter attitude control", 2020).

Gains and mixer are those of the vehicle before randomization. Thrusts are in N.
"""

import math

from sb3_quad.base.compiled import LANES, called, fast, inlined
from sb3_quad.envs.simulation.vectors import add, multiply, scaled, store, subtract, vector
from sb3_quad.envs.vehicles.rates import IDLE

RATE_LOOP = {
    # From action 0 to 1: collective thrust, and body rates, rad/s
    "command_range": 4,
    "filter_share": (),  # of its error that a filtered rate loses in a physics step
    "mix_share": 4,  # of the collective thrust that each rotor has
    "yaw_per_thrust": 4,  # m
    "square_per_thrust": (),  # of a rotor's speed
    "least_thrust": (),  # of a rotor
    "most_thrust": (),
    # The collective thrusts at which a rotor reaches these
    "least_total": (),
    "most_total": (),
    # What the loop computes in a physics step: what each rotor adds for roll and pitch, in terms of
    # the collective thrust, the extremes of that, and a factor with which it fits between the
    # limits; the collective thrust; and the wanted yaw moment, N m
    "tilt": 4,
    "most_tilt": (),
    "least_tilt": (),
    "tilt_scale": (),
    "total": (),
    "yaw": (),
}
"""What a block holds of the rate loops of its vehicles, besides their parameters."""


@called
def load_rate_loop(b, dt):
    """Compute the constants in ``RATE_LOOP`` of a block whose vehicles are loaded."""
    for lane in range(LANES):
        most = b.thrust_middle[lane] + b.thrust_half_range[lane]
        least = max(b.thrust_middle[lane] - b.thrust_half_range[lane], IDLE * most)
        b.most_thrust[lane] = most
        b.least_thrust[lane] = least
        b.most_total[lane] = math.inf
        b.least_total[lane] = 0.0
        b.square_per_thrust[lane] = 1.0 / b.thrust_coefficient[lane]
        b.filter_share[lane] = dt / (dt + b.rate_lag[lane])
        b.command_range[0, lane] = 4.0 * b.thrust_half_range[lane]
        store(b.command_range[1:], lane, vector(b.rate_limit, lane))
        for k in range(4):
            share = b.hover_share[k, lane] / 4.0
            b.mix_share[k, lane] = share
            # Roll and pitch in terms of the collective thrust
            b.mix[0, k, lane] /= share
            b.mix[1, k, lane] /= share
            b.yaw_per_thrust[k, lane] = 1.0 / max(abs(b.mix[2, k, lane]), 1e-12)
            b.most_total[lane] = min(b.most_total[lane], most / share)
            b.least_total[lane] = max(b.least_total[lane], least / share)


@inlined
def rate_command(b, lane, k, action):
    """Return the collective thrust (k = 0) or the body rate, rad/s, that an action commands."""
    middle = 4.0 * b.thrust_middle[lane] if k == 0 else 0.0
    return middle + b.command_range[k, lane] * min(max(action, -1.0), 1.0)


@fast
def command_rates(b):
    """Replace the actions in ``b.command`` by the thrusts and body rates that they command."""
    for lane in range(LANES):
        for k in range(4):
            b.command[k, lane] = rate_command(b, lane, k, b.command[k, lane])


@inlined
def room_for_yaw(b, lane, k):
    """Return the yaw moment that a rotor can add to its thrust without yaw."""
    thrust = b.mix_share[k, lane] * (b.total[lane] + b.tilt_scale[lane] * b.tilt[k, lane])
    room = thrust - b.least_thrust[lane]
    if b.mix[2, k, lane] * b.yaw[lane] > 0.0:
        room = b.most_thrust[lane] - thrust
    return room * b.yaw_per_thrust[k, lane]


@fast
def control_rates(b):
    """Advance the gyro's filter by a physics step, and write the rotor speeds that the loop
    commands to ``b.command``.
    """
    for lane in range(LANES):
        w = vector(b.filtered_rates, lane)
        missing = subtract(vector(b.body_rates, lane), w)
        w = add(w, scaled(b.filter_share[lane], missing))
        store(b.filtered_rates, lane, w)
        wx, wy, wz = w
        gyroscopic = multiply(vector(b.gyro, lane), (wy * wz, wz * wx, wx * wy))
        error = subtract(vector(b.rate_command[1:], lane), w)
        x, y, yaw = add(multiply(vector(b.rate_gain, lane), error), gyroscopic)

        # Roll and pitch, scaled until they fit; then the thrust makes room for them.
        most, least = -1e9, 1e9
        for k in range(4):
            tilt = b.mix[0, k, lane] * x + b.mix[1, k, lane] * y
            b.tilt[k, lane] = tilt
            most, least = max(most, tilt), min(least, tilt)
        room = b.most_total[lane] - b.least_total[lane]
        scale = room / max(room, most - least)
        total = max(b.rate_command[0, lane], b.least_total[lane] - scale * least)
        b.total[lane] = min(total, b.most_total[lane] - scale * most)
        b.tilt_scale[lane] = scale
        b.most_tilt[lane] = most
        b.least_tilt[lane] = least

        b.yaw[lane] = yaw
        room = 1e9
        for k in range(4):
            room = min(room, room_for_yaw(b, lane, k))
        room = max(room, 0.0)
        yaw = min(max(yaw, -room), room)
        for k in range(4):
            thrust = b.mix_share[k, lane] * (b.total[lane] + scale * b.tilt[k, lane])
            thrust += b.mix[2, k, lane] * yaw
            # It is within its limits, but for rounding.
            thrust = min(max(thrust, b.least_thrust[lane]), b.most_thrust[lane])
            b.command[k, lane] = math.sqrt(thrust * b.square_per_thrust[lane])
