"""When a flight is stable again and how far beside its way it gets, on made-up flights whose answer
is known.
"""

import numpy as np
import pytest

from sb3_quad.evaluation.flights import Motion
from sb3_quad.simulation.state import (
    BODY_RATES,
    POSITION,
    QUATERNION,
    STATE_SIZE,
    TARGET,
    QuadcopterState,
)


def state(position=(0, 0, 0), target=(10, 0, 0), tilt=0.0, rate=0.0):
    array = np.zeros((STATE_SIZE, 1))
    array[POSITION, 0], array[TARGET, 0] = position, target
    array[QUATERNION, 0] = np.cos(tilt / 2), np.sin(tilt / 2), 0.0, 0.0
    array[BODY_RATES, 0] = 0.0, rate, 50.0  # turning about the vertical is no instability
    return QuadcopterState(array)


def watched(states, flying=True):
    motion = Motion(states[0], 0.01)
    for step, each in enumerate(states[1:], 1):
        motion.see(step, each, np.array([flying]))
    return motion


def test_stable_is_the_beginning_of_a_time_that_lasts():
    tumbling, level = state(tilt=2.0), state(tilt=0.3)
    short = [tumbling, *[level] * 10, *[state(rate=5.0)] * 5]  # upright for 0.1 s, and turning on
    assert watched([*short, *[level] * 40]).recovery_time[0] == pytest.approx(len(short) * 0.01)
    assert np.isnan(watched(short).recovery_time[0])
    assert watched([level] * 40).recovery_time[0] == 0.0


def test_a_lost_flight_gets_stable_no_more():
    assert np.isnan(watched([state(tilt=2.0), *[state()] * 40], flying=False).recovery_time[0])


def test_sideways_is_across_the_way_only():
    states = [state(), state(position=(4, 3, 4)), state(position=(12, 0, 1))]
    assert watched(states).cross_track_error[0] == pytest.approx(5.0)
    assert np.isnan(
        watched(
            [state(target=(0, 0, 0)), state(position=(1, 2, 3), target=(0, 0, 0))]
        ).cross_track_error[0]
    )
