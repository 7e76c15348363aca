"""What the firmware of a Crazyflie does with a flight: what a low battery leaves of a command."""

import numpy as np
import pytest
from gradient_of_your_environment import Carts
from hypothesis import given
from hypothesis import strategies as st

from sb3_quad import APG
from sb3_quad.base.errors import ConfigError
from sb3_quad.envs.simulation.batch import QuadcopterBatch
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.envs.simulation.state import (
    FORCE_WORLD,
    VELOCITY,
)
from sb3_quad.envs.vehicles.vehicle import load_vehicle

CRAZYFLIE = load_vehicle("crazyflie")


def test_the_specific_force_is_what_accelerates_but_the_weight():
    vehicle = load_vehicle("rotorpy_crazyflie").model_copy(
        update={
            "physics_step": 1e-6,
            "control_step": 1e-6,
            "rotor_drag": (1e-6, 2e-6, 3e-6),
            "translational_lift": 1e-3,
            "ground_effect_radius": 20.0,
            "thrust_factors": (1.0, 0.9, 1.1, 1.0),
        }
    )
    assert any(vehicle.drag)
    settings = FlightSettings(task="state_recovery", vehicle=vehicle, randomize={"wind": [2, 4]})
    batch = QuadcopterBatch(50, settings, 0, autoreset=False)
    batch.reset()
    batch.wrench[:] = np.random.default_rng(0).normal(size=batch.wrench.shape) * 0.05
    state = batch.true_state().copy()
    force = batch.true_state().specific_force
    batch.step(np.zeros((50, 4)))
    acceleration = (batch.state[VELOCITY] - state.array[VELOCITY]).T / 1e-6
    acceleration[:, 2] += vehicle.gravity
    in_body = np.einsum("nji,nj->ni", state.rotation, acceleration)
    np.testing.assert_allclose(force, in_body, atol=1e-3)
    assert abs(batch.true_state().wrench[FORCE_WORLD]).max() > 0.05


@given(
    saturation=st.sampled_from(["each", "shared"]),
    battery=st.floats(0.6, 1.0),
    least=st.floats(0.0, 0.06),
    seed=st.integers(0, 2**31),
)
def test_a_low_battery_limits_each_rotor_or_all_by_the_same_speed(saturation, battery, least, seed):
    changes = {"saturation": saturation, "rotor_thrust_limits": [least, 0.1125]}
    vehicle = CRAZYFLIE.model_copy(update=changes)
    full, low = (
        QuadcopterBatch(
            30, FlightSettings(vehicle=vehicle, noise=0.0, randomize=randomize), 0, n_threads=1
        )
        for randomize in (None, {"battery": battery})
    )
    actions = np.random.default_rng(seed).uniform(-1.5, 1.5, (30, 4))
    for batch in (full, low):
        batch.reset()
        batch.step(actions)
    asked = full.queue[-1]
    given_speeds = low.queue[-1]
    greatest = np.sqrt(battery) * vehicle.rotor_speed_range[1]
    assert (given_speeds <= greatest * (1 + 1e-12)).all() and (given_speeds >= 0.0).all()
    if saturation == "each":
        np.testing.assert_allclose(given_speeds, np.minimum(asked, greatest), rtol=1e-12)
        return
    # What is taken off is the same for all that still turn, and nothing where all can be given.
    taken = asked - given_speeds
    excess = np.maximum(asked.max(axis=0) - greatest, 0.0)
    np.testing.assert_allclose(taken, np.minimum(asked, excess), atol=1e-9)


def test_a_battery_that_cannot_hover_is_refused():
    with pytest.raises(ConfigError, match="some vehicles could not fly"):
        QuadcopterBatch(1, FlightSettings(vehicle="crazyflie", randomize={"battery": [0.5, 1]}))
    with pytest.raises(ConfigError, match="battery"):
        FlightSettings().with_changes(randomize={"battery": 1.1})


def test_apg_refuses_the_costs_of_quadcopters_for_other_environments():
    with pytest.raises(ConfigError, match="calm_coef"):
        APG("MlpPolicy", Carts(2, 0), n_steps=5, calm_coef=1.0).learn(10)
