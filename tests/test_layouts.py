"""Vehicles that number their rotors in another way, or whose body axes lie otherwise, flown by
agents and exported files.
"""

import itertools
import warnings

import numpy as np
import pytest
from test_export import compiled, load, physical_features

import sb3_quad
from sb3_quad.agents.pretrained import pretrained_path
from sb3_quad.agents.resolve import resolve_expert
from sb3_quad.base.errors import ConfigError
from sb3_quad.envs.vehicles.layout import find_turn
from sb3_quad.envs.vehicles.vehicle import Vehicle, load_vehicle
from sb3_quad.evaluation.flights import fly
from sb3_quad.export.policy import export_policy

ITM, CRAZYFLIE = load_vehicle("itm"), load_vehicle("crazyflie")
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


@pytest.mark.parametrize("turn", [0, 30, 45, 260])
@pytest.mark.parametrize("sign", [1, -1])
def test_thrusts_give_the_same_forces_and_moments_in_any_layout(turn, sign):
    thrusts = np.array([1.0, 2.0, 4.0, 7.0])
    for order in itertools.permutations(range(4)):
        own = renumbered(CRAZYFLIE, order, turn, sign)
        turned = find_turn(own, ITM)
        known = own.in_layout_of(ITM)
        force, *moments = own.mixer @ thrusts
        expected = [force, *turned.axes @ moments]
        np.testing.assert_allclose(known.mixer @ thrusts[[*turned.order]], expected, atol=1e-12)
        assert np.sign(known.mixer).tolist() == np.sign(ITM.mixer).tolist()
        assert abs(turned.angle) <= np.pi / 2 + 1e-9  # of both that fit, the smaller one


def test_rotors_that_no_turn_brings_into_place_are_refused():
    other = CRAZYFLIE.model_copy(update={"name": "long", "rotor_positions": LONG})
    with pytest.raises(ConfigError, match="long"):
        fly(sb3_quad.load_pretrained("crazyflie-recovery"), vehicle=other)


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


def assert_it_flies(agent, vehicle, file_format="onnx"):
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


@pytest.mark.parametrize(
    ("agent", "base", "order", "turn", "file_format"),
    [
        ("crazyflie-robust", "crazyflie", (3, 0, 1, 2), 20, "onnx"),
        pytest.param("any-quadcopter", "hummingbird", (3, 0, 2, 1), 45, "c", marks=compiled),
    ],
)
def test_an_exported_file_flies_the_vehicle_that_it_was_exported_for(
    agent, base, order, turn, file_format
):
    assert_it_flies(agent, renumbered(load_vehicle(base), order, turn), file_format)


def test_a_model_and_an_expert_fly_their_vehicle_in_another_layout():
    own = renumbered(CRAZYFLIE, (3, 0, 1, 2), 45)
    agent = sb3_quad.load_pretrained("crazyflie-recovery")
    expert = resolve_expert("geometric", own, layout="itm")
    task = {"task": "state_recovery", "n_episodes": 24, "max_episode_steps": 500, "vehicle": own}
    assert fly(agent, **task).success.mean() > 0.5
    assert fly(expert, **task, rotor_layout="itm").survival.all()


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ({"vehicle": "crazyflie"}, "rotor_layout itm, here crazyflie"),
        ({"observation_std": [50.0] * 18}, "observation_std"),
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
