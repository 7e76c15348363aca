"""What hooks measure of made-up flights whose answer is known."""

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
from sb3_quad.envs.vehicles.vehicle import load_vehicle
from sb3_quad.evaluation.hooks import Arrivals, Course, Motion

ITM = load_vehicle("itm")  # a control step of 0.01 s


def state(position=(0, 0, 0), target=(10, 0, 0), tilt=0.0, rate=0.0):
    array = np.zeros((STATE_SIZE, 1))
    array[POSITION, 0] = position
    array[TARGET, 0] = target
    array[QUATERNION, 0] = np.cos(tilt / 2), np.sin(tilt / 2), 0.0, 0.0
    array[BODY_RATES, 0] = 0.0, rate, 50.0  # turning about the vertical is no instability
    return QuadcopterState(array)


def watched(states, *hooks, flying=True):
    """Show the states to hooks; return all that they measure of the one flight."""
    hooks = hooks or [Motion()]
    for hook in hooks:
        hook.on_start(states[0], ITM)
    for step, each in enumerate(states[1:], 1):
        for hook in hooks:
            hook.after_step(step, each, np.zeros((1, 4)), np.array([flying]))
    results = {}
    for hook in hooks:
        results |= hook.results()
    return results


def test_stable_is_the_beginning_of_a_time_that_lasts():
    tumbling = state(tilt=2.0)
    level = state(tilt=0.3)
    short = [tumbling, *[level] * 10, *[state(rate=5.0)] * 5]  # upright for 0.1 s, and turning on
    recovered = watched([*short, *[level] * 40])["recovery_time"][0]
    assert recovered == pytest.approx(len(short) * 0.01)
    assert np.isnan(watched(short)["recovery_time"][0])
    assert watched([level] * 40)["recovery_time"][0] == 0.0
    lost = watched([tumbling, *[state()] * 40], flying=False)
    assert np.isnan(lost["recovery_time"][0])


def test_the_cross_track_error_is_across_the_line_and_the_path_is_the_way_flown():
    measured = watched([state(), state(position=(4, 3, 4)), state(position=(12, 3, 4))])
    assert measured["cross_track_error"][0] == pytest.approx(5.0)
    assert measured["path_length"][0] == pytest.approx(np.sqrt(41) + 8)
    rests = [state(target=(0, 0, 0)), state(position=(1, 2, 3), target=(0, 0, 0))]
    assert np.isnan(watched(rests)["cross_track_error"][0])


@pytest.mark.parametrize(
    ("distances", "time_to", "settling_time"),
    [
        ([0.05, 0.3, 0.08, 0.02], [0, 0], [2, 0]),  # leaves 0.1 m and returns
        ([2.0, 0.5, 0.9, 0.09], [3, 1], [3, 1]),
        ([2.0, 1.5, 1.2, 1.1], [np.nan, np.nan], [np.nan, np.nan]),
    ],
)
def test_arrival_and_settling_are_those_of_each_tolerance(distances, time_to, settling_time):
    course = Course(np.zeros((0, 3)), 0.5)
    states = [state(position=(10 - distance, 0, 0)) for distance in distances]
    measured = watched(states, course, Arrivals((0.1, 1.0), course))
    for name, expected in (("time_to", time_to), ("settling_time", settling_time)):
        times = np.concatenate([*measured[name].values()])
        np.testing.assert_allclose(times, 0.01 * np.array(expected))


def test_only_the_last_waypoint_is_arrived_at():
    course = Course(np.array([[10.0, 0, 0], [20.0, 0, 0]]), 0.5)
    first = [state(position=(x, 0, 0)) for x in (0, 9.8)]
    second = [state(position=(x, 0, 0), target=(20, 0, 0)) for x in (9.9, 19.8, 19.95)]
    measured = watched([*first, *second], course, Arrivals((0.1,), course))
    np.testing.assert_allclose(measured["waypoint_times"], [[0.01, 0.03]])
    np.testing.assert_allclose(measured["time_to"][0.1], [0.04])
    assert course.on_last.all()
