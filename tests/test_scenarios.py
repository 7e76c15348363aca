"""Scenarios: what a file says is what is flown, impossible ones are refused in one line, the
shipped suites hold together.
"""

import math
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sb3_quad.base.errors import ConfigError
from sb3_quad.envs.simulation.state import QuadcopterState
from sb3_quad.envs.simulation.vehicle_distribution import DISTRIBUTIONS
from sb3_quad.envs.vehicles.vehicle import load_vehicle
from sb3_quad.evaluation.scenarios.load import SUITES, load_suite, parse_suite
from sb3_quad.evaluation.scenarios.sample import sample_plan
from sb3_quad.evaluation.scenarios.scenario import Suite


def suite(entry):
    return parse_suite(f"name: mine\nscenarios:\n  - {{name: s, {entry}}}\n", "x")


def scenario(entry):
    return suite(entry).scenarios[0]


@pytest.mark.parametrize("name", SUITES.names())
def test_shipped_suites_survive_json(name):
    loaded = load_suite(name)
    assert loaded.name == name
    assert Suite.model_validate_json(loaded.model_dump_json()) == loaded


def test_the_thesis_suite_holds_all_of_chapter_four():
    thesis = load_suite("thesis")
    for name, distance in (("tracking", None), ("tracking_15m", 15), ("tracking_20m", 20)):
        assert (thesis.scenario(name).task_kwargs or {}).get("target_distance") == distance
    for name, sign in (("target_up", 1), ("target_down", -1)):
        way = np.array(thesis.scenario(name).target) - [0, 0, 15]
        np.testing.assert_allclose(way, sign * 10 / math.sqrt(3) * np.ones(3))
    recovery = thesis.scenario("recovery")
    assert recovery.n_episodes == 4 * 240
    assert sample_plan(recovery, [0]).start == {}  # the task samples it


@pytest.mark.parametrize(
    ("entry", "key"),
    [
        ("strat: 3", "start"),
        ("max_episode_steps: 100", "duration"),
        ("start: {velocity: {sdt: 2}}", "start.velocity"),
        ("start: {velocity_frame: body, velocity: [1, 0, 0]}", "velocity_frame"),
        ("start: {tilt: 3, quaternion: [1, 0, 0, 0]}", "tilt"),
        ("duration: 15 s", "duration"),
        ("duration: 0.001", "duration"),
        ("noise: 5", "noise"),
        ("task: target_traking", "target_tracking"),
        ("task_kwargs: {start_position: [0, 0, 0.1]}", "start_position"),
        ("task_kwargs: {target_distance: 31}", "max_distance"),
        ("target: [0, 0, -3]", "target"),
        ("target: [0, 0, 90]", "max_distance"),
        ("target: [0, 0, 9], waypoints: [[0, 0, 9]]", "waypoints"),
        ("vehicle: itn", "itm"),
        ("randomize: {mass: 1.7}", "randomize"),
        ("vehicles: raptor, randomize: {mass: 9}", "randomize"),
        ("randomize: {force: [0, 1]}, wrenches: [{force: [1, 0, 0]}]", "randomize"),
        ("wrenches: [{start: 14.996}]", "wrenches.0"),
        ("wrenches: [{duration: 0.001}]", "wrenches.0"),
        ("vary: {noise: [true, false]}", "vary"),
        ("vary: {noise: 0.1}", "vary"),
        ("vary:", "vary"),
        ("vary: {noise.level: [0, 1]}, noise: 0.1", "vary.noise.level"),
    ],
)
def test_what_is_impossible_is_one_line_that_names_the_key(entry, key):
    with pytest.raises(ConfigError) as caught:
        scenario(entry)
    message = str(caught.value)
    assert message.startswith("x: scenario s") and key in message and "\n" not in message


def test_the_example_of_the_documentation_is_valid():
    text = (Path(__file__).parent.parent / "docs" / "evaluate.md").read_text(encoding="utf-8")
    example, _ = re.findall(r"```yaml\n(.*?)```", text, re.DOTALL)
    names = [scenario.name for scenario in parse_suite(example, "example").scenarios]
    assert names[:2] == ["yard", "course"] and names[-1] == "rolled.90_8"


def test_missing_files_and_names_are_refused():
    for source in ("no/such.yaml", "tesis"):
        with pytest.raises(ConfigError, match=source):
            load_suite(source)
    with pytest.raises(ConfigError, match="scenarios"):
        parse_suite("name: x\nscenarios: [{name: a}, {name: a}]", "x")


def test_vehicle_files_lie_beside_the_suite(tmp_path):
    vehicle = load_vehicle("itm").model_copy(update={"name": "other", "mass": 1.5})
    (tmp_path / "other.yaml").write_text(vehicle.model_dump_json())  # JSON is YAML
    (tmp_path / "ranges.yaml").write_text(DISTRIBUTIONS.text("raptor")[0])
    keys = "vehicle: other.yaml, vehicles: {distribution: ranges.yaml}"
    (tmp_path / "mine.yaml").write_text(f"name: x\nscenarios: [{{name: a, {keys}}}]")
    (loaded,) = load_suite(tmp_path / "mine.yaml").scenarios
    assert loaded.nominal_vehicle().mass == 1.5 and loaded.vehicles is not None


def test_vary_is_a_grid_of_named_cells():
    cells = suite("title: grid, vary: {noise: [0, 0.1], start.tilt: [0, 45, 90]}").scenarios
    assert len({cell.name for cell in cells}) == 6
    for cell in cells:
        assert cell.group == "s" and cell.heading == "Grid"
        assert cell.name == f"s.{cell.noise:g}_{cell.start.tilt:g}"
    with pytest.raises(ConfigError, match=r"s\.1"):
        suite("vary: {noise: [1, 1]}")


@pytest.mark.parametrize(
    ("entry", "distance"),
    [
        ("noise: 0.1", 10),
        ("task_kwargs: {target_distance: 20}", 20),
        ("target: [10, 0, 15]", None),  # one of the directions that the mean is of
        ("task_kwargs: {start_position: [0, 0, 14]}", None),
        ("start: {velocity: [1, 0, 0]}", None),
        ("randomize: {delay: 4}", None),
        ("wrenches: [{force: [1, 0, 0]}]", None),
        ("tolerances: [0.2]", None),
        ("task: state_recovery", None),
    ],
)
def test_the_physical_limit_is_told_where_it_is_that_of_the_flights(entry, distance):
    expected = None if distance is None else load_vehicle("crazyflie").time_optimal[distance]
    assert scenario(f"vehicle: crazyflie, {entry}").physical_limit == expected


@pytest.mark.parametrize(
    ("entry", "has_way"),
    [
        ("noise: 0.1", True),
        ("task: state_recovery, target: [0, 0, 20]", True),
        ("waypoints: [[0, 0, 20], [0, 0, 15]]", True),
        ("task: state_recovery", False),
        ("task_kwargs: {target_distance: 0}", False),
    ],
)
def test_a_scenario_knows_whether_it_goes_anywhere(entry, has_way):
    assert scenario(entry).has_way == has_way


def test_the_vehicle_that_is_asked_for_flies_also_where_each_episode_has_its_own():
    changed = load_suite("quadcopters").with_changes(vehicle="crazyflie")
    for entry in changed.scenarios:
        assert entry.vehicle == "crazyflie" and entry.vehicles is None


@given(
    seed=st.integers(0, 2**31),
    tilt=st.floats(0, 180),
    speed=st.floats(0, 20),
    rate=st.floats(0, 50),
)
def test_samples_have_the_size_that_was_asked_for(seed, tilt, speed, rate):
    entry = (
        f"start: {{tilt: {tilt}, velocity: {{magnitude: {speed}}}, "
        f"body_rates: {{magnitude: {rate}}}}}"
    )
    sampled = sample_plan(scenario(entry), range(seed, seed + 3)).start
    again = sample_plan(scenario(entry), range(seed, seed + 3)).start
    state = np.zeros((20, 3))
    state[3:7] = sampled["quaternion"].T
    cosines = QuadcopterState(state).rotation[:, 2, 2]
    np.testing.assert_allclose(cosines, math.cos(math.radians(tilt)), atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(sampled["velocity"], axis=1), speed, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(sampled["body_rates"], axis=1), rate, atol=1e-9)
    for name, values in sampled.items():
        np.testing.assert_array_equal(values, again[name])


@given(
    st.lists(
        st.tuples(st.integers(0, 40), st.integers(1, 60), st.sampled_from(["world", "body"])),
        min_size=1,
        max_size=4,
    ),
    st.floats(0, 3),
)
def test_the_wrench_at_any_time_is_the_sum_of_those_that_act(times, factor):
    entries = ", ".join(
        f"{{start: {first / 100}, duration: {length / 100}, force_frame: {frame}, factor: {factor},"
        f" force: [{k + 1}, 0, 0], torque: [0, {k + 1}, 0]}}"
        for k, (first, length, frame) in enumerate(times)
    )
    windy = scenario(f"duration: 0.5, wrenches: [{entries}]")
    wrenches = sample_plan(windy, [0]).wrenches
    now = np.zeros((1, 12))
    for step in range(windy.steps):
        now = wrenches.get(step, now)
        expected = np.zeros(12)
        for k, (first, length, frame) in enumerate(times):
            if first <= step < first + length:
                expected[0 if frame == "world" else 3] += k + 1
                expected[10] += k + 1  # torques are in the body frame unless said
        np.testing.assert_allclose(now, [factor * expected], atol=1e-12)
