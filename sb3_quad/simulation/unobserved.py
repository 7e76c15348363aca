"""What no observation shows, of a vehicle and of what pushes it, as numbers that a network can
learn to say.
"""

import numpy as np

from sb3_quad.base.arrays import Float32Array
from sb3_quad.base.errors import ConfigError
from sb3_quad.simulation.state import FORCE_WORLD, P, QuadcopterState

UNOBSERVED = ("load", "weight", "push_x", "push_y")
"""As mean actions of the rotors: what holds the height, what would without push, and the horizontal
push, world frame.
"""
_MOST = 0.9  # tanh reaches 1 nowhere


def unobserved(state: QuadcopterState | None) -> Float32Array:
    """The numbers of :data:`UNOBSERVED`, clipped to ±0.9, float32 (n, 4).

    :raises ConfigError: no state, or one that does not hold the vehicles.
    """
    if state is None or (v := state.vehicles) is None:
        raise ConfigError("aux_coef: needs environments whose true_state() says which vehicles fly")
    x, y, z = np.zeros((3, state.n)) if state.wrench is None else state.wrench[FORCE_WORLD]
    weight, middle, half = (
        v[P.mass] * v[P.gravity],
        4.0 * v[P.thrust_middle],
        4.0 * v[P.thrust_half_range],
    )
    thrusts = np.stack([weight - z - middle, weight - middle, x, y], axis=1)
    return np.asarray((thrusts / half[:, None]).clip(-_MOST, _MOST), dtype=np.float32)
