"""The reward of a control step (Eqs. 4.5-4.9). Its coefficients are fields of
:class:`~sb3_quad.envs.simulation.tasks.Task`.
"""

import math

from sb3_quad.base.compiled import LANES, fast, inlined, inner
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
def succeeds(b, lane):
    """Return whether a flight that ends now is close enough to its target, and level enough."""
    _, qx, qy, _ = four(b.quaternion, lane)
    level = 1.0 - 2.0 * (qx * qx + qy * qy) >= math.cos(b.success_tilt[lane])
    return level and b.distance[lane] <= b.success_distance[lane]


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
