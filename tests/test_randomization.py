"""Randomization and vehicle distributions: the same in both environments, of the row's own stream,
within their ranges.
"""

import gymnasium
import numpy as np
import pytest
from sampled_vehicles import sample_vehicles

from sb3_quad import envs
from sb3_quad.base.seeds import row_seeds
from sb3_quad.envs.simulation.batch import QuadcopterBatch
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.envs.simulation.state import QUATERNION, P, W
from sb3_quad.envs.vehicles.vehicle import load_vehicle
from sb3_quad.evaluation.flights import fly
from sb3_quad.experts.geometric import GeometricExpert, privileged_geometric
from sb3_quad.experts.geometric_gains import PRIVILEGED_YAW

RANDOMIZE = {
    "mass": [0.8, 1.25],
    "inertia": [0.7, 1.4],
    "motor_gain": [0.6, 1.6],
    "motor_gain_up": [0.5, 1.0],
    "motor_gain_down": [0.8, 1.0],
    "drag": [0, 0.5],
    "thrust": [0.9, 1.0],
    "arm": [0.9, 1.1],
    "center_of_mass": [-0.01, 0.01],
    "delay": [0, 3],
    "force": {"magnitude": [0, 5]},
    "torque": {"magnitude": [0, 0.1], "axes": [1, 1, 0.33]},
    "gusts": {"std": [0, 1], "time_constant": 0.5},
    "wind": [0, 5],
    "wind_gusts": {"std": [0, 2], "time_constant": 0.5},
    "rotors": [0.95, 1.1],
    "rotor_drag": [0, 0.5],
    "translational_lift": [0, 0.05],
    "airspeed_moment": [-2, 10],
    "rate_damping": [0, 8],
    "rotor_inertia": [0, 0.02],
    "ground_effect_radius": [0, 80],
}
IN_WEIGHTS = {
    "mass": [0.8, 1.2],
    "force": {"magnitude": [0, 0.2], "unit": "weight"},
    "gusts": {"std": 0.1, "unit": "weight"},
}
FRAMES = {"last_action": True, "history": [0, 1, 3], "position_integral": {}}
RAPTOR = {"distribution": "raptor"}


def batch_of(n, seed=0, autoreset=True, **keywords):
    """A batch at the start of its first episodes."""
    batch = QuadcopterBatch(n, FlightSettings(**keywords), seed, autoreset=autoreset)
    batch.reset()
    return batch


HELIX = {"curve": "helix", "heading": 1.0, "heading_rate": 2.0}
WANDERING = {"curve": "random_smooth", "heading": "random", "heading_rate": 2.0}
LOOPS = {"rate_gains": [0.5, 2.0], "rate_lag": [0.0, 0.02]}
ESTIMATOR = {"position": 0.02, "velocity": 0.07, "attitude": 2.5, "body_rates": 0.1}
IN_BODY = {name: {**RANDOMIZE[name], "frame": "body"} for name in ("force", "torque")}
FLOWN = {
    "all that is random": {"randomize": RANDOMIZE, **FRAMES},
    "pushed in the body frame": {"randomize": {**RANDOMIZE, **IN_BODY}},
    "a distribution": {"vehicles": RAPTOR, "randomize": IN_WEIGHTS},
    "body rates": {"action": "rates", "randomize": {**LOOPS, "delay": [0, 2], "drag": 0.3}},
    "a helix": {"reference": HELIX, "preview": [0, 5], "task": "target_tracking"},
    "random motion": {"reference": WANDERING, "preview": [0, 5]},
    "two kinds of noise": {"noise": {"relative": 0.05, "additive": 0.1}},
    "an estimator": {"noise": {"estimator": ESTIMATOR}},
    "a reward for calm": {"task_kwargs": {"calm_cost": 0.01}},
}


@pytest.mark.parametrize("name", FLOWN)
def test_a_row_and_pybullet_fly_the_same(name):
    keywords = {"task": "state_recovery", **FLOWN[name]}
    batch = QuadcopterBatch(2, FlightSettings(**keywords), seed=5, autoreset=False)
    single = envs.QuadcopterEnv(**keywords)
    seen = batch.reset()[1], single.reset(seed=row_seeds(5, 2)[1])[0]
    # Held for a twelfth of a second
    actions = np.random.default_rng(0).uniform(-0.6, 0.9, (10, 2, 4)).repeat(8, axis=0)
    for action in actions.astype(np.float32):
        np.testing.assert_allclose(*seen, atol=5e-5)
        ours, theirs = batch.state[:, 1].copy(), single.true_state().array[:, 0]
        # q and -q are one attitude.
        ours[QUATERNION] *= np.sign(ours[QUATERNION] @ theirs[QUATERNION])
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-9)
        observations, rewards, _ = batch.step(action)
        observation, reward, ended, *_ = single.step(action[1])
        assert not ended and reward == pytest.approx(rewards[1], rel=1e-6, abs=1e-6)
        seen = observations[1], observation
    single.close()


def test_an_episode_is_random_within_the_ranges():
    batch = batch_of(2000, randomize={**RANDOMIZE, "share": 0.7, "wrench_share": 0.6})
    base, first = load_vehicle("itm").parameters(), batch.vehicles.copy()
    batch.reset()
    assert (batch.vehicles[P.mass] != first[P.mass]).mean() > 0.8
    factors = batch.vehicles / np.where(base == 0.0, np.nan, base)[:, None]
    changed = factors[P.mass] != 1.0
    assert changed.mean() == pytest.approx(0.7, abs=0.05)
    assert (batch.vehicles[:, ~changed] == base[:, None]).all()
    for row, (low, high) in {P.mass: (0.8, 1.25), P.thrust_middle: (0.9, 1.0)}.items():
        values = factors[row, changed]
        assert values.min() >= low and values.max() <= high
        assert np.median(np.log(values)) == pytest.approx(
            np.log(low * high) / 2, abs=0.05 * np.log(high / low)
        )
    ratio = batch.vehicles[P.motor_gain_up, changed] / batch.vehicles[P.motor_gain_down, changed]
    assert ratio.min() < 0.6 and ratio.max() > 1.1  # each of its own, besides what they share
    drag = batch.vehicles[P.drag_x : P.drag_z + 1, changed] / base[P.mass]
    assert (drag == drag[0]).all() and np.quantile(drag, [0.0, 0.5, 1.0]) == pytest.approx(
        [0.0, 0.25, 0.5], abs=0.02
    )
    inertia = batch.vehicles[[P.ixx, P.iyy, P.izz]]
    turning = load_vehicle("itm").hover_speed_sum
    v = batch.vehicles[:, changed]
    air = {
        P.rotor_drag_z: (turning / base[P.mass], 0.0, 0.5),
        P.translational_lift: (1.0 / base[P.mass], 0.0, 0.05),
        P.airspeed_moment_roll: (turning / base[P.ixx], -2.0, 10.0),
        P.airspeed_moment_pitch: (turning / base[P.iyy], -2.0, 10.0),
        P.rate_damping_z: (1.0 / base[P.izz], 0.0, 8.0),
        P.rotor_inertia: (1.0 / base[P.izz], 0.0, 0.02),
        P.ground_effect_radius: (1.0 / load_vehicle("itm").arm_length, 0.0, 80.0),
        **{P.thrust_factor_0 + k: (1.0, 0.95, 1.1) for k in range(4)},
    }
    for row, (unit, low, high) in air.items():
        slack = 0.02 * (high - low)
        assert unit * v[row].min() == pytest.approx(low, abs=slack)
        assert unit * v[row].max() == pytest.approx(high, abs=slack)
    assert (abs(np.corrcoef(v[[*air]])[np.triu_indices(len(air), 1)]) < 0.1).all()
    assert (2 * inertia.max(axis=0) <= inertia.sum(axis=0) * (1 + 1e-12)).all()
    assert [*np.unique(batch.vehicles[P.delay, changed])] == [0, 1, 2, 3]
    force = np.linalg.norm(batch.wrench[W.force_world : W.force_world + 3], axis=0)
    assert (force > 0).mean() == pytest.approx(0.6, abs=0.05)
    assert force.max() <= 5 and np.median(force[force > 0]) == pytest.approx(2.5, abs=0.3)
    wind = np.linalg.norm(batch.wind, axis=0)
    assert (
        (wind > 0).mean() == pytest.approx(0.6, abs=0.05)
        and wind.max() <= 5
        and not batch.wind[2].any()
    )
    assert np.std(batch.wind_gust[:3, wind > 0], axis=1) == pytest.approx(2 / np.sqrt(3), abs=0.1)
    torque = np.abs(batch.wrench[W.torque_body : W.torque_body + 3]).max(axis=1)
    assert torque[:2] == pytest.approx(0.1, abs=0.01) and torque[2] == pytest.approx(
        0.033, abs=0.003
    )


@pytest.mark.parametrize(
    ("kind", "std", "unit", "size"),
    [
        ("gusts", 0.1, "weight", 0.1 * 1.727 * 9.81),
        ("wind_gusts", 2.0, "SI", 2.0),
    ],
)
def test_gusts_have_their_spread_and_time_constant(kind, std, unit, size):
    randomize = {kind: {"std": std, "unit": unit, "time_constant": 0.2}}
    batch = batch_of(4000, randomize=randomize, max_episode_steps=10**6)
    present = batch.wind_gust if kind == "wind_gusts" else batch.gust
    gusts = [present[:3].copy()]
    for _ in range(40):
        batch.step(np.zeros((4000, 4), np.float32))
        gusts.append(present[:3].copy())
    assert np.std(gusts[0], axis=1) == pytest.approx(size, rel=0.05)
    assert np.std(gusts[-1], axis=1) == pytest.approx(size, rel=0.05)
    assert np.mean((gusts[-1] / size) ** 4) == pytest.approx(
        3.0, abs=0.25
    )  # as of a normal distribution
    assert abs(np.corrcoef(gusts[-1])[0, 1]) < 0.06
    for steps in (10, 20):
        kept = [np.corrcoef(gusts[0][axis], gusts[steps][axis])[0, 1] for axis in range(3)]
        assert kept == pytest.approx([np.exp(-steps * 0.01 / 0.2)] * 3, abs=0.05)


def test_a_wrench_that_is_set_lasts_until_the_next_episode_brings_its_own():
    batch = batch_of(2, randomize={"force": [1.0, 1.0]})
    batch.wrench[W.force_world] = 3.0
    batch.step(np.zeros((2, 4), np.float32))
    assert batch.wrench[W.force_world].tolist() == [3.0, 3.0]
    batch.reset(0)
    assert (
        np.linalg.norm(batch.wrench[:, 0]) == pytest.approx(1.0)
        and batch.wrench[W.force_world, 1] == 3.0
    )


REST = np.zeros((3, 4), np.float32)


@pytest.mark.parametrize("air", [{}, {"rotor_inertia": 1e-8, "rotor_drag": [1e-7] * 3}])
@pytest.mark.parametrize(
    ("name", "push"), [("wrench", np.eye(1, 12)[0]), ("wind", [1.0, 0.0, 0.0])]
)
def test_the_row_that_is_pushed_feels_it_and_no_other_number_changes(name, push, air):
    vehicle = load_vehicle("crazyflie").model_copy(update={"drag": [0.01] * 3, **air})
    pushed, free = (envs.QuadcopterVecEnv(3, seed=0, vehicle=vehicle) for _ in range(2))
    for env in (pushed, free):
        env.reset()
        env.step(REST)
    getattr(pushed.batch, name)[:, 1] = push
    for env in (pushed, free):
        env.step(REST)
    same = (pushed.batch.state == free.batch.state).all(axis=0)
    assert same.tolist() == [True, False, True]


# --- distributions of vehicles


def test_sampled_vehicles_are_valid_and_fill_the_ranges():
    vehicles = sample_vehicles("raptor", 1000, seed=1)
    inertia = np.array([each.inertia for each in vehicles])
    metrics = {  # with the ranges of the file
        "size": (np.cbrt([each.mass for each in vehicles]), np.cbrt([0.02, 5.0])),
        "thrust_to_weight": ([each.thrust_limits[1] for each in vehicles], (1.5, 5.0)),
        "torque_to_inertia": (
            [each.arm_length * each.thrust_range[1] / each.inertia[0] for each in vehicles],
            (40, 1200),
        ),
        "motor_time_constant": ([1.0 / each.motor_gain_up for each in vehicles], (0.03, 0.1)),
        "moment_thrust_ratio": ([each.moment_thrust_ratio for each in vehicles], (0.005, 0.05)),
    }
    for name, (values, (low, high)) in metrics.items():
        share = (np.array(values) - low) / (high - low)
        assert share.min() > -1e-9 and share.max() < 1 + 1e-9, name
        np.testing.assert_allclose(
            np.quantile(share, [0.1, 0.5, 0.9]), [0.1, 0.5, 0.9], atol=0.05, err_msg=name
        )
    np.testing.assert_allclose(inertia / inertia[:, :1], np.tile([1.0, 1.024, 1.854], (1000, 1)))
    np.testing.assert_allclose([each.thrust_limits[0] for each in vehicles], 0.05)
    assert np.std(
        np.log([each.arm_length / np.cbrt(each.mass) for each in vehicles])
    ) == pytest.approx(0.09, abs=0.02)


def test_every_episode_has_another_vehicle_and_forces_in_its_weights():
    force = {"magnitude": 0.2, "unit": "weight", "direction": [0, 0, -1]}
    first, again = (batch_of(16, 3, vehicles=RAPTOR, randomize={"force": force}) for _ in range(2))
    ours = np.stack([each.parameters() for each in sample_vehicles("raptor", 16, seed=3)], axis=1)
    np.testing.assert_allclose(ours, first.vehicles, rtol=1e-12)
    masses = []
    for _ in range(3):
        np.testing.assert_array_equal(first.vehicles, again.vehicles)
        np.testing.assert_allclose(
            -first.wrench[W.force_world + 2], 0.2 * 9.81 * first.vehicles[P.mass], rtol=1e-12
        )
        masses.append(first.vehicles[P.mass].copy())
        first.reset(), again.reset()
    assert np.unique(masses).size == 48


def test_the_base_vehicle_says_what_a_distribution_does_not():
    ranges = {
        "mass": 1.0,
        "thrust_to_weight": 2.0,
        "torque_to_inertia": 300.0,
        "motor_time_constant": 0.05,
    }
    base = load_vehicle("hummingbird").model_copy(update={"delay": 3})
    (one,) = sample_vehicles({**ranges, "moment_thrust_ratio": 0.02}, 1, vehicle=base)
    assert one.rotor_directions == base.rotor_directions and one.delay == 3
    np.testing.assert_allclose(
        np.array(one.inertia) / one.inertia[0], np.array(base.inertia) / base.inertia[0]
    )
    np.testing.assert_allclose(one.rotor_positions, np.cbrt(2.0) * np.array(base.rotor_positions))
    np.testing.assert_allclose(one.hover_rotor_speed, base.hover_rotor_speed)
    unknown = base.model_copy(update={"thrust_coefficient": 0.0})
    (one,) = sample_vehicles({**ranges, "moment_thrust_ratio": 0.02}, 1, vehicle=unknown)
    assert one.thrust_coefficient == 0.0
    np.testing.assert_allclose(one.hover_rotor_speed, 1000.0)


def test_a_distribution_goes_with_an_agent_and_a_vehicle_replaces_it():
    own = FlightSettings().with_changes(vehicles={**RAPTOR, "mass": [0.1, 0.2]})
    assert own.vehicles.mass.high == 0.2 and own.vehicles.thrust_to_weight.high == 5.0
    again = FlightSettings.model_validate(own.model_dump(mode="json"))
    assert again.vehicles == own.vehicles and again.in_any_task()["vehicles"] == own.vehicles
    assert own.with_changes(vehicle="itm").vehicles is None
    env = gymnasium.make("QuadTargetTracking-v0", vehicles="raptor")
    masses = {
        float(env.unwrapped.true_state().vehicles[P.mass, 0]) for _ in range(2) if env.reset()
    }
    assert len(masses) == 2
    env.close()


# --- experts that know the vehicle and what pushes it


def test_wind_carries_away_what_has_drag_and_the_privileged_expert_holds_against_it():
    windy = {"drag": 0.4, "wind": 4.0}
    airy = {
        **windy,
        "rotors": [0.85, 1.15],
        "rotor_drag": 0.2,
        "airspeed_moment": [-1, 4],
        "translational_lift": 0.02,
        "rate_damping": [0, 8],
        "rotor_inertia": 0.01,
        "ground_effect_radius": [0, 40],
    }
    for randomize, expert, least, most in (
        ({"wind": 4.0}, GeometricExpert(), 0.0, 1e-3),
        (windy, GeometricExpert(), 0.1, 2.0),
        (windy, privileged_geometric(), 0.0, 1e-3),
        (airy, privileged_geometric(), 0.0, 0.03),
    ):
        errors = fly(
            expert, "target_tracking", 12, seed=3, max_episode_steps=900, randomize=randomize
        ).final_error
        assert least <= errors.min() and errors.max() < most


def test_the_privileged_expert_stays_where_the_other_is_pushed_away():
    torque = {"magnitude": [0.0, 0.1], "axes": [1, 1, 0.33]}
    randomize = {
        "mass": [0.8, 1.2],
        "motor_gain": [0.7, 1.5],
        "force": [1.0, 4.0],
        "torque": torque,
    }
    errors = {}
    privileged = privileged_geometric()
    for expert in (GeometricExpert(), privileged):
        batch = batch_of(96, task="state_recovery", randomize=randomize, autoreset=False)
        for _ in range(800):
            batch.step(expert.actions(batch.true_state()))
        errors[expert is privileged] = np.median(batch.outcome["distance"])
    assert errors[True] < 0.01 < 0.1 < errors[False]


def test_the_privileged_expert_flies_every_vehicle_of_a_distribution():
    flights = fly(
        privileged_geometric(),
        "state_recovery",
        96,
        seed=11,
        max_episode_steps=900,
        vehicles=RAPTOR,
    )
    assert flights.survival.mean() > 0.9 and np.median(flights.final_error) < 2e-3


def test_the_privileged_expert_flies_as_the_others_where_nothing_is_random():
    batch, gains, told = (
        batch_of(240, task="state_recovery"),
        GeometricExpert().gains,
        privileged_geometric(),
    )
    plain = GeometricExpert(
        gains=gains.model_copy(update={"yaw_rate": PRIVILEGED_YAW * gains.yaw_rate})
    )
    for _ in range(100):
        state = batch.true_state()
        np.testing.assert_allclose(told.actions(state), plain.actions(state), atol=1e-5)
        batch.step(plain.actions(state))
