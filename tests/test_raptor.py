"""RAPTOR's policy: what is said where it is missing, and, where it is installed, that it flies with its rotors in order."""

import importlib.util
import sys

import numpy as np
import pytest
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_quad.base.errors import ConfigError, MissingExtra
from sb3_quad.cli import main
from sb3_quad.controllers.controller import Controller
from sb3_quad.controllers.resolve import resolve_expert
from sb3_quad.envs.vec_env import QuadcopterVecEnv
from sb3_quad.evaluation.flights import fly
from sb3_quad.evaluation.scaling import AdaptiveScaling
from sb3_quad.evaluation.scenario_flights import fly_scenario
from sb3_quad.evaluation.scenarios.load import parse_suite
from sb3_quad.vehicles.vehicle import load_vehicle

installed = pytest.mark.skipif(importlib.util.find_spec("foundation_policy") is None, reason="needs the extra [raptor]")


class Counter:
    """Remembers how often it was asked, as SB3's recurrent policies do, and notes what it was given."""

    def __init__(self):
        self.given, self.starts = [], []

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        self.given.append(state)
        self.starts.append(episode_start)
        return np.zeros((len(observation), 4)), (1 if state is None else state + 1)


def test_a_missing_package_is_one_line_that_says_what_to_install(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "foundation_policy", None)
    monkeypatch.delitem(sys.modules, "sb3_quad.experts.raptor", raising=False)
    with pytest.raises(MissingExtra):
        resolve_expert("raptor")
    suite = tmp_path / "small.yaml"
    suite.write_text("{name: small, scenarios: [{name: hover, duration: 0.1, episodes: 1, vary: {noise: [0, 0.1]}}]}")
    assert main(["evaluate", "pid", "raptor", "--suite", str(suite), "-o", str(tmp_path / "out"), "--no-report"]) == 1
    (line,) = (line for line in capsys.readouterr().err.splitlines() if "compiling" not in line)
    assert line.startswith("failed: raptor: raptor needs foundation_policy") and "pip install '.[raptor]'" in line


def test_what_a_controller_remembers_is_of_one_flight():
    counter = Counter()
    for n in (3, 2):
        fly(counter, "target_tracking", n, max_steps=4)
    assert counter.given == [None, 1, 2, 3] * 2


def test_what_an_expert_remembers_goes_on_in_its_environment_and_says_who_begins():
    counter, env = Counter(), QuadcopterVecEnv(2, seed=0)
    labeller, observation, starts = Controller.for_env(counter, env), env.reset(), np.array([True, False])
    labeller.labels(observation, np.ones(2, dtype=bool))
    Controller.for_env(counter, env, labeller).labels(observation, starts)
    Controller.for_env(counter, QuadcopterVecEnv(2, seed=0), labeller).labels(observation, starts)
    assert counter.given == [None, 1, None]
    np.testing.assert_array_equal(counter.starts[1], starts)


def test_scaled_observations_leave_the_state_to_the_controller():
    counter, env = Counter(), QuadcopterVecEnv(2, seed=0)
    labeller = Controller.for_env(AdaptiveScaling(counter), env)
    for _ in range(2):
        labeller.labels(env.reset())
    assert counter.given == [None, 1]


def tilted(axis, degrees):
    """A suite's scenario: a metre from its target, tilted about a body axis."""
    half = np.deg2rad(degrees) / 2
    quaternion = np.array([np.cos(half), *(np.sin(half) * np.array(axis))]).tolist()
    entry = f"{{name: s, start: {{attitude: {{quaternion: {quaternion}}}}}, target: [1, 0, 15], duration: 10, episodes: 4}}"
    return parse_suite(f"{{name: one, scenarios: [{entry}]}}", "x").scenarios[0]


@installed
@pytest.mark.parametrize("axis", [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)])
@pytest.mark.parametrize("vehicle", ["itm", "crazyflie"])
def test_it_recovers_about_each_axis_and_flies_a_metre_to_its_target(axis, vehicle):
    """Rotors in another order, or turning the other way, tumble or spin; ITM's and Crazyflie's differ in their order."""
    scenario = tilted(axis, 40).model_copy(update={"vehicle": vehicle})
    flights, tracks = fly_scenario(resolve_expert("raptor", vehicle), scenario, recorded=4)
    assert flights.success.all()
    w, x, y, z = tracks["quaternion"][:, -1].T
    assert np.abs([x, y, z]).max() < 0.1 and np.abs(w).min() > 0.99  # it turns to its heading, too


@installed
def test_each_row_begins_an_episode_of_its_own():
    raptor, env = resolve_expert("raptor"), QuadcopterVecEnv(3, seed=0, noise=0.0)
    first = env.reset()
    actions, state = raptor.predict(first)
    _, later = raptor.predict(first, state)
    again, _ = raptor.predict(first, later, np.array([True, False, True]))
    assert actions.dtype == np.float32 and (actions[[0, 2]] == again[[0, 2]]).all() and (actions[1] != again[1]).any()
    assert evaluate_policy(raptor, QuadcopterVecEnv(4, seed=0), n_eval_episodes=4)[0] > -15


@installed
def test_it_refuses_other_rotors():
    itm = load_vehicle("itm")
    for vehicle in (load_vehicle("hummingbird"), itm.model_copy(update={"rotor_directions": (-1, 1, -1, 1)})):
        with pytest.raises(ConfigError, match="raptor: flies an X"):
            resolve_expert("raptor", vehicle)
