"""``evaluate``: every controller on the same episodes, nothing flown twice or lost, failures in one
line.
"""

import importlib
import sys

import gymnasium
import numpy as np
import pytest
import torch
from stable_baselines3 import A2C, PPO, SAC

from sb3_quad.agents.pretrained import pretrained_path
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.seeds import row_seeds, seed_for
from sb3_quad.cli import main
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.envs.vec_env import QuadcopterVecEnv
from sb3_quad.envs.vehicles.vehicle import load_vehicle
from sb3_quad.evaluation.controllers import parse_controllers
from sb3_quad.evaluation.evaluate import evaluate as evaluate_suite
from sb3_quad.evaluation.evaluate import fly_scenario
from sb3_quad.evaluation.flightlog import read_flights
from sb3_quad.evaluation.results import load_results
from sb3_quad.evaluation.scenarios.load import load_suite

SUITE = """
name: small
source: paper
scenarios:
  - name: tracking
    task_kwargs: {target_distance: 3}
    duration: 2
    tolerances: [0.5, 1.0]
    n_episodes: 5
    published: {expert: {success: 0.5, time_to: {0.5: 1.25}, path: [2, 3]}}
  - name: course
    waypoints: [[0, 0, 15.5], [0, 0.5, 15.5]]
    waypoint_radius: 0.4
    duration: 4
    n_episodes: 2
  - name: starts
    task: state_recovery
    vary: {start.tilt: [0, 60]}
    duration: 1
    n_episodes: 3
"""
FACTORIES = """
import numpy as np
from stable_baselines3 import PPO

def hover(vehicle):
    return lambda observation: np.zeros((len(observation), 4))

def broken(vehicle):
    raise RuntimeError("no\\nmodel")

def fails_in_flight(vehicle):
    return lambda observation: observation

def telling(vehicle):
    return PPO.load("telling.zip", device="cpu")
"""


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A folder with a suite and a module of factories, as a user's."""
    (tmp_path / "small.yaml").write_text(SUITE)
    (tmp_path / "my_controllers.py").write_text(FACTORIES)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    sys.modules.pop("my_controllers", None)
    importlib.invalidate_caches()
    return tmp_path


def evaluate(*arguments: str, folder: str = "out", suite: str = "small.yaml") -> int:
    return main(["evaluate", *arguments, "--suite", suite, "-o", folder, "--no-report"])


def times_of_change(folder):
    return {path: path.stat().st_mtime_ns for path in sorted(folder.rglob("*.npz"))}


def test_the_physical_limit_is_that_of_each_agents_vehicle(here):
    some = ["--scenario", "tracking", "tracking_15m", "-n", "2"]
    assert evaluate("geometric", "crazyflie-robust", *some, suite="thesis") == 0
    limits = [load_vehicle(name).time_optimal[10] for name in ("itm", "crazyflie")]
    assert [entry.physical_limit for entry in load_results("out").entries] == [*limits, None, None]


def test_table_results_and_flights_agree(here, capsys):
    assert evaluate("pid", "still=my_controllers:hover") == 0
    text = capsys.readouterr().out
    for part in ("pid", "still", "paper: expert", "2 to 3", "60, success"):
        assert part in text
    results = load_results("out")
    assert [record.label for record in results.controllers] == ["pid", "still"]
    names = [scenario.name for scenario in results.scenarios]
    assert names == ["tracking", "course", "starts.0", "starts.60"]
    assert len(results.entries) == 8 and not results.failures
    begun = {}
    for entry in results.entries:
        arrays = read_flights(f"out/{entry.flights}")
        n = len(arrays["episode_seed"])
        assert n == entry.metrics.n
        assert np.mean(arrays["episode_outcome"] == "success") == entry.metrics.success.value
        assert arrays["episode_reward"].mean() == pytest.approx(entry.metrics.reward.value)
        assert arrays["position"].shape[:2] == (min(n, 8), len(arrays["time"]))
        # The same starts and targets for both.
        place = np.hstack([arrays["episode_start"], arrays["episode_target"]])
        np.testing.assert_array_equal(begun.setdefault(entry.scenario, place), place)
    reached = [
        np.isfinite(read_flights(f"out/flights/{label}/course.npz")["episode_waypoints"]).sum()
        for label in ("pid", "still")
    ]
    assert reached == [4, 0]
    assert results.entry("pid", "course").metrics.course.completed.value == 1.0


def test_files_that_are_no_results_are_kept(here, capsys):
    (here / "out").mkdir()
    (here / "out" / "report.md").write_text("mine")
    assert evaluate("a=pid", "--scenario", "tracking") == 2
    assert "report.md" in capsys.readouterr().err


def test_a_folder_of_results_is_kept(here, capsys):
    both = ["a=pid", "b=pid", "--scenario", "tracking", "starts"]
    assert evaluate(*both) == 0
    before = times_of_change(here)
    assert evaluate(*both) == 0  # killed after the last flight, say
    assert times_of_change(here) == before
    capsys.readouterr()
    assert evaluate("a=pid", "--scenario", "tracking") == 2
    error = capsys.readouterr().err
    assert "out" in error and "-o" in error and error.count("\n") == 1
    assert times_of_change(here) == before
    assert evaluate("a=pid", "--scenario", "tracking", "--seed", "7", folder="other") == 0
    seeds = read_flights("other/flights/a/tracking.npz")["episode_seed"]
    assert seeds.tolist() == row_seeds(seed_for("suite", 7), 5)


def test_an_interrupted_evaluation_goes_on_by_the_same_command_alone(here):
    def interrupt(done, total, name):
        if done == 3:
            raise KeyboardInterrupt

    suite = load_suite("small.yaml").with_changes(["tracking", "course"])
    both = parse_controllers(["a=pid", "b=geometric"])
    with pytest.raises(KeyboardInterrupt):
        evaluate_suite(suite, both, "out", progress=interrupt)
    assert len(load_results("out").entries) == 3
    before = times_of_change(here)
    half = here / "out" / "flights" / "a" / ".course.npz.1.tmp"
    half.write_bytes(b"half")
    assert evaluate("pid") == 2
    assert evaluate("a=pid", "b=geometric", "--scenario", "tracking", "course") == 0
    assert not half.exists()
    after = times_of_change(here)
    assert len(after) == 4 and before.items() <= after.items()
    assert len(load_results("out").entries) == 4


def test_what_cannot_be_loaded_is_one_line_before_anything_flies(here, capsys):
    (here / "broken_module.py").write_text("1 / 0\n")
    (here / "half.zip").write_bytes(b"PK")
    (here / "logs").mkdir()
    bad = (
        "half.zip",
        "missing.zip",
        "logs",
        "pidd",
        "my_controllers:nothing",
        "no_such_module:make",
        "broken_module:make",
    )
    for spec in bad:
        assert evaluate("pid", spec) == 2
        error = capsys.readouterr().err
        assert spec in error and error.count("\n") == 1
    assert not (here / "out").exists()


def test_failures_are_one_line_each_and_the_others_fly(here, capsys):
    other = PPO("MlpPolicy", gymnasium.make("Pendulum-v1"), n_steps=8, batch_size=8, device="cpu")
    other.save(here / "pendulum.zip")
    bad = ["pendulum.zip", "my_controllers:broken", "my_controllers:fails_in_flight"]
    assert evaluate("pid", *bad, "--scenario", "tracking") == 1
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("failed: ")]
    for line, spec in zip(lines, bad, strict=True):
        assert line.startswith(f"failed: {spec.removesuffix('.zip')}, tracking: ")
    results = load_results("out")
    assert [entry.controller for entry in results.entries] == ["pid"]
    assert len(results.failures) == len(bad)
    # The code of a factory may have changed, so that its results are not shown as if they were new.
    assert evaluate("pid", *bad, "--scenario", "tracking") == 2


def test_labels():
    specs = parse_controllers(["pid", "x/other.zip", "runs/lr=1/z.zip", "me=q.zip"])
    assert [spec.label for spec in specs] == ["pid", "other", "z", "me"]
    with pytest.raises(ConfigError, match="best"):
        parse_controllers(["a/best.zip", "b/best.zip"])


def small(algorithm, env, **arguments):
    return algorithm(
        "MlpPolicy", env, policy_kwargs={"net_arch": [8]}, device="cpu", seed=0, **arguments
    )


def test_zips_of_stock_algorithms_fly(here):
    env = QuadcopterVecEnv(2, seed=0)
    for algorithm in (A2C, SAC):
        small(algorithm, env).save(f"{algorithm.__name__}.zip")
    assert evaluate("A2C.zip", "SAC.zip", "--scenario", "tracking", "-n", "2") == 0
    results = load_results("out")
    assert [record.algorithm for record in results.controllers] == ["A2C", "SAC"]
    assert len(results.entries) == 2


def test_each_agent_flies_its_own_vehicle_unless_another_is_asked_for(here, capsys):
    zipped = here / "mailed.zip"
    zipped.write_bytes(pretrained_path("crazyflie-recovery").read_bytes())
    some = ["--scenario", "starts"]
    assert evaluate("mailed.zip", "itm-recovery", "pid", *some) == 0
    (warning,) = capsys.readouterr().err.splitlines()
    assert "mailed flies crazyflie, itm-recovery flies itm, pid flies itm" in warning
    assert evaluate("mailed.zip", *some, "--vehicle", "itm", folder="other") == 0
    (warning,) = capsys.readouterr().err.splitlines()
    assert "mailed" in warning and "crazyflie" in warning
    assert evaluate("mailed.zip", *some, "--vehicle", "crazyflie", folder="third") == 0
    assert not capsys.readouterr().err


def test_an_agent_sees_its_own_scaling(here, capsys):
    std = np.linspace(1.0, 3.0, 18)
    model = small(PPO, QuadcopterVecEnv(2, seed=0), n_steps=16, batch_size=16)
    with torch.no_grad():
        model.policy.action_net.weight *= 50.0
    model.save("silent.zip")
    FlightSettings(observation_std=std).write_into(model)
    model.save("telling.zip")
    some = ["--scenario", "tracking", "-n", "3"]
    assert evaluate("silent.zip", "telling.zip", "made=my_controllers:telling", *some) == 0
    (warning,) = capsys.readouterr().err.splitlines()
    assert "silent.zip" in warning
    results = load_results("out")
    (tracking,) = load_suite("small.yaml").with_changes(["tracking"], 3).scenarios
    scaled = {"observation_std": std}
    for name, scaling in (("silent", {}), ("telling", scaled), ("made", scaled)):
        flights = fly_scenario(model, tracking, own=scaling)
        reward = results.entry(name, "tracking").metrics.reward.value
        assert reward == pytest.approx(flights.reward.mean(), abs=1e-12)
