"""References that move: their tables, the observation relative to them, and how closely flights
follow.
"""

import math
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from sb3_quad.agents.agent_settings import settings_of_record
from sb3_quad.base.errors import ConfigError
from sb3_quad.envs import QuadcopterVecEnv
from sb3_quad.envs.simulation.motions import read_points
from sb3_quad.envs.simulation.references import Reference
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.envs.simulation.state import QUATERNION, REFERENCE, STATE_SIZE, QuadcopterState
from sb3_quad.envs.vehicles.vehicle import load_vehicle
from sb3_quad.evaluation.evaluate import fly_scenario
from sb3_quad.evaluation.flightlog import Recorder
from sb3_quad.evaluation.flights import fly
from sb3_quad.evaluation.following import FOLLOWED, Following
from sb3_quad.evaluation.scenarios.load import load_suite, parse_suite
from sb3_quad.experts.geometric import GeometricExpert

DT = 0.01
WAYPOINTS = [(3, 0, 1), (3, 3, 0), (0, 0, 0)]
SINES = ("circle", "figure_eight", "lissajous")


def spiral(times):
    radius = 0.2 * times
    return np.stack([radius * np.cos(times), radius * np.sin(times), 0.1 * times, times], axis=1)


@pytest.fixture
def csv(tmp_path):
    times = DT * np.arange(401)
    frame = pd.DataFrame(spiral(times), columns=["x", "y", "z", "heading"])
    frame.insert(0, "t", times + 7.0)
    frame.to_csv(tmp_path / "path.csv", index=False)
    return str(tmp_path / "path.csv")


def scenario(entry):
    return parse_suite(f"name: mine\nscenarios:\n  - {{name: s, {entry}}}\n", "x").scenarios[0]


def watched(table, delay=0, aside=0.0, turned=0.0, flying=True):
    """Return the errors of a flight that is ``delay`` control steps late on the path of a table,
    ``aside`` m above it, its heading ``turned`` rad away.
    """
    following = Following(True)
    itm = load_vehicle("itm")
    for step in range(delay, len(table)):
        array = np.zeros((STATE_SIZE, 1))
        array[:3, 0] = table[step - delay, :3] + (0.0, 0.0, aside)
        half = 0.5 * (math.atan2(table[step, 10], table[step, 9]) + turned)
        array[QUATERNION, 0] = math.cos(half), 0.0, 0.0, math.sin(half)
        array[REFERENCE, 0] = table[step]
        state = QuadcopterState(array)
        if step == delay:
            following.on_start(state, itm)
        following.after_step(step, state, np.zeros((1, 4)), np.array([flying]))
    return {name: float(values[0]) for name, values in following.results().items()}


# Metrics


def test_whoever_sits_on_the_reference_has_no_errors():
    table = Reference(heading="path").tracks(DT).table
    assert watched(table) == pytest.approx(dict.fromkeys(FOLLOWED, 0.0), abs=1e-12)


@pytest.mark.parametrize("curve", SINES)
def test_the_lag_of_a_delayed_copy_is_its_delay(curve):
    table = np.tile(Reference(curve=curve).tracks(DT).table, (2, 1))
    errors = watched(table, delay=5)
    assert errors["lag"] == pytest.approx(0.05, rel=0.01)
    assert errors["path_error"] < 0.02 < errors["rms_error"] < errors["greatest_error"] < 0.11


def test_errors_across_the_path_and_of_the_heading():
    errors = watched(Reference(heading="path").tracks(DT).table, aside=0.3, turned=-0.2)
    assert errors["lag"] == pytest.approx(0.0, abs=1e-12)
    for name in ("rms_error", "greatest_error", "path_error"):
        assert errors[name] == pytest.approx(0.3)
    assert errors["heading_error"] == pytest.approx(math.degrees(0.2))


def test_what_was_lost_or_rests_or_has_no_heading_has_no_such_errors():
    table = Reference().tracks(DT).table
    assert all(map(math.isnan, watched(table, flying=False).values()))
    assert all(map(math.isnan, watched(0.0 * table).values()))
    assert math.isnan(watched(table)["heading_error"])
    resting = fly(GeometricExpert(), n_episodes=2, max_episode_steps=300)
    assert np.isfinite(resting.cross_track_error).all()
    moving = fly(GeometricExpert(), n_episodes=2, max_episode_steps=300, reference="circle")
    assert np.isnan([resting.rms_error, moving.heading_error, moving.cross_track_error]).all()
    assert (moving.rms_error > 0).all()


# Tables


@pytest.mark.parametrize(("curve", "heading"), zip(SINES, (None, 0.5, "path"), strict=True))
def test_curves_loop_without_a_jump_at_the_speed_that_was_asked_for(curve, heading):
    rate = 1.5 if heading == 0.5 else 0.0
    tracks = Reference(curve=curve, speed=3.0, heading=heading, heading_rate=rate).tracks(DT)
    table = tracks.table
    assert tracks.loops and not table[0, :3].any()
    assert np.linalg.norm(table[:, 3:6], axis=1).max() == pytest.approx(3.0, rel=5e-3)
    steps = np.abs(np.diff(table, axis=0, append=table[:1]))
    assert (steps[-1] <= steps[:-1].max(axis=0) + 1e-9).all()
    if rate:
        np.testing.assert_allclose(table[:, 11], rate, atol=math.radians(0.3))


def test_take_off_rests_at_its_top_and_landing_sinks_evenly():
    up = Reference(curve="take_off", speed=0.5).tracks(DT).table
    assert np.linalg.norm(up[:, 3:6], axis=1).max() == pytest.approx(0.5, rel=5e-3)
    np.testing.assert_allclose(up[-1, :6], (0.0, 0.0, 1.5, 0.0, 0.0, 0.0), atol=1e-9)
    down = Reference(curve="landing").tracks(DT).table
    np.testing.assert_allclose(down[:1000, 2], -0.2 * DT * np.arange(1000), atol=1e-9)
    assert not down[:, :2].any()


def test_an_expert_takes_off_and_lands():
    task = {"target_distance": 0.0, "start_position": (0.0, 0.0, 0.2)}
    up = fly("geometric", "target_tracking", 4, task_kwargs=task, reference="take_off")
    assert up.success.all()
    down = fly("geometric", "landing", 4, reference="landing")
    assert down.success.all() and down.survival.all() and not down.collision.any()
    assert (down.flown < 12.0).all()


def test_random_motion_loops_within_its_limits():
    reference = Reference(curve="random_smooth", speed=3, acceleration=5, resting=0.25)
    tracks = reference.tracks(DT)
    pieces = tracks.table.reshape(-1, tracks.length, tracks.table.shape[1])
    speeds = np.linalg.norm(pieces[..., 3:6], axis=2)
    assert speeds.max() < 3.001 and np.mean(speeds.max(axis=1) == 0.0) == 0.25
    assert np.linalg.norm(pieces[..., 6:9], axis=2).max() < 5.001
    jumps = np.linalg.norm(pieces[:, 0, :3] - pieces[:, -1, :3], axis=1)
    assert (jumps <= 1.01 * DT * speeds.max(axis=1)).all()


def test_least_snap_rests_at_its_ends_and_meets_its_waypoints():
    table = Reference(curve="polynomial", speed=2, waypoints=WAYPOINTS).tracks(DT).table
    speeds = np.linalg.norm(table[:, 3:6], axis=1)
    assert speeds.max() == pytest.approx(2.0, rel=5e-3) and speeds[[0, -1]].max() < 0.01
    for point in WAYPOINTS:
        assert np.linalg.norm(table[:, :3] - point, axis=1).min() < 0.02


def test_a_file_and_a_function_give_the_same_table(csv):
    from_file = Reference.model_validate(csv).tracks(DT)
    reference = Reference(curve="function", function=spiral, duration=4.0)
    from_function = reference.tracks(DT)
    np.testing.assert_allclose(from_file.table, from_function.table, atol=1e-9)
    times, points = read_points(csv)
    assert times[0] == 0.0 and points.shape == (401, 4)


@pytest.mark.parametrize(
    "fields",
    [
        {"curve": "function", "function": spiral, "duration": 3.0},
        {"curve": "helix", "duration": 3.0},
        # An end within a control step, and the greatest speed that a curve can have
        {"curve": "function", "function": spiral, "duration": 3.004},
        {"curve": "helix", "duration": 2.996, "size": (0.1, 0.1, 0.0), "speed": 6.28},
        {"curve": "polynomial", "waypoints": WAYPOINTS, "heading": "path"},
        "csv",
    ],
)
def test_what_does_not_loop_rests_at_its_end(fields, csv):
    reference = Reference.model_validate(csv if fields == "csv" else fields)
    motion, seconds = reference._motion(DT)
    table = reference.tracks(DT).table
    start, end = motion(np.array([0.0, seconds]))[:, :3]
    np.testing.assert_allclose(table[-1, :3], end - start, atol=1e-9)
    assert len(table) - 1 == math.ceil(seconds / DT - 1e-6)
    assert not table[-1, 3:9].any() and not table[-1, 11].any()


# Environments


def test_rows_have_references_of_their_own():
    env = QuadcopterVecEnv(4, seed=0, reference="circle")
    env.reset()
    env.env_method(
        "set_reference", (1, 2, 20), (1, 0, 0), heading=math.pi, heading_rate=0.5, indices=[1, 3]
    )
    for _ in range(3):
        env.step(np.zeros((4, 4)))
    state = env.true_state()
    np.testing.assert_array_equal(state.target[[1, 3]], [(1, 2, 20)] * 2)
    np.testing.assert_array_equal(state.target_velocity[[1, 3]], [(1, 0, 0)] * 2)
    np.testing.assert_allclose(state.target_heading, [(0, 0), (-1, 0)] * 2, atol=1e-12)
    assert (np.linalg.norm(state.target_velocity[[0, 2]], axis=1) > 1.9).all()


@pytest.mark.parametrize("reference", [None, {"curve": "hover", "heading": 0}])
def test_a_heading_of_zero_at_rest_changes_no_bit_of_the_observation(reference):
    plain = QuadcopterVecEnv(5, "state_recovery", seed=1)
    turned = QuadcopterVecEnv(5, "state_recovery", seed=1, reference=reference)
    np.testing.assert_array_equal(plain.reset(), turned.reset())
    if reference is None:
        turned.set_reference((0, 0, 15), heading=0.0)
    for _ in range(50):
        actions = np.random.default_rng(0).uniform(-1, 1, (5, 4))
        np.testing.assert_array_equal(plain.step(actions)[0], turned.step(actions)[0])


# Scenarios


def test_a_scenario_moves_its_own_target():
    flown = scenario(
        "target: [5, 0, 15], reference: {curve: circle, speed: 3}, duration: 3, n_episodes: 2"
    )
    recorder = Recorder(2)
    flights = fly_scenario(GeometricExpert(), flown, [recorder])
    arrays = recorder.arrays()
    table = flown.reference.tracks(DT).table
    moved = (5.0, 0.0, 15.0) + table[:301:2, :3]
    np.testing.assert_allclose(arrays["target"][0], moved, atol=1e-5)
    assert (flights.rms_error > 0).all() and (flights.target == (5, 0, 15)).all()


def test_files_of_a_reference_lie_beside_the_suite(csv, tmp_path):
    suite = tmp_path / "mine.yaml"
    suite.write_text("name: x\nscenarios: [{name: a, reference: path.csv}]")
    (flown,) = load_suite(suite).scenarios
    assert str(flown.reference.file) == csv


def test_a_zip_keeps_a_curve_and_no_file_or_function(csv):
    model = SimpleNamespace()
    for reference, kept in ((csv, None), (spiral, None), ("helix", Reference(curve="helix"))):
        settings = FlightSettings(reference=reference, preview=[0, 5])
        settings.write_into(model)
        own = settings_of_record(model.flight_settings, "model")
        assert own.reference == kept and own.preview == settings.preview


def test_a_heading_that_jumps_by_a_whole_turn_turns_no_further():
    def turning(times):
        heading = (3.0 + 0.5 * times + np.pi) % (2 * np.pi) - np.pi
        return np.column_stack([0 * times, 0 * times, 0 * times, heading])

    rates = Reference(curve="function", function=turning, duration=2.0).tracks(DT).table[:-1, 11]
    np.testing.assert_allclose(rates, 0.5, atol=1e-9)


def test_a_file_may_have_spaces_behind_its_commas(tmp_path):
    file = tmp_path / "spaces.csv"
    file.write_text("t, x, y, z \n0, 0, 0, 0\n1, 1, 2, 3\n")
    np.testing.assert_array_equal(read_points(file)[1], [[0, 0, 0], [1, 2, 3]])


def test_the_heading_of_a_file_goes_the_shorter_way(tmp_path):
    file = tmp_path / "turn.csv"
    file.write_text("t,x,y,z,heading\n0,0,0,0,3.1\n1,0,0,0,-3.1\n")
    heading = read_points(file)[1][:, 3]
    np.testing.assert_allclose(np.diff(heading), 2 * np.pi - 6.2)


@pytest.mark.parametrize(
    "rows", ["0,0,0,0,1\n1,0,0,0,1", "0,0,0,0", "0,nan,0,0\n1,0,0,0", "2,0,0,0\n1,0,0,0"]
)
def test_a_file_that_is_no_path_is_named(tmp_path, rows):
    file = tmp_path / "path.csv"
    file.write_text(f"t,x,y,z\n{rows}\n")
    with pytest.raises(ConfigError, match=r"path\.csv"):
        read_points(file)
