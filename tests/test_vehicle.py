"""Vehicles: derived values, thrust and actions, and files that are wrong in every way."""

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from sb3_quad.base.errors import CannotHover, ConfigError
from sb3_quad.envs.simulation.batch import QuadcopterBatch
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.envs.simulation.state import ROTOR_SPEEDS
from sb3_quad.envs.vehicles.layout import find_turn
from sb3_quad.envs.vehicles.vehicle import PARAMETER_NAMES, VEHICLES, Vehicle, load_vehicle
from sb3_quad.evaluation.flights import fly
from sb3_quad.experts.geometric import GeometricExpert

ITM = load_vehicle("itm")
finite = st.floats(-2.0, 2.0)


def vehicles():
    """Vehicles unlike the default one: other sizes, masses, limits and rotor order."""

    def build(scale, mass, low, high, wide, long, mirrored):
        sign = -1 if mirrored else 1
        return ITM.model_copy(
            update={
                "mass": mass,
                "thrust_limits": (low, high),
                "rotor_positions": ((long, wide), (long, -wide), (-long, -wide), (-long, wide)),
                "rotor_directions": tuple(sign * each for each in ITM.rotor_directions),
                "inertia": tuple(scale * each for each in ITM.inertia),
            }
        )

    arm = st.floats(0.05, 1.0)
    return st.builds(
        build,
        st.floats(0.1, 10),
        st.floats(0.05, 20),
        st.floats(0, 0.9),
        st.floats(1.1, 5),
        arm,
        arm,
        st.booleans(),
    )


def write(path, **changes):
    data = yaml.safe_load(yaml.safe_dump(ITM.model_dump(mode="json")))
    data.update(changes)
    path.write_text(yaml.safe_dump({key: value for key, value in data.items() if value is not ...}))
    return path


def test_default_vehicle_is_the_specified_one():
    assert {"itm", "crazyflie", "hummingbird"} < {*VEHICLES.names()}
    assert (ITM.mass, ITM.inertia, ITM.moment_thrust_ratio) == (
        1.727,
        (0.006687, 0.0101, 0.00996),
        0.016,
    )
    assert (ITM.thrust_coefficient, ITM.motor_gain_up, ITM.motor_gain_down, ITM.gravity) == (
        8.54858e-6,
        20.0,
        20.0,
        9.81,
    )
    assert (ITM.physics_step, ITM.control_step, ITM.substeps, ITM.delay) == (0.0025, 0.01, 4, 1)
    d, c = 0.17104913036744201, 0.016
    mixer = [[1, 1, 1, 1], [d, -d, -d, d], [-d, -d, d, d], [c, -c, c, -c]]
    np.testing.assert_array_equal(ITM.mixer, mixer)
    np.testing.assert_allclose(ITM.hover_thrust, 1.727 * 9.81 / 4)
    np.testing.assert_allclose(ITM.thrust_range, (0.5 * ITM.hover_thrust, 1.5 * ITM.hover_thrust))


@given(vehicles(), st.tuples(finite, finite, finite, finite))
def test_mixer_inverse(vehicle, wrench):
    thrusts = vehicle.mixer_inverse @ np.array(wrench)
    np.testing.assert_allclose(vehicle.mixer @ thrusts, wrench, atol=1e-9)


@given(vehicles())
def test_hover_carries_the_weight_and_nothing_else(vehicle):
    wrench = vehicle.mixer @ np.full(4, vehicle.hover_thrust)
    np.testing.assert_allclose(wrench, [vehicle.mass * vehicle.gravity, 0, 0, 0], atol=1e-12)
    np.testing.assert_allclose(
        vehicle.thrust_coefficient * vehicle.hover_rotor_speed**2, vehicle.hover_thrust
    )
    low, high = vehicle.rotor_speed_range
    assert low < vehicle.hover_rotor_speed < high


@given(vehicles(), st.lists(st.floats(-1, 1), min_size=1, max_size=8))
def test_thrust_and_action_are_inverse(vehicle, actions):
    action = np.array(actions)
    thrust = vehicle.action_to_thrust(action)
    low, high = vehicle.thrust_range
    assert (thrust >= low - 1e-9).all() and (thrust <= high + 1e-9).all()
    np.testing.assert_allclose(vehicle.thrust_to_action(thrust), action, atol=1e-9)
    np.testing.assert_array_equal(
        vehicle.action_to_thrust(np.array([-7.0, 7.0])),
        vehicle.action_to_thrust(np.array([-1.0, 1.0])),
    )


def test_frozen_and_copies_are_validated():
    with pytest.raises(ValidationError):
        ITM.mass = 2.0  # type: ignore[misc]
    heavier = ITM.model_copy(update={"mass": 2.0})
    assert heavier.mass == 2.0 and ITM.mass == 1.727
    assert heavier.hover_thrust > ITM.hover_thrust
    with pytest.raises(ValidationError, match="mass"):
        ITM.model_copy(update={"mass": -2.0})


def test_gains_stay_with_the_vehicle_they_were_found_for():
    assert ITM.geometric_gains is not None and ITM.geometric_gains.measured is not None
    assert ITM.model_copy(update={"name": "other"}).geometric_gains == ITM.geometric_gains
    assert ITM.model_copy(update={"mass": 2.0}).geometric_gains is None
    given = {"mass": 2.0, "geometric_gains": ITM.geometric_gains}
    assert ITM.model_copy(update=given).geometric_gains == ITM.geometric_gains


def test_file_round_trip(tmp_path):
    assert load_vehicle(write(tmp_path / "same.yaml")) == ITM
    assert load_vehicle(str(write(tmp_path / "other.yml", mass=2.5))).mass == 2.5
    assert load_vehicle(ITM) is ITM


@pytest.mark.parametrize("name", VEHICLES.names())
def test_shipped_vehicles_hold_what_was_measured_with_them(name):
    vehicle = load_vehicle(name)
    assert vehicle.name == name
    assert vehicle.geometric_gains is None or vehicle.geometric_gains.measured is not None
    assert vehicle.action_to_thrust(vehicle.hover_action) == pytest.approx(vehicle.hover_thrust)


@given(vehicles())
def test_limits_in_newtons_and_rotor_speeds_are_the_same_limits(vehicle):
    data = vehicle.model_dump(exclude={"thrust_limits"})
    for key, limits in (
        ("rotor_thrust_limits", vehicle.thrust_range),
        ("rotor_speed_limits", vehicle.rotor_speed_range),
    ):
        again = Vehicle.model_validate({**data, key: limits})
        np.testing.assert_allclose(
            again.thrust_limits, vehicle.thrust_limits, rtol=1e-12, atol=1e-15
        )
        assert vehicle.model_copy(update={key: limits}).thrust_limits == again.thrust_limits


@pytest.mark.parametrize(
    "limits",
    [{"thrust_limits": [0.1, 0.9]}, {"rotor_thrust_limits": [0.1, 4.0], "thrust_limits": ...}],
)
def test_a_vehicle_that_cannot_hover_is_told_from_a_bad_file(tmp_path, limits):
    with pytest.raises(CannotHover, match="hover"):
        load_vehicle(write(tmp_path / "weak.yaml", **limits))
    with pytest.raises(ConfigError) as caught:
        load_vehicle(write(tmp_path / "worse.yaml", mas=1.0, **limits))
    assert not isinstance(caught.value, CannotHover)


def shifted(vehicle, x, y=0.0):
    """The vehicle with its centre of mass moved, by shares of its arm's length."""
    place = np.array([x, y]) * vehicle.arm_length
    return vehicle.model_copy(
        update={"rotor_positions": (np.array(vehicle.rotor_positions) - place).tolist()}
    )


@given(vehicles(), st.floats(-0.1, 0.1), st.floats(-0.1, 0.1))
def test_hover_about_another_centre_of_mass_takes_four_thrusts(vehicle, x, y):
    changes = {"thrust_limits": (0.0, 5.0), "thrust_factors": (0.9, 1.1, 1.0, 0.95)}
    moved = shifted(vehicle.model_copy(update=changes), x, y)
    weight = moved.mass * moved.gravity
    wrench = moved.mixer @ moved.hover_thrusts
    np.testing.assert_allclose(wrench, [weight, 0, 0, 0], atol=1e-10 * weight)
    np.testing.assert_allclose(moved.action_to_thrust(moved.hover_action), moved.hover_thrusts)
    values = dict(zip(PARAMETER_NAMES, moved.parameters(), strict=True))
    assert [values[f"hover_share_{k}"] for k in range(4)] == moved.hover_shares.tolist()


def test_a_centre_of_mass_about_which_it_cannot_hover_is_refused():
    assert shifted(ITM, -0.34).hover_shares.max() < 1.5
    with pytest.raises(ValidationError, match="rotor_positions"):
        shifted(ITM, -0.36)


def test_episodes_begin_in_hover_about_any_centre_of_mass():
    unequal = ITM.model_copy(update={"thrust_factors": (0.95, 1.05, 1.0, 0.9)})
    vehicle = shifted(unequal, -0.1, 0.05)
    batch = QuadcopterBatch(3, FlightSettings(vehicle=vehicle, noise=0.0), seed=0)
    batch.reset()
    speeds = np.sqrt(vehicle.hover_thrusts / vehicle.lift)
    np.testing.assert_allclose(batch.state[ROTOR_SPEEDS].T, np.tile(speeds, (3, 1)))
    start = batch.state[:17].copy()
    for _ in range(200):
        batch.step(np.tile(vehicle.hover_action, (3, 1)))
    # Actions are float32.
    assert np.abs(batch.state[:17] - start).max() < 1e-3


def test_an_unknown_coefficient_changes_rotor_speeds_alone(tmp_path):
    path = write(tmp_path / "v.yaml", thrust_coefficient=..., geometric_gains=None)
    unknown = load_vehicle(path)
    assert unknown.hover_rotor_speed == 1000.0 and unknown.thrust_coefficient == 0.0
    known = ITM.model_copy(update={"geometric_gains": None})
    flown = [fly(GeometricExpert(each), vehicle=each, n_episodes=4) for each in (known, unknown)]
    np.testing.assert_allclose(flown[0].final_error, flown[1].final_error, atol=1e-9)


def rotors(vehicle, turn=0.0):
    """Where the rotors are after a turn of the body, rad, and which way they turn."""
    places = np.array(vehicle.rotor_positions) @ (1.0, 1.0j) * np.exp(1j * turn)
    return {
        (complex(np.round(place, 9)), sign)
        for place, sign in zip(places, vehicle.rotor_directions, strict=True)
    }


@pytest.mark.parametrize("name", ["crazyflie", "hummingbird"])
def test_a_vehicle_in_another_layout_is_the_same_vehicle_with_its_axes_turned(name):
    own = load_vehicle(name)
    turned = own.in_layout_of(ITM)
    assert np.sign(turned.rotor_positions).tolist() == np.sign(ITM.rotor_positions).tolist()
    assert turned.rotor_directions == ITM.rotor_directions
    assert any(rotors(own, k * np.pi / 4) == rotors(turned) for k in range(8))
    assert turned.geometric_gains == own.geometric_gains and turned.in_layout_of(ITM) is turned
    assert (
        QuadcopterBatch(3, FlightSettings(vehicle=name, rotor_layout="itm")).vehicle_list
        == [turned] * 3
    )


def test_what_the_air_does_turns_with_the_layout():
    changes = {
        "rotor_drag": (1e-4, 2e-4, 3e-4),
        "airspeed_moment": (1e-5, -2e-5),
        "thrust_factors": (1.0, 0.9, 1.1, 1.2),
    }
    vehicle = ITM.model_copy(update={**changes, "inertia": (0.01, 0.01, 0.02)})
    other = ITM.model_copy(
        update={"rotor_directions": tuple(-sign for sign in ITM.rotor_directions)}
    )
    turned = vehicle.in_layout_of(other)
    np.testing.assert_allclose(turned.rotor_drag, (2e-4, 1e-4, 3e-4))
    np.testing.assert_allclose(turned.airspeed_moment, (-2e-5, 1e-5))
    turn = find_turn(vehicle, other)
    assert turned.thrust_factors == tuple(vehicle.thrust_factors[k] for k in turn.order)
    plus = load_vehicle("hummingbird").model_copy(update={"airspeed_moment": (1e-5, 2e-5)})
    with pytest.raises(ConfigError, match="airspeed_moment"):
        plus.in_layout_of(ITM)


def test_a_layout_that_cannot_be_had_is_refused():
    plus = load_vehicle("hummingbird").model_copy(update={"inertia": (2e-3, 4e-3, 5e-3)})
    with pytest.raises(ConfigError, match="inertia"):
        plus.in_layout_of(ITM)
    long = ITM.model_copy(
        update={"rotor_positions": ((0.3, 0.05), (0.3, -0.05), (-0.3, -0.05), (-0.3, 0.05))}
    )
    with pytest.raises(ConfigError, match="rotors"):
        long.in_layout_of(ITM)


def test_the_least_time_is_of_this_vehicle_alone():
    other = ITM.model_copy(update={"name": "mine", "geometric_gains": None})
    assert ITM.time_optimal and other.time_optimal == ITM.time_optimal
    assert ITM.model_copy(update={"mass": 2.0}).time_optimal is None


@pytest.mark.parametrize(("latency", "step"), [(0.0, 0.01), (0.03, 0.01), (0.012, 0.012)])
def test_a_latency_is_a_delay_in_seconds(latency, step):
    changes = {"latency": latency, "control_step": step, "physics_step": step / 5}
    assert ITM.model_copy(update=changes).delay * step == pytest.approx(latency)


@given(latency=st.floats(0.001, 0.1))
def test_the_way_out_of_a_latency_that_does_not_fit_is_valid(latency):
    try:
        ITM.model_copy(update={"latency": latency})
    except ValidationError as error:
        message = str(error)
    else:
        return
    control = float(message.split("control_step: ")[1].split()[0])
    physics = float(message.split("physics_step: ")[1].split(",")[0])
    changes = {"latency": control, "control_step": control, "physics_step": physics}
    assert ITM.model_copy(update=changes).delay == 1


def test_a_key_that_is_unknown_brings_all_that_the_docs_teach(tmp_path):
    with pytest.raises(ConfigError) as refused:
        load_vehicle(write(tmp_path / "mine.yaml", lag=0.01))
    for key in ("rotor_order", "arm_length", "motor_gain", "latency", "props", "delay"):
        assert key in str(refused.value)


def test_what_is_printed_leaves_out_types_and_defaults():
    settings = FlightSettings(vehicles={"distribution": "raptor"}, randomize={"mass": 1.3})
    text = repr(settings)
    assert "Annotated" not in text and "drag" not in text
    assert "Factor(low=1.3, high=1.3)" in text
