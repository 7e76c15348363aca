"""What a vehicle can do by its parameters alone, checked by trying it; and the command that tells
of it.
"""

import re

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from sampled_vehicles import sample_vehicles

from sb3_quad.agents.agent_settings import env_kwargs, unlike_trained
from sb3_quad.cli import main
from sb3_quad.cli.commands.check_vehicle import warnings
from sb3_quad.envs.simulation.batch import QuadcopterBatch
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.envs.vehicles.vehicle import VEHICLES, load_vehicle
from sb3_quad.evaluation.flights import fly
from sb3_quad.experts.geometric import GeometricExpert
from sb3_quad.experts.geometric_gains import derived_gains

ITM = load_vehicle("itm")
names = st.sampled_from(VEHICLES.names())


@given(names, st.lists(st.floats(-1, 1), min_size=4, max_size=4))
def test_no_thrusts_within_the_limits_give_more(name, actions):
    vehicle = load_vehicle(name)
    lift, *moments = vehicle.mixer @ vehicle.action_to_thrust(np.array(actions))
    assert (np.abs(moments) <= vehicle.greatest_moments * (1 + 1e-9)).all()
    least, most = vehicle.thrust_limits
    assert least * (1 - 1e-9) <= lift / (vehicle.mass * vehicle.gravity) <= most * (1 + 1e-9)


@pytest.mark.parametrize("name", ["crazyflie", "itm"])
def test_the_environment_accelerates_as_the_parameters_say(name):
    """Full thrust upwards once the motors have settled; full roll for as long as it turns below 100
    rad/s, so not quite.
    """
    vehicle = load_vehicle(name)
    greatest = vehicle.greatest_moments / vehicle.inertia
    batch = QuadcopterBatch(1, FlightSettings(vehicle=vehicle, noise=0.0), seed=0)
    climbing = accelerations(batch, np.ones((1, 4), dtype=np.float32), 9, 80)
    assert climbing[-1] == pytest.approx(
        vehicle.gravity * (vehicle.thrust_limits[1] - 1.0), rel=1e-3
    )
    for axis in range(3):
        turning = accelerations(
            batch, np.sign(vehicle.mixer[None, 1 + axis]).astype(np.float32), 10 + axis, 20
        )
        assert 0.85 * greatest[axis] < turning.max() <= greatest[axis] * (1 + 1e-9)


def accelerations(batch, action, row, steps):
    """Of one number of the state under a constant action, from hover."""
    batch.reset()
    values = np.array([(batch.step(action), batch.state[row, 0])[1] for _ in range(steps)])
    return np.diff(values) / batch.vehicle_list[0].control_step


@pytest.mark.parametrize("name", ["crazyflie", "hummingbird"])
def test_the_geometric_expert_flies_them_with_gains_derived_or_found(name):
    vehicle = load_vehicle(name)
    for gains in (None, derived_gains(vehicle)):
        expert = GeometricExpert(vehicle, gains)
        how = {"seed": 5, "vehicle": vehicle, "noise": 0.0}
        recovery = fly(expert, "state_recovery", 50, max_episode_steps=600, **how)
        tracking = fly(expert, "target_tracking", 20, max_episode_steps=1000, **how)
        assert recovery.success.mean() > 0.95 and tracking.success.all()
        assert np.nanmean(tracking.time_to[0.1]) < 3.0 and tracking.final_error.max() < 0.01


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"inertia": tuple(1000 * each for each in ITM.inertia)}, "inertia"),
        ({"thrust_limits": (0.5, 1.1)}, "thrust"),
        ({"collision_radius": 13.5}, "collision_radius"),
        ({"mass": 1000 * ITM.mass}, "inertia"),
        ({"motor_gain": 0.033}, "motor_gain"),
        ({"motor_gain": 300.0}, "motor_gain"),
        ({"moment_thrust_ratio": 1.27}, "moment_thrust_ratio"),
        ({"airspeed_moment": (0.0, -1e-3)}, "airspeed_moment"),
    ],
)
def test_warnings_are_about_units(changes, key):
    slip = ITM.model_copy(update=changes)
    assert key in [warning.split(":")[0] for warning in warnings(slip)]


def test_shipped_vehicles_have_no_warnings():
    assert not any(warnings(load_vehicle(name)) for name in VEHICLES.names())


def written(path, **changes):
    data = {**ITM.model_dump(mode="json", exclude={"geometric_gains"}), **changes}
    path.write_text(
        yaml.safe_dump({key: value for key, value in data.items() if value is not None})
    )
    return str(path)


def test_it_tells_what_a_vehicle_can_do_and_how_the_experts_fly_it(tmp_path, capsys):
    limits = {"thrust_limits": None, "rotor_thrust_limits": [2.0, 6.0]}
    air = {
        "rotor_drag": [1e-4, 1e-4, 2e-4],
        "translational_lift": 0.015,
        "rate_damping": [0.02, 0.03, 0.04],
        "airspeed_moment": [1e-5, 2e-5],
        "rotor_inertia": 1e-5,
        "ground_effect_radius": 0.2,
        "thrust_factors": [1.0, 0.95, 1.0, 1.0],
    }
    own = written(tmp_path / "own.yaml", name="own", mass=1.5, **limits, **air)
    assert main(["check-vehicle", own, "-n", "4"]) == 0
    printed = capsys.readouterr().out
    vehicle = load_vehicle(own)
    assert f"thrust-to-weight ratio {24 / (1.5 * 9.81):.2f}" in printed
    moments = ", ".join(f"{each:.1f}" for each in vehicle.greatest_moments / vehicle.inertia)
    assert f"{moments} rad/s²" in printed
    assert f"{1e-5 * vehicle.hover_speed_sum / vehicle.inertia[0]:.3g}, " in printed
    assert "0.01 m/s² upwards" in printed and "+33 % at 0.1 m" in printed
    assert f"{0.04 / vehicle.inertia[2]:.3g} 1/s of roll, pitch and yaw" in printed
    assert f"{1000 / vehicle.motor_gain_up:.1f} ms up" in printed
    assert re.search(r"success, % +│ +\S+ \(.* 100\.0 \(", printed)
    assert "thesis" not in printed  # its figures are of another vehicle


@pytest.mark.parametrize("name", ["crazyflie", "itm"])
@pytest.mark.parametrize(
    "limits", [{}, {"thrust_limits": None, "rotor_thrust_limits": [0.02, 9.0]}]
)
def test_a_mass_in_grams_is_blamed_on_the_mass_and_leaves_with_1(name, limits, tmp_path, capsys):
    vehicle = load_vehicle(name).model_copy(update={"name": "grams"})
    data = vehicle.model_dump(mode="json", exclude={"geometric_gains"})
    grams = written(tmp_path / "grams.yaml", **{**data, **limits, "mass": 1000 * data["mass"]})
    assert main(["check-vehicle", grams, "-n", "0"]) == 1
    error = capsys.readouterr().err
    assert "grams.yaml" in error and "mass" in error and "inertia" not in error


def test_agents_say_which_ranges_a_vehicle_leaves(tmp_path, capsys):
    own = FlightSettings(vehicles={"distribution": "any"}, randomize={"delay": [0, 4]})
    inside = [ITM, *sample_vehicles("any", 20, seed=0)]
    assert not any(unlike_trained("it", own, vehicle) for vehicle in inside)

    strong = ITM.model_copy(update={"thrust_limits": (0.1, 14.0), "delay": 6})
    said = unlike_trained("it", own, strong)
    assert "thrust to weight 14 (1.5 to 12), delay in control steps 6 (0 to 4)" in said
    keywords = env_kwargs("any-quadcopter", vehicle=strong)
    with pytest.warns(UserWarning, match=r"thrust to weight 14 \("):
        fly("any-quadcopter", n_episodes=1, max_episode_steps=1, **keywords)
    file = tmp_path / "strong.yaml"
    file.write_text(yaml.safe_dump(strong.model_dump(mode="json")))
    assert main(["check-vehicle", str(file), "-n", "0"]) == 0
    assert "unusual: any-quadcopter: itm is outside" in capsys.readouterr().out
