"""What the firmware of a Crazyflie does with a flight: its supervisor, which cuts the motors, and
what a low battery leaves of a command.
"""

import numpy as np
import pytest
from gradient_of_your_environment import Carts
from hypothesis import given
from hypothesis import strategies as st

from sb3_quad import APG, PIDExpert
from sb3_quad.base.errors import ConfigError
from sb3_quad.envs.flight_cost import cost_and_gradients, low_force_cost
from sb3_quad.envs.simulation.batch import QuadcopterBatch
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.envs.simulation.state import (
    FORCE_BODY,
    FORCE_WORLD,
    STATE_SIZE,
    VELOCITY,
    WRENCH_SIZE,
    QuadcopterState,
)
from sb3_quad.envs.simulation.tape import FlightTape
from sb3_quad.envs.vehicles.vehicle import load_vehicle
from sb3_quad.evaluation.flights import fly
from sb3_quad.evaluation.supervisor import Supervisor

CRAZYFLIE = load_vehicle("crazyflie")
WEIGHT = CRAZYFLIE.mass * CRAZYFLIE.gravity


def watched(forces, flying=True):
    """Watch specific forces in g: numbers along body z, or vectors (x, y, z)."""
    supervisor = Supervisor()
    array = np.zeros((STATE_SIZE, 1))
    array[3] = 1.0
    wrench = np.zeros((WRENCH_SIZE, 1))
    state = QuadcopterState(array, CRAZYFLIE.parameters()[:, None], wrench)
    supervisor.on_start(state, CRAZYFLIE)
    for step, force in enumerate(forces, 1):
        along_z = np.append([0.2, 0.0], force)
        wrench[FORCE_BODY] = WEIGHT * along_z[-3:, None]
        supervisor.after_step(step, state, np.zeros((1, 4)), np.array([flying]))
    return supervisor.results()


@pytest.mark.parametrize(
    ("forces", "is_cut"),
    [
        ([0.49] * 101, True),  # 1.01 s
        ([0.49] * 100, False),
        ([0.51] * 200, False),
        ([0.49] * 60 + [0.51] + [0.49] * 99, False),
        ([0.49] * 10 + [-0.21], True),
        ([0.49] * 50 + [-0.19] * 50, False),
        ([(0.09, 0.0, 0.05)] * 300, False),  # free fall
        ([0.49] * 60 + [(0.0, -0.09, 0.09)] + [0.49] * 99, False),
        ([(0.2, 0.0, 0.05)] * 101, True),
    ],
)
def test_the_motors_are_cut_as_the_firmware_does(forces, is_cut):
    measured = watched(forces)
    assert measured["cut_by_supervisor"].tolist() == [is_cut]
    if forces[0] == 0.49 and len({*forces}) == 1:
        assert measured["low_force_time"][0] == pytest.approx(0.01 * len(forces))
    assert not watched(forces, flying=False)["cut_by_supervisor"].any()


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


def test_flights_are_judged_alike_on_both_backends():
    pid = PIDExpert("crazyflie")
    times = []
    for backend in ("batch", "pybullet"):
        hook = Supervisor()
        how = {"hooks": [hook], "max_episode_steps": 100}
        fly(pid, "state_recovery", 4, 3, "crazyflie", 0.0, backend, **how)
        times.append(hook.results()["low_force_time"])
    np.testing.assert_array_equal(*times)
    assert times[0].max() > 0.04


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


def record(actions):
    """Record flights of a Crazyflie by actions (steps, n, 4)."""
    settings = FlightSettings(task="target_tracking", vehicle="crazyflie", noise=0.0)
    tape = FlightTape(QuadcopterBatch(actions.shape[1], settings, 0), len(actions), 2)
    tape.reset()
    for action in actions:
        tape.step(action)
    return tape


def low_force(tape):
    """The mean cost of a recorded flight."""
    return tape.begin(
        lambda *flown: cost_and_gradients(
            lambda states: 10.0 * low_force_cost(states, tape.control_step), *flown
        )
    )


def test_the_gradient_of_the_cost_of_low_forces_is_that_of_differences():
    random = np.random.default_rng(0)
    # Multiples of 1/1024 and of the difference are exact in float32.
    actions = np.float32(random.integers(-1000, -600, (110, 3, 4)) / 1024)
    direction = np.float32(random.choice([-1.0, 1.0], actions.shape))
    tape = record(actions)
    assert low_force(tape) > 0.01
    nothing = np.zeros(tape.batch.observe().shape, np.float32)
    slope = 0.0
    for step in reversed(range(len(actions))):
        slope += (tape.backward(step, nothing) * direction[step]).sum()
    h = 1 / 1024
    costs = [low_force(record(actions + k * h * direction)) for k in (-2, -1, 1, 2)]
    expected = (costs[0] - 8 * costs[1] + 8 * costs[2] - costs[3]) / (12 * h)
    assert slope == pytest.approx(expected, rel=1e-6)


def test_apg_refuses_the_costs_of_quadcopters_for_other_environments():
    with pytest.raises(ConfigError, match="calm_coef"):
        APG("MlpPolicy", Carts(2, 0), n_steps=5, calm_coef=1.0).learn(10)
