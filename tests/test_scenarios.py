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
from sb3_quad.envs.simulation.state import QuadcopterState, make_wrench
from sb3_quad.envs.simulation.vehicle_distribution import DISTRIBUTIONS
from sb3_quad.envs.vehicles.vehicle import load_vehicle
from sb3_quad.evaluation.scenarios.load import SUITES, axis_label, load_suite, parse_suite
from sb3_quad.evaluation.scenarios.parts import VehicleChanges
from sb3_quad.evaluation.scenarios.sample import sample_plan
from sb3_quad.evaluation.scenarios.scenario import Scenario, Suite


def suite(*entries: str) -> Suite:
    return parse_suite(
        "name: mine\nscenarios:\n"
        + "".join(f"  - {{name: s{k}, {entry}}}\n" for k, entry in enumerate(entries)),
        "x",
    )


def scenario(entry: str) -> Scenario:
    return suite(entry).scenarios[0]


@pytest.mark.parametrize("name", SUITES.names())
def test_shipped_suites_survive_json(name):
    loaded = load_suite(name)
    assert loaded.name == name
    assert Suite.model_validate_json(loaded.model_dump_json()) == loaded


def test_the_thesis_suite_holds_all_of_chapter_four():
    thesis = load_suite("thesis")
    tracking = {
        thesis.scenario(name).target.distance
        for name in ("tracking", "tracking_15m", "tracking_20m")
    }
    assert tracking == {10.0, 15.0, 20.0}
    assert set(np.round(np.arange(0.2, 1.01, 0.1), 1)) | {0.05, 0.1} <= set(
        thesis.scenario("tracking").tolerances
    )
    for name, sign in (("target_up", 1), ("target_down", -1)):
        way = np.array(thesis.scenario(name).target.position) - [0, 0, 15]
        np.testing.assert_allclose(way, sign * 10 / math.sqrt(3) * np.ones(3))
    assert thesis.scenario("recovery").episodes == 4 * 240
    assert sample_plan(thesis.scenario("recovery"), [0]).start == {}  # the environment samples it


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ("strat: 3", "did you mean 'start'"),
        ("start: {velocity: {sdt: 2}}", "start.velocity: unknown key 'sdt': did you mean 'std'"),
        ("duration: 15 s", "'15 s' must be a plain number"),
        ("noise: 5", "0.05 is 5 %"),
        ("start: {attitude: levle}", "did you mean 'level'"),
        ("start: {position: [0, 0, 0.1]}", "start.position: touches the ground"),
        ("target: [0, 0, -3]", " target: touches the ground"),
        ("target: {distance: 31}", "max_distance"),
        ("start: {velocity: {std: 5000}}", "velocity_std"),
        ("target: {distance: 10, position: [1, 2, 3]}", "exactly one of"),
        ("vehicle: itn", "did you mean 'itm'"),
        ("vehicle_changes: {mass: 1.7}", "could not fly"),
        ("vehicles: raptor, vehicle_changes: {mass: 1.1}", "are sampled by vehicles"),
        ("vehicles: raptor, vehicle_changes: {motor_gain: 0.2}", "are sampled by vehicles"),
        ("vehicles: raptor, wrenches: [{unit: weight}]", "wrenches.0: unit: weight is that of one"),
        ("wrenches: [{start: 16}]", "wrenches.0: must start within the episode of 15 s"),
        ("wrenches: [{start: 14.996}]", "wrenches.0: must start within the episode of 15 s"),
        ("wrenches: [{duration: 0.001}]", "last for a control step"),
        ("target: {distance: 10, radius: 0.01}", "radius: is that of waypoints"),
        ("vary: {noise: [0, 0]}", "different numbers"),
        ("vary: {noise: [true, false]}", "different numbers"),
        ("vary: {}", "must map keys to lists of numbers"),
        ("vary:", "must map keys to lists of numbers"),
        ("vary: {value: [1]}", "unknown key 'value'"),
        ("vary: {noise.level: [0, 1]}, noise: 0.1", "holds no keys"),
    ],
)
def test_what_is_impossible_is_named(entry, message):
    with pytest.raises(ConfigError) as caught:
        scenario(entry)
    assert (
        message in str(caught.value)
        and str(caught.value).startswith("x: scenario s0: ")
        and "\n" not in str(caught.value)
    )


def test_the_example_of_the_documentation_is_valid():
    text = (Path(__file__).parent.parent / "docs" / "evaluate.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```yaml\n(.*?)```", text, re.DOTALL)
    names = [scenario.name for scenario in parse_suite(example, "example").scenarios]
    assert names[:2] == ["yard", "course"] and len(names) == 9 and names[-1] == "rolled.90_8"


def test_missing_files_and_unknown_names():
    with pytest.raises(ConfigError, match=r"no/such\.yaml: no such file"):
        load_suite("no/such.yaml")
    with pytest.raises(ConfigError, match="did you mean 'thesis'"):
        load_suite("tesis")
    with pytest.raises(ConfigError, match="twice"):
        parse_suite("name: x\nscenarios: [{name: a}, {name: a}]", "x")


def test_vehicle_files_lie_beside_the_suite(tmp_path):
    vehicle = load_vehicle("itm").model_copy(update={"name": "other", "mass": 1.5})
    (tmp_path / "other.yaml").write_text(vehicle.model_dump_json())  # JSON is YAML
    (tmp_path / "mine.yaml").write_text("name: x\nscenarios: [{name: a, vehicle: other.yaml}]")
    assert load_suite(tmp_path / "mine.yaml").scenarios[0].flown_vehicle().mass == 1.5
    (tmp_path / "ranges.yaml").write_text(DISTRIBUTIONS.text("raptor")[0])
    for vehicles in ("ranges.yaml", "{distribution: ranges.yaml}"):
        (tmp_path / "mine.yaml").write_text(
            f"name: x\nscenarios: [{{name: a, vehicles: {vehicles}}}]"
        )
        assert load_suite(tmp_path / "mine.yaml").scenarios[0].vehicles is not None


def test_vary_is_a_grid_of_named_cells():
    cells = suite(
        "title: grid, vary: {noise: [0, 0.1], start.attitude.tilt: [0, 45, 90]}"
    ).scenarios
    assert len(cells) == 6 and len({cell.name for cell in cells}) == 6
    for cell in cells:
        assert cell.group == "s0"
        assert (cell.noise, cell.start.attitude.tilt) == (
            cell.cell["noise"],
            cell.cell["start.attitude.tilt"],
        )
    assert axis_label("start.attitude.tilt") == "tilt (deg)"


@pytest.mark.parametrize(
    ("entry", "limit"),
    [
        ("target: {distance: 10}", 10),
        ("target: {distance: 20}, noise: 0", 20),
        ("target: {distance: 15}", None),
        ("target: [10, 0, 15]", None),  # one of the directions that the mean is of
        ("start: {position: [0, 0, 14]}, target: {distance: 10}", None),
        ("start: {velocity: [1, 0, 0]}, target: {distance: 10}", None),
        ("vehicle_changes: {delay: 4}, target: {distance: 10}", None),
        ("vehicles: raptor, vehicle_changes: {delay: 4}, target: {distance: 10}", None),
        ("randomize: {gusts: {std: 1}}, target: {distance: 10}", None),
        ("wrenches: [{force: [1, 0, 0]}], target: {distance: 10}", None),
        ("tolerances: [0.2], target: {distance: 10}", None),
        ("start: {attitude: uniform}", None),
    ],
)
def test_the_physical_limit_is_told_where_it_is_that_of_the_flights(entry, limit):
    for name in ("crazyflie", "itm"):
        vehicle = load_vehicle(name)
        expected = None if limit is None else vehicle.time_optimal[limit]
        each = scenario(f"vehicle: {name}, {entry}")
        assert each.physical_limit == expected
        other = vehicle.model_copy(update={"mass": 1.01 * vehicle.mass})
        assert each.model_copy(update={"vehicle": other}).physical_limit is None


@pytest.mark.parametrize("name", ["itm", "crazyflie"])
def test_wrenches_in_weights_grow_with_the_vehicle_and_change_no_others(name):
    vehicle = load_vehicle(name)
    push = "{force: [0, 0, -0.5], torque: [2, 0, 0], unit: weight}"
    each = scenario(
        f"vehicle: {name}, vehicle_changes: {{mass: 1.2}}, "
        f"wrenches: [{push}, {{start: 1, force: [1, 0, 0]}}]"
    )
    first, second = sample_plan(each, [0]).wrenches.values()
    weight = vehicle.mass * vehicle.gravity  # of the vehicle as its controller knows it
    torque = 2 * weight * vehicle.arm_length
    both = make_wrench(
        np.array([[0, 0, -0.5 * weight], [1, 0, 0]]), np.array([[torque, 0, 0], [0, 0, 0]])
    )
    np.testing.assert_allclose([first[0], (second - first)[0]], both.T, atol=1e-12)
    varied = suite(
        "wrenches: [{force: {magnitude: 0}, unit: weight}], "
        "vary: {wrenches.0.force.magnitude: [0, 1]}"
    )
    assert axis_label("wrenches.0.force.magnitude", varied.scenarios[1]) == "force (weights)"


def test_what_is_random_in_a_scenario_is_part_of_it_and_changes_no_others():
    gusty = scenario("randomize: {mass: [0.9, 1.1], gusts: {std: 1, time_constant: 0.5}}")
    assert Scenario.model_validate(gusty.model_dump(mode="json")) == gusty and not gusty.is_fixed
    plain = scenario("noise: 0.1")
    assert plain.is_fixed
    cells = suite("randomize: {gusts: {std: 0}}, vary: {randomize.gusts.std: [0, 2]}").scenarios
    assert [cell.randomize.gusts.std.high for cell in cells] == [0, 2]
    assert axis_label("randomize.gusts.std") == "gusts (std, N)"
    for entry, message in (
        ("randomize: {gust: {std: 1}}", "did you mean 'gusts'"),
        ("randomize: {mass: [1, 2]}", "cannot hover"),
        ("randomize: {force: [0, 1]}, wrenches: [{force: [1, 0, 0]}]", "do not go with wrenches"),
    ):
        with pytest.raises(ConfigError, match=message):
            scenario(entry)


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
        f"start: {{attitude: {{tilt: {tilt}}}, velocity: {{magnitude: {speed}}}, "
        f"body_rates: {{magnitude: {rate}}}}}"
    )
    sampled, again = (sample_plan(scenario(entry), range(seed, seed + 3)).start for _ in range(2))
    state = np.zeros((20, 3))
    state[3:7] = sampled["quaternion"].T
    cosines = QuadcopterState(state).rotation[:, 2, 2]
    np.testing.assert_allclose(cosines, math.cos(math.radians(tilt)), atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(sampled["velocity"], axis=1), speed, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(sampled["body_rates"], axis=1), rate, atol=1e-9)
    for name, values in sampled.items():
        np.testing.assert_array_equal(values, again[name])
        if (
            name == "velocity" and speed > 1e-300
        ):  # smaller ones have too few digits to tell directions apart
            assert len(np.unique(values[:, 0])) == 3


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


@given(mass=st.floats(0.7, 1.4), action=st.floats(-1, 1))
def test_a_heavier_vehicle_keeps_its_motors(mass, action):
    vehicle = load_vehicle("itm")
    changed = VehicleChanges(mass=mass).apply(vehicle)
    assert changed.mass == pytest.approx(mass * 1.727)
    np.testing.assert_allclose(
        changed.action_to_thrust(np.array(action)), vehicle.action_to_thrust(np.array(action))
    )
