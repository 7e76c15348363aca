"""The geometric expert: symmetries, equilibrium, and that it uses the 18 features alone."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sb3_quad.envs.simulation.state import (
    BODY_RATES,
    POSITION,
    QUATERNION,
    ROTOR_SPEEDS,
    STATE_SIZE,
    TARGET,
    VELOCITY,
    QuadcopterState,
)
from sb3_quad.envs.vehicles.vehicle import load_vehicle
from sb3_quad.evaluation.flights import fly
from sb3_quad.experts.geometric import GeometricExpert
from sb3_quad.experts.geometric_gains import derived_gains

ITM = load_vehicle("itm")
EXPERT = GeometricExpert()
seeds = st.integers(0, 2**32 - 1)


def random_states(seed, n=32):
    random = np.random.default_rng(seed)
    array = np.zeros((STATE_SIZE, n))
    array[POSITION] = random.normal(0, 5, (3, n))
    array[TARGET] = random.normal(0, 5, (3, n))
    quaternion = random.normal(size=(4, n))
    array[QUATERNION] = quaternion / np.linalg.norm(quaternion, axis=0)
    array[VELOCITY] = random.normal(0, 4, (3, n))
    array[BODY_RATES] = random.normal(0, 5, (3, n))
    array[ROTOR_SPEEDS] = ITM.hover_rotor_speed
    return array


def actions(array):
    return EXPERT.actions(QuadcopterState(array))


def mostly_close(one, other):
    """Whether actions agree to rounding, apart from states between the two ways round."""
    return int((np.abs(one - other).max(axis=1) > 1e-4).sum()) <= 1


@given(seeds)
def test_the_mirrored_vehicle_gives_mirrored_actions(seed):
    """Exchange left and right: y, roll, yaw and their rates change sign; rotors 0 and 1, 2 and 3
    change places.
    """
    array = random_states(seed)
    mirrored = array.copy()
    for rows in (POSITION, TARGET, VELOCITY):
        mirrored[rows][1] *= -1
    mirrored[QUATERNION][[1, 3]] *= -1
    mirrored[BODY_RATES][[0, 2]] *= -1
    assert mostly_close(actions(mirrored), actions(array)[:, [1, 0, 3, 2]])


@given(seeds)
def test_hover_at_the_target_is_an_equilibrium_in_any_heading(seed):
    array = random_states(seed)
    yaw = np.random.default_rng(seed).uniform(-np.pi, np.pi, array.shape[1])
    array[TARGET] = array[POSITION]
    array[VELOCITY] = array[BODY_RATES] = 0.0
    array[QUATERNION] = np.cos(yaw / 2), 0 * yaw, 0 * yaw, np.sin(yaw / 2)
    np.testing.assert_allclose(actions(array), 0.0, atol=1e-6)


@given(seeds)
def test_upside_down_it_turns_with_its_greatest_moment(seed):
    """The greatest moment leaves the middle thrust only, and some rotor is at its limit."""
    array = random_states(seed)
    array[VELOCITY] = array[BODY_RATES] = 0.0
    array[TARGET] = array[POSITION]
    tilt = np.random.default_rng(seed).uniform(2.5, 3.1, array.shape[1])
    array[QUATERNION] = np.cos(tilt / 2), np.sin(tilt / 2), 0 * tilt, 0 * tilt
    given = actions(array)
    assert (np.abs(given).max(axis=1) > 0.99).all()
    moments = ITM.action_to_thrust(given) @ ITM.mixer[1:].T
    assert (moments[:, 0] < 0).all()  # back the way it came, which is the shorter one


def test_it_recovers_from_nearly_every_start_and_is_quick_to_a_target():
    recovery = fly(EXPERT, "state_recovery", 480, 13, max_episode_steps=600, noise=0.0)
    tracking = fly(EXPERT, "target_tracking", 96, 13, max_episode_steps=800, noise=0.0)
    assert recovery.success.mean() >= 0.98
    assert tracking.success.all() and tracking.time_to[0.1].mean() < 2.6
    assert tracking.final_error.max() < 0.01


def changed(**changes):
    return GeometricExpert(ITM.model_copy(update=changes))


@pytest.mark.parametrize(
    "expert",
    [
        changed(motor_gain=10.0),
        changed(thrust_limits=(0.7, 1.25)),
        changed(delay=4),
        changed(
            mass=0.03,
            inertia=(1.4e-5, 1.4e-5, 2.2e-5),
            rotor_positions=((0.04, 0.0), (0.0, -0.04), (-0.04, 0.0), (0.0, 0.04)),
            moment_thrust_ratio=0.006,
        ),
    ],
    ids=["slow motors", "weak", "late", "palm-sized plus"],
)
def test_derived_gains_fly_vehicles_unlike_those_of_the_search(
    expert,
):
    vehicle = expert.vehicle
    assert expert.gains == derived_gains(vehicle)
    tracking = fly(
        expert, "target_tracking", 16, 3, vehicle=vehicle, max_episode_steps=900, noise=0.0
    )
    recovery = fly(
        expert, "state_recovery", 96, 3, vehicle=vehicle, max_episode_steps=400, noise=0.0
    )
    assert tracking.success.all() and tracking.final_error.max() < 0.02
    assert recovery.survival.mean() > 0.8
