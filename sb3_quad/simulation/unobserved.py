"""Quantities that no observation shows: properties of the vehicle and external forces, as numbers
that a network can learn to predict.
"""

import numpy as np

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.types import Float32Array
from sb3_quad.simulation.state import FORCE_WORLD, P, QuadcopterState

UNOBSERVED = ("load", "weight", "push_x", "push_y")
"""All as mean actions of the rotors: the one that holds the height, the one that would hold it
without the external force, and the horizontal external force, world frame.
"""
# tanh never reaches 1.
_MOST = 0.9


def unobserved(state: QuadcopterState | None) -> Float32Array:
    """Return the numbers of :data:`UNOBSERVED`, clipped to ±0.9, float32 (n, 4).

    :raises ConfigError: no state, or one that does not hold the vehicles.
    """
    if state is None or state.vehicles is None:
        raise ConfigError("aux_coef: needs environments whose true_state() says which vehicles fly")
    v = state.vehicles
    x, y, z = np.zeros((3, state.n)) if state.wrench is None else state.wrench[FORCE_WORLD]
    weight = v[P.mass] * v[P.gravity]
    middle = 4.0 * v[P.thrust_middle]
    half_range = 4.0 * v[P.thrust_half_range]
    thrusts = np.stack([weight - z - middle, weight - middle, x, y], axis=1)
    return np.asarray((thrusts / half_range[:, None]).clip(-_MOST, _MOST), dtype=np.float32)
