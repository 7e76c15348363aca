"""The example of a controller with a state: RAPTOR's policy flies with its rotors in order."""

import sys
from pathlib import Path

import numpy as np
import pytest

from sb3_quad.agents.resolve import resolve_expert
from sb3_quad.base.errors import ConfigError
from sb3_quad.envs.vec_env import QuadcopterVecEnv
from sb3_quad.envs.vehicles.vehicle import load_vehicle
from sb3_quad.evaluation.evaluate import fly_scenario
from sb3_quad.evaluation.flightlog import Recorder
from sb3_quad.evaluation.scenarios.load import parse_suite

pytest.importorskip("foundation_policy")


@pytest.fixture(autouse=True)
def examples(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).resolve().parent.parent / "examples"))
    yield
    sys.modules.pop("raptor", None)


def tilted(axis, degrees):
    """A suite's scenario: a metre from its target, tilted about a body axis."""
    half = np.deg2rad(degrees) / 2
    quaternion = np.array([np.cos(half), *(np.sin(half) * np.array(axis))]).tolist()
    start = f"{{quaternion: {quaternion}}}"
    entry = f"{{name: s, start: {start}, target: [1, 0, 15], duration: 10, n_episodes: 4}}"
    return parse_suite(f"{{name: one, scenarios: [{entry}]}}", "x").scenarios[0]


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, -1, 0), (0, 0, 1)])
@pytest.mark.parametrize("vehicle", ["itm", "crazyflie"])
def test_it_recovers_about_each_axis_and_flies_a_metre_to_its_target(axis, vehicle):
    """Rotors in another order, or turning the other way, tumble or spin; ITM's and Crazyflie's
    differ in their order.
    """
    scenario = tilted(axis, 40).model_copy(update={"vehicle": vehicle})
    recorder = Recorder(4)
    flights = fly_scenario(resolve_expert("raptor:Raptor", vehicle), scenario, hooks=[recorder])
    assert flights.success.all()
    w, x, y, z = recorder.arrays()["quaternion"][:, -1].T
    assert np.abs([x, y, z]).max() < 0.1 and np.abs(w).min() > 0.99  # it turns to its heading, too


@pytest.mark.parametrize("vehicle", ["itm", "crazyflie"])
def test_it_follows_what_it_sees_relative_to_a_moving_target(vehicle):
    entry = "{name: s, task_kwargs: {target_distance: 0}, duration: 10, n_episodes: 2,"
    entry += " reference: {curve: figure_eight, speed: 1}}"
    scenario = parse_suite(f"{{name: one, scenarios: [{entry}]}}", "x").scenarios[0]
    scenario = scenario.model_copy(update={"vehicle": vehicle})
    flights = fly_scenario(resolve_expert("raptor:Raptor", vehicle), scenario)
    assert (flights.rms_error < 0.06).all()


def test_each_row_begins_an_episode_of_its_own():
    raptor, first = resolve_expert("raptor:Raptor"), QuadcopterVecEnv(3, seed=0, noise=0.0).reset()
    actions, state = raptor.predict(first)
    _, later = raptor.predict(first, state)
    again, _ = raptor.predict(first, later, np.array([True, False, True]))
    assert (
        actions.dtype == np.float32
        and (actions[[0, 2]] == again[[0, 2]]).all()
        and (actions[1] != again[1]).any()
    )


def test_it_refuses_other_rotors():
    itm = load_vehicle("itm")
    for vehicle in (
        load_vehicle("hummingbird"),
        itm.model_copy(update={"rotor_directions": (-1, 1, -1, 1)}),
    ):
        with pytest.raises(ConfigError, match="RAPTOR flies an X"):
            resolve_expert("raptor:Raptor", vehicle)
