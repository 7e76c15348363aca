"""The reward of a control step (Eqs. 4.5-4.9). Its coefficients are fields of
:class:`~sb3_quad.envs.simulation.tasks.Task`.
"""

import math

from sb3_quad.base.compiled import LANES, fast, inlined, inner
from sb3_quad.envs.simulation.random import STEP
from sb3_quad.envs.simulation.vectors import dot, four, polynomial, subtract, vector

# Coefficients of Cephes' arctangent, the highest power first
_NUMERATOR = (
    *(-8.750608600031904122785e-1, -1.615753718753365076637e1, -7.500855792314704667340e1),
    *(-1.228866684490136173410e2, -6.485021904942025371773e1),
)
_DENOMINATOR = (
    *(1.0, 2.485846490142306297962e1, 1.650270098316988542046e2),
    *(4.328810604912902668951e2, 4.853903996359136964868e2, 1.945506571482613964425e2),
)

CALM_DISTANCE = 0.5  # from the target, m, at which half of calm_cost is due
CALM_CHANGE = 0.1  # rad; what a change of commands by 1/s costs, relative to body rates


@inlined
def _length(a):
    return math.sqrt(dot(a, a))


@fast
def _tilt(sine2, cosine2):
    """Return arccos(R33) from the squared sine and cosine of its half, to 1e-15.

    With the smaller as the sine of an angle up to π/4, its halved tangent is at most 0.4142; the
    arctangent up to there is Cephes' rational approximation. The arccosine itself would lose half
    of its digits near level flight.
    """
    t = math.sqrt(min(sine2, cosine2)) / (1.0 + math.sqrt(max(sine2, cosine2)))
    z = t * t
    angle = 4.0 * (t + t * z * (polynomial(z, _NUMERATOR) / polynomial(z, _DENOMINATOR)))
    return angle if sine2 <= cosine2 else math.pi - angle


@inner
def succeeds(b, lane, distance):
    """Return whether a flight that ends now, at that distance from its target, is close and level
    enough.
    """
    _, qx, qy, _ = four(b.quaternion, lane)
    level = 1.0 - 2.0 * (qx * qx + qy * qy) >= math.cos(b.success_tilt[lane])
    return level and distance <= b.success_distance[lane]


@inner
def lands(b, lane):
    """Return whether a flight that touches the ground lands where and how it should."""
    x, y, _ = subtract(vector(b.position, lane), vector(b.target, lane))
    slow = _length(vector(b.velocity, lane)) < b.touchdown_speed[lane]
    return slow and succeeds(b, lane, math.hypot(x, y))


@fast
def score(b):
    """Write ``b.reward`` and ``b.distance``, |r - r_T| in m, of a loaded block.

    It reads the true state at the end of a control step. The reward is -0.003 |r - r_T| - 0.002
    arccos(R33) - 0.0005 |ω| (Eqs. 4.5-4.7), less 15 for touching the ground (Eq. 4.8) and 15 for
    leaving the range (Eq. 4.9), with the coefficients of the row's task. A ``precision_cost``,
    which the thesis does not have, is steep in the last metre, where Eq. 4.5 is not.
    """
    for lane in range(LANES):
        distance = _length(subtract(vector(b.position, lane), vector(b.target, lane)))
        qw, qx, qy, qz = four(b.quaternion, lane)
        tilt = _tilt(qx * qx + qy * qy, qw * qw + qz * qz)
        near = distance / (distance + b.precision_range[lane])
        reward = -b.position_cost[lane] * distance - b.tilt_cost[lane] * tilt
        reward -= b.precision_cost[lane] * near
        reward -= b.body_rates_cost[lane] * _length(vector(b.body_rates, lane))
        # Products instead of branches, so that the loop vectorises.
        reward -= b.collision_cost[lane] * (b.position[2, lane] <= b.collision_radius[lane])
        reward -= b.out_of_range_cost[lane] * (distance > b.max_distance[lane])
        b.reward[lane] = reward
        b.distance[lane] = distance


@fast
def score_calm(b, first, count, actions, last_actions, control_step):
    """Subtract the ``calm_cost`` of a control step from ``b.reward``, which is scored otherwise.

    It is due for |ω|, and for the root mean square, over the rotors, of the change of the commands
    per second. The thesis does not have it.

    :param last_actions: float32 (n, 4), those of the step before; becomes ``actions``.
    """
    for lane in range(count):
        i = first + lane
        squares = 0.0
        for k in range(4):
            action = min(max(actions[i, k], -1.0), 1.0)
            squares += (action - last_actions[i, k]) ** 2
            last_actions[i, k] = action
        # The first action of an episode changes nothing.
        squares *= b.stream[STEP, lane] > 1
        change = math.sqrt(squares) / (2.0 * control_step)
        farness = 1.0 + (b.distance[lane] / CALM_DISTANCE) ** 2
        agitation = _length(vector(b.body_rates, lane)) + CALM_CHANGE * change
        b.reward[lane] -= b.calm_cost[lane] * agitation / farness
