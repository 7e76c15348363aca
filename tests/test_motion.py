"""When a flight is stable again, how far it deviates from its line and when it arrives, on made-up
flights whose answer is known.
"""

import numpy as np
import pytest

from sb3_quad.envs.simulation.state import (
    BODY_RATES,
    POSITION,
    QUATERNION,
    STATE_SIZE,
    TARGET,
    QuadcopterState,
)
from sb3_quad.evaluation.flights import Arrivals, Motion


def state(position=(0, 0, 0), target=(10, 0, 0), tilt=0.0, rate=0.0):
    array = np.zeros((STATE_SIZE, 1))
    array[POSITION, 0], array[TARGET, 0] = position, target
    array[QUATERNION, 0] = np.cos(tilt / 2), np.sin(tilt / 2), 0.0, 0.0
    array[BODY_RATES, 0] = 0.0, rate, 50.0  # turning about the vertical is no instability
    return QuadcopterState(array)


def watched(states, flying=True):
    motion = Motion(states[0], 0.01)
    for step, each in enumerate(states[1:], 1):
        motion.update(step, each, np.array([flying]))
    return motion


def test_stable_is_the_beginning_of_a_time_that_lasts():
    tumbling, level = state(tilt=2.0), state(tilt=0.3)
    short = [tumbling, *[level] * 10, *[state(rate=5.0)] * 5]  # upright for 0.1 s, and turning on
    assert watched([*short, *[level] * 40]).recovery_time[0] == pytest.approx(len(short) * 0.01)
    assert np.isnan(watched(short).recovery_time[0])
    assert watched([level] * 40).recovery_time[0] == 0.0


def test_a_lost_flight_gets_stable_no_more():
    assert np.isnan(watched([state(tilt=2.0), *[state()] * 40], flying=False).recovery_time[0])


def test_the_cross_track_error_is_across_the_line_only():
    states = [state(), state(position=(4, 3, 4)), state(position=(12, 0, 1))]
    assert watched(states).cross_track_error[0] == pytest.approx(5.0)
    assert np.isnan(
        watched(
            [state(target=(0, 0, 0)), state(position=(1, 2, 3), target=(0, 0, 0))]
        ).cross_track_error[0]
    )


def test_arrival_and_settling_times_are_those_of_each_tolerance():
    arrivals = Arrivals((0.1, 1.0), np.array([0.05, 2.0, 2.0]))
    # The first leaves 0.1 m and returns, the second overshoots within 1 m, the third never arrives.
    for step, distance in enumerate([[0.3, 0.5, 1.5], [0.08, 0.9, 1.2], [0.02, 0.09, 1.1]], 1):
        arrivals.update(float(step), np.array(distance))
    np.testing.assert_array_equal(arrivals.time_to, [[0, 3, np.nan], [0, 1, np.nan]])
    np.testing.assert_array_equal(arrivals.settling_time, [[2, 3, np.nan], [0, 1, np.nan]])
    np.testing.assert_array_equal(arrivals.overshoot, [0.3, 0.09, np.nan])
