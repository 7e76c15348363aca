"""Vehicles of a distribution: within its ranges, the same in both environments, told to who asks, and one clear line."""

import gymnasium
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import sb3_quad  # noqa: F401
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.seeds import row_seeds
from sb3_quad.envs.quadcopter_env import QuadcopterEnv
from sb3_quad.envs.vec_env import QuadcopterVecEnv
from sb3_quad.evaluation.flights import fly
from sb3_quad.experts.geometric import told_geometric
from sb3_quad.simulation.batch import QuadcopterBatch
from sb3_quad.simulation.sample_vehicles import sample_vehicles
from sb3_quad.simulation.settings import FlightSettings
from sb3_quad.simulation.state import QUATERNION, P, W
from sb3_quad.vehicles.vehicle import PARAMETER_NAMES, load_vehicle

RAPTOR = {"distribution": "raptor"}


@settings(max_examples=8)
@given(st.integers(0, 2**32), st.booleans())
def test_a_row_and_pybullet_fly_the_same_vehicle(seed, disturbed):
    worlds = {"mass": [0.8, 1.2], "force": {"magnitude": [0, 0.2], "unit": "weight"}, "gusts": {"std": 0.1, "unit": "weight"}}
    keywords = {"task": "state_recovery", "vehicles": RAPTOR, **({"randomize": worlds} if disturbed else {})}
    n, steps = 3, 60
    actions = np.random.default_rng(seed).uniform(-1, 1, (steps, n, 4)).astype(np.float32)
    batch = QuadcopterBatch(n, FlightSettings(**keywords), seed=seed, autoreset=False)
    batch.reset()
    states = [batch.state.copy()]
    for action in actions:
        batch.step(action)
        states.append(batch.state.copy())
    single = QuadcopterEnv(**keywords)
    for row, own in enumerate(row_seeds(seed, n)):
        single.reset(seed=own)
        flown = [single.true_state().array[:, 0].copy()]
        for action in actions[:, row]:
            if single.step(action)[2]:
                break
            flown.append(single.true_state().array[:, 0].copy())
        ours, flown = np.array(states)[: len(flown), :, row], np.array(flown)
        ours[:, QUATERNION] *= np.sign((ours[:, QUATERNION] * flown[:, QUATERNION]).sum(axis=1))[:, None]  # q is -q
        np.testing.assert_allclose(ours, flown, rtol=1e-9, atol=1e-9)
    single.close()


def test_sampled_vehicles_are_valid_and_fill_the_ranges():
    vehicles = sample_vehicles("raptor", 2000, seed=1)
    inertia = np.array([each.inertia for each in vehicles])
    metrics = {  # with the ranges of the file
        "size": (np.cbrt([each.mass for each in vehicles]), np.cbrt([0.02, 5.0])),
        "thrust_to_weight": ([each.thrust_limits[1] for each in vehicles], (1.5, 5.0)),
        "torque_to_inertia": ([each.arm_length * each.thrust_range[1] / each.inertia[0] for each in vehicles], (40, 1200)),
        "motor_time_constant": ([1.0 / each.motor_gain for each in vehicles], (0.03, 0.1)),
        "moment_thrust_ratio": ([each.moment_thrust_ratio for each in vehicles], (0.005, 0.05)),
    }
    for name, (values, (low, high)) in metrics.items():
        share = (np.array(values) - low) / (high - low)
        assert share.min() > -1e-9 and share.max() < 1 + 1e-9, name
        np.testing.assert_allclose(np.quantile(share, [0.1, 0.5, 0.9]), [0.1, 0.5, 0.9], atol=0.05, err_msg=name)
    np.testing.assert_allclose(inertia / inertia[:, :1], np.tile([1.0, 1.024, 1.854], (2000, 1)))
    np.testing.assert_allclose([each.thrust_limits[0] for each in vehicles], 0.05)
    assert np.std(np.log([each.arm_length / np.cbrt(each.mass) for each in vehicles])) == pytest.approx(0.09, abs=0.02)


def test_a_sampled_vehicle_flies_as_the_row_that_has_it():
    n, seed = 5, 7
    vehicles = sample_vehicles("raptor", n, seed)
    batch = QuadcopterBatch(n, FlightSettings(vehicles=RAPTOR), seed=seed)
    batch.reset()
    np.testing.assert_allclose(np.stack([each.parameters() for each in vehicles], axis=1), batch.vehicles, rtol=1e-12)


def test_every_episode_has_another_vehicle_and_a_seed_the_same():
    batches = [QuadcopterBatch(16, FlightSettings(vehicles=RAPTOR), seed=3) for _ in range(2)]
    seen = []
    for _ in range(3):
        for each in batches:
            each.reset()
        np.testing.assert_array_equal(batches[0].vehicles, batches[1].vehicles)
        seen.append(batches[0].vehicles[P.mass].copy())
    assert np.unique(seen).size == 48


def test_forces_in_weights_are_in_those_of_the_row_s_own_vehicle():
    force = {"magnitude": 0.2, "unit": "weight", "direction": [0, 0, -1]}
    batch = QuadcopterBatch(64, FlightSettings(vehicles=RAPTOR, randomize={"force": force}), seed=0)
    batch.reset()
    np.testing.assert_allclose(-batch.wrench[W.force_world + 2], 0.2 * 9.81 * batch.vehicles[P.mass], rtol=1e-12)


def test_what_a_distribution_does_not_say_is_as_the_vehicle_has_it():
    ranges = {"mass": 1.0, "thrust_to_weight": 2.0, "torque_to_inertia": 300.0, "motor_time_constant": 0.05}
    hummingbird = load_vehicle("hummingbird").model_copy(update={"delay": 3})
    (one,) = sample_vehicles({**ranges, "moment_thrust_ratio": 0.02}, 1, vehicle=hummingbird)
    assert one.rotor_directions == hummingbird.rotor_directions and one.delay == 3
    np.testing.assert_allclose(np.array(one.inertia) / one.inertia[0], np.array(hummingbird.inertia) / hummingbird.inertia[0])
    np.testing.assert_allclose(one.rotor_positions, np.cbrt(2.0) * np.array(hummingbird.rotor_positions))
    np.testing.assert_allclose(one.hover_rotor_speed, hummingbird.hover_rotor_speed)


def test_the_told_expert_flies_them_all():
    for task in ("target_tracking", "state_recovery"):
        flights = fly(told_geometric(), task, 240, seed=11, max_steps=900, vehicles=RAPTOR)
        assert flights.survival.all() and np.median(flights.final_error) < 1e-3


def test_a_distribution_goes_with_an_agent_and_a_vehicle_replaces_it():
    settings = FlightSettings().with_changes(vehicles={**RAPTOR, "mass": [0.1, 0.2]})
    assert settings.vehicles.mass.high == 0.2 and settings.vehicles.thrust_to_weight.high == 5.0
    again = FlightSettings.model_validate(settings.model_dump(mode="json"))
    assert again.vehicles == settings.vehicles and again.in_any_task()["vehicles"] == settings.vehicles
    assert settings.with_changes(vehicle="itm").vehicles is None


def test_gymnasium_make_takes_a_distribution():
    env = gymnasium.make("QuadTargetTracking-v0", vehicles="raptor")
    env.reset(seed=1)
    (vehicle,) = sample_vehicles("raptor", 1, seed=1)
    masses = {env.unwrapped.true_state().vehicles[PARAMETER_NAMES.index("mass"), 0] for _ in range(2) if env.reset()}
    assert len(masses) == 2 and vehicle.mass not in masses
    env.close()


@pytest.mark.parametrize(
    ("vehicles", "line"),
    [
        ({"distribution": "rapter"}, "vehicle distribution 'rapter'"),
        ({**RAPTOR, "mas": [1, 2]}, "mas"),
        ({**RAPTOR, "mass": [0, 2]}, "greater than 0"),
        ({**RAPTOR, "thrust_to_weight": [0.9, 2]}, "cannot hover"),
        ({**RAPTOR, "least_thrust": [0, 1.2]}, "cannot hover"),
        ({**RAPTOR, "motor_time_constant": 0.001}, "motor_gain"),
        ({**RAPTOR, "inertia_ratios": [1, 1, 5]}, "rigid body"),
        ({"mass": 1.0}, "thrust_to_weight"),
    ],
)
def test_what_cannot_fly_is_refused_in_one_line(vehicles, line):
    with pytest.raises(ConfigError, match=line) as error:
        QuadcopterVecEnv(2, vehicles=vehicles)
    assert "\n" not in str(error.value)
