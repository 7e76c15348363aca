"""The lower bound of the height lost is one: no flight loses less, and it says what it says where that can be computed."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_quad.experts.geometric import GeometricExpert
from sb3_quad.experts.reach import least_height_lost
from sb3_quad.simulation.batch import QuadcopterBatch
from sb3_quad.simulation.state import BODY_RATES, POSITION, QUATERNION, ROTOR_SPEEDS, TARGET, VELOCITY, QuadcopterState
from sb3_quad.vehicles.vehicle import load_vehicle

ITM = load_vehicle("itm")
HIGH = {"start_position": (0.0, 0.0, 1000.0), "max_distance": 5000.0, "velocity_std": 4.0, "body_rates_std": 8.0}


def hovering(n: int = 1) -> np.ndarray:
    array = np.zeros((20, n))
    array[3] = 1.0
    array[ROTOR_SPEEDS] = ITM.hover_rotor_speed
    return array


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from(["geometric", "random", "constant"]))
def test_no_flight_loses_less(seed: int, pilot: str) -> None:
    batch = QuadcopterBatch(32, task="state_recovery", task_kwargs=HIGH, noise=0.0, seed=seed, n_threads=1)
    batch.reset()
    state, expert, random = batch.true_state(), GeometricExpert(), np.random.default_rng(seed)
    bound, start = least_height_lost(state), batch.state[2].copy()
    held = random.uniform(-1, 1, (32, 4))
    lowest = start.copy()
    for step in range(450):
        if pilot == "random" and step % 20 == 0:
            held = random.uniform(-1, 1, (32, 4))
        batch.step(expert.actions(state) if pilot == "geometric" else held)
        lowest = np.minimum(lowest, batch.state[2])
    assert (start - lowest >= bound - 1e-6).all()


def test_upright_it_is_nearly_what_full_thrust_loses() -> None:
    array = hovering()
    array[POSITION, 0], array[TARGET, 0] = (0, 0, 100), (0, 0, 100)
    array[VELOCITY, 0] = (0, 0, -5)
    (bound,) = least_height_lost(QuadcopterState(array))
    assert 25 / (2 * 0.5 * ITM.gravity) < bound < 3.1  # v² / 2a; and the motors' lag before it


def test_it_grows_with_fall_and_tilt_and_shrinks_with_a_helpful_spin() -> None:
    array = hovering(60)
    angle = np.linspace(0, np.pi, 60)
    array[QUATERNION] = np.cos(angle / 2), np.sin(angle / 2), 0 * angle, 0 * angle
    array[VELOCITY] = np.array([[0.0], [0.0], [-3.0]])
    bound = least_height_lost(QuadcopterState(array))
    assert (np.diff(bound) >= 0).all() and bound[-1] > bound[0] + 0.5
    faster = array.copy()
    faster[VELOCITY][2] = -4.0
    assert (least_height_lost(QuadcopterState(faster)) > bound).all()
    array[BODY_RATES] = np.array([[-6.0], [0.0], [0.0]])  # towards upright
    assert (least_height_lost(QuadcopterState(array)) < bound)[angle > 1.0].all()


def test_it_says_nothing_of_states_that_do_not_fall() -> None:
    array = hovering()
    array[VELOCITY, 0] = (3, 0, 2)
    assert least_height_lost(QuadcopterState(array))[0] == pytest.approx(0.0)


def test_a_stronger_vehicle_loses_less() -> None:
    array = hovering()
    array[VELOCITY, 0] = (0, 0, -5)
    strong = ITM.model_copy(update={"thrust_limits": (0.5, 2.0)})
    assert least_height_lost(QuadcopterState(array), strong)[0] < least_height_lost(QuadcopterState(array))[0]
