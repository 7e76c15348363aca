"""Vehicles that number their rotors in another way, or whose body axes lie otherwise, flown by
agents and exported files.
"""

import itertools
import json
import warnings

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from test_export import compiled, load, physical_features

import sb3_quad
from sb3_quad.agents.pretrained import pretrained_path
from sb3_quad.agents.resolve import resolve_expert
from sb3_quad.base.errors import ConfigError
from sb3_quad.cli import main
from sb3_quad.envs.vehicles.layout import find_turn
from sb3_quad.envs.vehicles.vehicle import Vehicle, load_vehicle
from sb3_quad.evaluation.flights import fly
from sb3_quad.export.policy import export_policy

ITM, CRAZYFLIE = load_vehicle("itm"), load_vehicle("crazyflie")
ORDERS = list(itertools.permutations(range(4)))
LAYOUTS = list(
    itertools.product((0, 45), (1, -1))
)  # X and plus, with the directions of all rotors kept or changed
LONG = ((0.06, -0.01), (-0.06, -0.01), (-0.06, 0.01), (0.06, 0.01))  # no turn brings these to an X


def renumbered(base, order, turn=0, sign=1):
    """A vehicle with the rotors of another in some order, its body axes turned by some degrees."""
    places = (np.array(base.rotor_positions) @ (1.0, 1.0j) * np.exp(1j * np.radians(turn)))[
        [*order]
    ]
    positions = tuple((float(each.real), float(each.imag)) for each in places)
    directions = tuple(sign * base.rotor_directions[k] for k in order)
    return base.model_copy(
        update={"name": "own", "rotor_positions": positions, "rotor_directions": directions}
    )


def written(vehicle, path):
    path.write_text(yaml.safe_dump(vehicle.model_dump(mode="json", exclude={"geometric_gains"})))
    return str(path)


@pytest.mark.parametrize("turn", [0, 30, 45, 90, 135, 180, 260])
def test_thrusts_give_the_same_forces_and_moments_in_any_layout(turn):
    thrusts = np.array([1.0, 2.0, 4.0, 7.0])
    for order, sign in itertools.product(ORDERS, (1, -1)):
        own = renumbered(CRAZYFLIE, order, turn, sign)
        turned, known = find_turn(own, ITM), own.in_layout_of(ITM)
        force, *moments = own.mixer @ thrusts
        expected = [force, *turned.axes @ moments]
        np.testing.assert_allclose(known.mixer @ thrusts[[*turned.order]], expected, atol=1e-12)
        assert np.sign(known.mixer).tolist() == np.sign(ITM.mixer).tolist()
        assert abs(turned.angle) <= np.pi / 2 + 1e-9  # of both that fit, the smaller one
        np.testing.assert_array_equal(thrusts[[*turned.order]][turned.own], thrusts)


# As each stack's own pages have motors 1 to 4: where they are, and whether they turn clockwise.
MOTORS = {
    "betaflight": "rear right cw, front right ccw, rear left ccw, front left cw",
    "px4": "front right ccw, rear left ccw, front left cw, rear right cw",
    "ardupilot": "front right ccw, rear left ccw, front left cw, rear right cw",
    "crazyflie": "front right ccw, rear right cw, rear left ccw, front left cw",
}


def in_order(order, arm, **more):
    named = {"rotor_order": order, "arm_length": arm, **more}
    data = CRAZYFLIE.model_dump(exclude={"rotor_positions", "rotor_directions", "geometric_gains"})
    return Vehicle.model_validate({**data, "name": order, **named})


@pytest.mark.parametrize("order", MOTORS)
def test_rotors_are_where_the_stack_has_them(order):
    signs = {"front": 1, "rear": -1, "left": 1, "right": -1, "cw": 1, "ccw": -1}
    motors = [[signs[word] for word in motor.split()] for motor in MOTORS[order].split(", ")]
    vehicle = in_order(order, 0.1, arm_angle=30, center_of_mass=[-0.01, 0.02])
    x, y = 0.1 * np.sqrt(3) / 2, 0.05
    for motor, place, direction in zip(
        motors, vehicle.rotor_positions, vehicle.rotor_directions, strict=True
    ):
        assert place == pytest.approx((motor[0] * x + 0.01, motor[1] * y - 0.02))
        assert direction == motor[2]
    outwards = in_order(order, 0.1, props="out").rotor_directions
    assert outwards == tuple(-motor[2] for motor in motors)


@given(
    st.sampled_from([*MOTORS]),
    st.floats(0.03, 0.5),
    st.floats(30, 60),
    st.sampled_from(["in", "out"]),
    st.tuples(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1)),
)
def test_every_order_is_the_same_vehicle_renumbered(order, arm, angle, props, shift):
    more = {"arm_angle": angle, "props": props, "center_of_mass": [arm * each for each in shift]}
    base, other = in_order("betaflight", arm, **more), in_order(order, arm, **more)
    turn = find_turn(other, base)
    assert turn.angle == 0.0
    order_of = [*turn.order]
    np.testing.assert_allclose(np.array(other.rotor_positions)[order_of], base.rotor_positions)
    np.testing.assert_allclose(other.hover_shares[order_of], base.hover_shares)
    assert other.in_layout_of(base).rotor_directions == base.rotor_directions


def test_an_agent_flies_all_orders_alike():
    agent = sb3_quad.load_pretrained("any-quadcopter")
    own = {k: v for k, v in sb3_quad.env_kwargs("any-quadcopter").items() if "vehicle" not in k}
    own |= {"task": "state_recovery", "noise": 0.0}
    shift = {"center_of_mass": [-0.003, 0.001]}
    flown = [
        fly(
            agent,
            n_episodes=24,
            vehicle=[in_order(order, 0.046, **shift)],
            max_episode_steps=400,
            **own,
        )
        for order in MOTORS
    ]
    for flights in flown:
        assert flights.survival.all()
        np.testing.assert_allclose(flights.final_error, flown[0].final_error, atol=1e-4)


def test_an_exported_file_flies_a_vehicle_with_its_battery_at_the_back():
    assert_it_flies("crazyflie-robust", in_order("px4", 0.046, center_of_mass=[-0.0023, 0.0]))


def test_a_wider_vehicle_with_the_same_rotors_is_not_turned():
    wide = ITM.model_copy(
        update={"rotor_positions": ((0.2, 0.15), (0.2, -0.15), (-0.2, -0.15), (-0.2, 0.15))}
    )
    assert wide.in_layout_of(ITM) is wide


class File:
    """An exported file, flown as docs/export.md says."""

    def __init__(self, call, vehicle, previews):
        self.call, self.vehicle, self.state = call, vehicle, None
        self.previews = previews

    def actions(self, state):
        # A target at rest has no acceleration.
        ahead = np.zeros((state.n, 3 * self.previews))
        seen = np.hstack([physical_features(state), ahead]).astype(np.float32)
        result, self.state = self.call(seen, self.state)
        return self.vehicle.thrust_to_action(result.astype(np.float64))


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def assert_it_flies(agent, vehicle, file_format="torchscript"):
    exported = export_policy(
        pretrained_path(agent), file_format, vehicle=vehicle, name="own", n_observations=1000
    )
    first = "0 at x {:.4g} m, y {:.4g} m, yaw moment {:+d}".format(
        *vehicle.rotor_positions[0], vehicle.rotor_directions[0]
    )
    assert exported.metadata["rotors"].startswith(first[:-1])
    previews = len(sb3_quad.env_kwargs(agent)["preview"] or ())
    file = File(load(file_format, exported, "own"), vehicle, previews)
    flights = fly(file, "state_recovery", 8, 3, vehicle, noise=0.0, max_episode_steps=500)
    assert flights.survival.all() and flights.final_error.max() < 0.2


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize(
    ("agent", "base", "order", "turn", "file_format"),
    [
        ("crazyflie-robust", "crazyflie", (3, 0, 1, 2), 0, "torchscript"),
        ("any-quadcopter", "hummingbird", (0, 1, 2, 3), 0, "torchscript"),
        pytest.param(
            "hummingbird-robust", "hummingbird", (1, 3, 2, 0), 20, "onnx", marks=pytest.mark.slow
        ),
        pytest.param(
            "any-quadcopter", "hummingbird", (2, 0, 3, 1), 0, "onnx", marks=pytest.mark.slow
        ),
        pytest.param("any-quadcopter", "hummingbird", (3, 0, 2, 1), 45, "c", marks=compiled),
        pytest.param("crazyflie-robust", "crazyflie", (2, 1, 3, 0), 45, "c", marks=compiled),
    ],
)
def test_an_exported_file_flies_the_vehicle_that_it_was_exported_for(
    agent, base, order, turn, file_format
):
    assert_it_flies(agent, renumbered(load_vehicle(base), order, turn), file_format)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize(("turn", "sign"), LAYOUTS)
@pytest.mark.parametrize(
    ("agent", "base"), [("crazyflie-robust", "crazyflie"), ("any-quadcopter", "hummingbird")]
)
def test_an_exported_file_flies_every_order_and_layout(agent, base, turn, sign):
    first = LAYOUTS.index((turn, sign)) + len(LAYOUTS) * (base == "hummingbird")
    for order in ORDERS[
        first :: 2 * len(LAYOUTS)
    ]:  # all orders in all, three for each layout and agent
        assert_it_flies(agent, renumbered(load_vehicle(base), order, turn, sign))


def test_a_model_flies_its_own_vehicle_in_another_layout():
    for name in ("crazyflie", "hummingbird"):
        own = renumbered(load_vehicle(name), (3, 0, 1, 2), 45)
        agent, expert = (
            sb3_quad.load_pretrained(f"{name}-recovery"),
            resolve_expert("geometric", own, layout="itm"),
        )
        assert (
            fly(agent, "state_recovery", 24, vehicle=own, max_episode_steps=500).success.mean()
            > 0.9
        )
        assert fly(
            expert, "state_recovery", 24, vehicle=own, rotor_layout="itm", max_episode_steps=500
        ).survival.all()


def test_commands_fly_vehicles_of_another_layout(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    file, agents = (
        written(renumbered(CRAZYFLIE, (3, 0, 1, 2), 45), tmp_path / "own.yaml"),
        ["crazyflie-robust", "any-quadcopter"],
    )
    evaluated = [
        "--suite",
        "quick",
        "--scenario",
        "recovery",
        "-n",
        "8",
        "--no-report",
        "-o",
        "out",
    ]
    assert main(["evaluate", *agents, "geometric", "--vehicle", file, *evaluated]) == 0
    entries = json.loads((tmp_path / "out" / "results.json").read_text())["entries"]
    assert [entry["metrics"]["survival"]["value"] for entry in entries] == [1.0] * 3
    kwargs = [
        "--env-kwargs",
        f"vehicle:{file}",
        "--task",
        "state_recovery",
        "--no-render",
        "-n",
        "200",
    ]
    assert main(["enjoy", *agents, "geometric", *kwargs]) == 0
    assert main(["enjoy", "geometric", *kwargs[:2], "rotor_layout:itm", *kwargs[2:]]) == 0
    assert capsys.readouterr().out.count("m from its target after 2.00 s") == 4


def test_a_vehicle_whose_rotors_lie_elsewhere_is_refused_in_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    file = written(
        CRAZYFLIE.model_copy(update={"name": "long", "rotor_positions": LONG}),
        tmp_path / "long.yaml",
    )
    with pytest.raises(
        ConfigError, match=r"no yaw rotation .* rotors of long .* onto those of crazyflie"
    ):
        fly(sb3_quad.load_pretrained("crazyflie-recovery"), vehicle=file)
    for command in (
        ["export", "crazyflie-robust", "--format", "torchscript", "--vehicle", file],
        ["export", "any-quadcopter", "--format", "torchscript", "--vehicle", file],
        ["enjoy", "crazyflie-robust", "--env-kwargs", f"vehicle:{file}", "--no-render"],
        [
            "evaluate",
            "crazyflie-robust",
            "--vehicle",
            file,
            "--suite",
            "quick",
            "-n",
            "2",
            "-o",
            "out",
        ],
    ):
        assert main(command) != 0
        error = capsys.readouterr().err
        assert "maps the rotors of long" in error and error.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["long.yaml"]


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ({"vehicle": "crazyflie"}, "rotor_layout itm, here crazyflie"),
        ({"observation_std": [50.0] * 18}, "observation_std"),
        ({"features": "px4"}, "features body, here px4"),
        ({"vehicle": "crazyflie", "rotor_layout": "itm"}, None),
        ({}, None),
    ],
)
@pytest.mark.parametrize("use", ["initial_policy", "expert"])
def test_agents_that_would_read_other_numbers_are_warned_of(use, how, words, capsys):
    env = sb3_quad.QuadcopterVecEnv(2, "state_recovery", seed=0, **how)
    if use == "expert":
        sb3_quad.DAgger(
            "MlpPolicy", env, expert=sb3_quad.load_pretrained("itm-recovery"), n_steps=1
        ).learn(2)
    else:
        sb3_quad.APG("MlpPolicy", env, initial_policy="itm-recovery")
    warning = capsys.readouterr().err
    if words is None:
        assert "another observation" not in warning
    else:
        assert f"was trained with another observation ({words})" in warning


@pytest.mark.parametrize(
    ("expert", "is_unlike"), [("geometric", True), ("privileged_geometric", False)]
)
def test_an_expert_of_the_first_vehicle_is_warned_of_where_rows_have_others(expert, is_unlike):
    vehicles = ["itm", "crazyflie"]
    env = sb3_quad.QuadcopterVecEnv(2, "state_recovery", vehicle=vehicles, seed=0)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        sb3_quad.DAgger("MlpPolicy", env, expert=expert, n_steps=1).learn(2)
        fly(expert, n_episodes=2, max_episode_steps=1, vehicle=vehicles)
    said = [
        "is made for the vehicle itm and flies crazyflie" in str(each.message) for each in caught
    ]
    assert sum(said) == 2 * is_unlike
