"""The clipped expert sees no more than a policy of PX4's mc_raptor does."""

import numpy as np

from sb3_quad.experts.clipped import told_clipped
from sb3_quad.experts.geometric import told_geometric
from sb3_quad.simulation.batch import QuadcopterBatch
from sb3_quad.simulation.state import POSITION, TARGET, VELOCITY, QuadcopterState


def moved(state, offset, velocity):
    array = state.array.copy()
    array[TARGET], array[VELOCITY] = array[POSITION] + offset, velocity
    return QuadcopterState(array, state.vehicles, state.wrench)


def test_what_lies_beyond_the_limits_changes_nothing_and_what_lies_within_is_not_clipped():
    batch, rng = QuadcopterBatch(64, "state_recovery", vehicles="raptor", seed=2), np.random.default_rng(0)
    batch.reset()
    state, expert = batch.true_state(), told_clipped()
    sign = rng.choice([-1.0, 1.0], (2, 3, 64))
    near, far = (moved(state, sign[0] * size, sign[1] * 2.0 * size) for size in (0.5, 7.0))
    np.testing.assert_array_equal(expert.actions(near), expert.actions(far))
    before = state.array.copy()
    within = moved(state, 0.4 * sign[0], 0.9 * sign[1])
    np.testing.assert_array_equal(expert.actions(within), told_geometric().actions(within))
    np.testing.assert_array_equal(state.array, before)
