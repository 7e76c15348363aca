"""``evaluate``: every controller on the same episodes, nothing flown twice or lost, failures in one
line.
"""

import csv
import importlib
import os
import shutil
import subprocess
import sys
import zipfile

import gymnasium
import numpy as np
import pytest
import torch
from stable_baselines3 import A2C, DDPG, PPO, SAC, TD3

from sb3_quad.agents.pretrained import pretrained_path
from sb3_quad.agents.zips import load_model, saved_algorithm
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.seeds import row_seeds, seed_for
from sb3_quad.cli import main
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.envs.vec_env import QuadcopterVecEnv
from sb3_quad.envs.vehicles.vehicle import load_vehicle
from sb3_quad.evaluation.controllers import parse_controllers
from sb3_quad.evaluation.evaluate import evaluate as evaluate_suite
from sb3_quad.evaluation.flightlog import read_flights
from sb3_quad.evaluation.flights import fly_settings
from sb3_quad.evaluation.results import load_results
from sb3_quad.evaluation.scenarios.load import load_suite
from sb3_quad.evaluation.scenarios.sample import sample_plan

SUITE = """
name: small
source: paper
scenarios:
  - name: tracking
    target: {distance: 3}
    duration: 2
    tolerances: [0.5, 1.0]
    episodes: 5
    published: {expert: {success: 0.5, time_to: {0.5: 1.25}, path: [2, 3]}}
  - name: course
    target: {waypoints: [[0, 0, 15.5], [0, 0.5, 15.5]], radius: 0.4}
    duration: 4
    episodes: 2
  - name: starts
    vary: {start.attitude.tilt: [0, 60]}
    duration: 1
    episodes: 3
"""
FACTORIES = """
import numpy as np
from stable_baselines3 import PPO

calls = 0

def hover(vehicle):
    return lambda observation: np.zeros((len(observation), 4))

def broken(vehicle):
    raise RuntimeError("no\\nmodel")

def fails_in_flight(vehicle):
    return lambda observation: observation

def telling(vehicle):
    return PPO.load("telling.zip", device="cpu")

def interrupted(vehicle):
    global calls
    calls += 1
    if calls == 2:
        raise KeyboardInterrupt
    return hover(vehicle)
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


def evaluate(*arguments: str, folder: str = "out") -> int:
    return main(["evaluate", *arguments, "--suite", "small.yaml", "-o", folder, "--no-report"])


def rows(folder: str = "out") -> list[dict[str, str]]:
    with open(f"{folder}/episodes.csv", newline="") as file:
        return list(csv.DictReader(file))


def times_of_change(folder):
    return {path: path.stat().st_mtime_ns for path in sorted(folder.rglob("*.npz"))}


def test_the_physical_limit_stands_beside_the_time_to_stay(here, capsys):
    some = ["--suite", "thesis", "--scenario", "tracking", "tracking_15m", "--episodes", "2"]
    assert (
        main(["evaluate", "geometric", "crazyflie-robust", *some, "-o", "out", "--no-report"]) == 0
    )
    limits = [load_vehicle(name).time_optimal[10] for name in ("itm", "crazyflie")]
    assert [entry.physical_limit for entry in load_results("out").entries] == [*limits, None, None]
    lines = capsys.readouterr().out.splitlines()
    (at,) = (
        number
        for number, line in enumerate(lines)
        if "physical limit of the settling time, s" in line
    )
    assert (
        all(f"{limit:.2f}" in lines[at] for limit in limits)
        and "settling time (0.1 m), s" in lines[at - 1]
    )


def test_table_results_and_episodes_agree(here, capsys):
    assert evaluate("pid", "still=my_controllers:hover") == 0
    text = capsys.readouterr().out
    for part in (
        "pid",
        "still",
        "paper",
        "success, %",
        "expert 50",
        "expert 1.25",
        "expert 2 to 3",
        "tilt 60",
        "waypoints reached",
    ):
        assert part in text
    results = load_results("out")
    assert [record.label for record in results.controllers] == ["pid", "still"]
    assert [each.name for each in results.scenarios] == [
        "tracking",
        "course",
        "starts.0",
        "starts.60",
    ]
    assert len(results.entries) == 8 and not results.failures
    episodes = rows()
    assert len(episodes) == 2 * (5 + 2 + 3 + 3)
    for entry in results.entries:
        own = [
            row
            for row in episodes
            if (row["controller"], row["scenario"]) == (entry.controller, entry.scenario)
        ]
        assert len(own) == entry.metrics.n
        assert np.mean([row["outcome"] == "success" for row in own]) == entry.metrics.success.value
        assert np.mean([float(row["reward"]) for row in own]) == pytest.approx(
            entry.metrics.reward.value
        )
        assert [int(row["seed"]) for row in own] == next(
            each.episode_seeds() for each in results.scenarios if each.name == entry.scenario
        )
        arrays = read_flights(f"out/{entry.flights}")
        assert len(arrays["episode_seed"]) == len(own)
        assert arrays["position"].shape[:2] == (min(len(own), 8), len(arrays["time"]))
    # The same starts and targets for both.
    names = [name for name in episodes[0] if name.startswith(("start_", "target_"))]
    pid, still = (
        [[row[name] for name in names] for row in episodes if row["controller"] == who]
        for who in ("pid", "still")
    )
    assert pid == still
    course = results.entry("pid", "course").metrics.course
    assert (
        course.completed.value == 1.0
        and results.entry("still", "course").metrics.course.completed.value == 0.0
    )
    assert [row["waypoints_reached"] for row in episodes if row["scenario"] == "course"] == [
        "2",
        "2",
        "0",
        "0",
    ]


def test_files_that_are_no_results_are_kept(here, capsys):
    (here / "out").mkdir()
    (here / "out" / "report.md").write_text("mine")
    assert (
        evaluate("a=pid", "--scenario", "tracking") == 2
        and "report.md: exists already" in capsys.readouterr().err
    )


def test_a_folder_of_results_is_kept_or_written_anew(here, capsys):
    assert evaluate("a=pid", "b=pid", "--scenario", "tracking", "starts") == 0
    before, shown = times_of_change(here), capsys.readouterr().out
    assert (
        evaluate("a=pid", "b=pid", "--scenario", "tracking", "starts") == 0
    )  # killed after the last flight, say
    assert (
        times_of_change(here) == before
        and capsys.readouterr().out.splitlines()[:10] == shown.splitlines()[:10]
    )
    assert evaluate("a=pid", "--scenario", "tracking") == 2
    error = capsys.readouterr().err
    assert "holds results already; give another folder with -o" in error and error.count("\n") == 1
    assert times_of_change(here) == before
    # A reader's own files stay.
    own = [here / "out/notes.md", here / "out/flights/b/mine.npz", here / "out/flights/mine.txt"]
    for path in own:
        path.write_text("mine")
    assert evaluate("a=pid", "--scenario", "tracking", "--seed", "7", "--overwrite") == 0
    assert {path.read_text() for path in own} == {"mine"}
    for path in own:
        path.unlink()
    assert {row["seed"] for row in rows()} == {
        str(each) for each in row_seeds(seed_for("suite", 7), 5)
    }
    assert len(times_of_change(here)) == len(load_results("out").entries) == 1


def test_a_folder_without_an_agent_is_called_that(here, capsys):
    (here / "logs").mkdir()
    assert evaluate("logs", "--scenario", "tracking") == 1
    assert "controller logs: no run with an agent in this folder" in capsys.readouterr().err


def test_a_console_without_some_letters_shows_the_table(here):
    """Windows' consoles and the locale C have no minus sign."""
    command = [sys.executable, "-m", "sb3_quad.cli", "evaluate", "pid", "--suite", "quick"]
    done = subprocess.run(
        [*command, "--episodes", "2", "--no-report", "-o", "out"],
        capture_output=True,
        env={**os.environ, "PYTHONIOENCODING": "ascii"},
    )
    assert done.returncode == 0, done.stderr
    assert b"success, %" in done.stdout and not done.stderr


def test_an_interrupted_evaluation_goes_on_by_the_same_command_alone(here, capsys):
    """But for factories, whose code may have changed."""
    command = "pid", "x=my_controllers:interrupted", "--scenario", "tracking", "course"
    for again in (command, (*command, "--overwrite"), command[:1]):
        sys.modules.pop("my_controllers", None)
        assert evaluate(*command) == 130
        names = [(entry.scenario, entry.controller) for entry in load_results("out").entries]
        assert names == [("tracking", "pid"), ("tracking", "x"), ("course", "pid")]
        before, half = times_of_change(here), here / "out" / "flights" / "pid" / ".course.npz.1.tmp"
        half.write_bytes(b"half")
        sys.modules["my_controllers"].calls = 5
        code = evaluate(*again)
        assert not half.exists()
        kept = [
            path.parts[-2] for path, time in before.items() if times_of_change(here)[path] == time
        ]
        if again == command[:1]:
            assert code == 2 and len(kept) == 3
            continue
        assert code == 0 and kept == (["pid", "pid"] if again == command else [])
        assert len(load_results("out").entries) == 4 and load_results("out").finished
        shutil.rmtree("out")


def test_an_interrupted_evaluation_with_a_function_as_reward_resumes(here):
    def own_reward():
        """A function that lies elsewhere each time, as it does in another process."""

        def calm(state, actions):
            return np.zeros(len(actions))

        return calm

    def interrupt(done, total, name):
        if done == 1:
            raise KeyboardInterrupt

    suite = load_suite("small.yaml")
    pid = parse_controllers(["pid"])
    with pytest.raises(KeyboardInterrupt):
        evaluate_suite(suite, pid, "out", reward=own_reward(), progress=interrupt)
    assert not load_results("out").finished
    evaluate_suite(suite, pid, "out", reward=own_reward())
    assert load_results("out").finished and load_results("out").reward == "calm"


def test_failures_are_one_line_each_and_the_others_fly(here, capsys):
    (here / "broken_module.py").write_text("1 / 0\n")
    other = PPO("MlpPolicy", gymnasium.make("Pendulum-v1"), n_steps=8, batch_size=8, device="cpu")
    other.save(here / "pendulum.zip")
    (here / "half.zip").write_bytes(b"PK")
    bad = {
        "pendulum.zip": "its observation space has shape (3,), the environment's (18,)",
        "half.zip": "not a complete SB3 zip",
        "missing.zip": "no such file",
        "pidd": "did you mean 'pid'",
        "my_controllers:broken": "RuntimeError: no model",
        "my_controllers:nothing": "no attribute 'nothing'",
        "no_such_module:make": "cannot be imported",
        "broken_module:make": "ZeroDivisionError",
        "my_controllers:fails_in_flight": "shape (5, 18)",
    }
    assert evaluate("pid", *bad, "--scenario", "tracking") == 1
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("failed: ")]
    assert len(lines) == len(bad)
    for spec, message in bad.items():
        label = spec.removesuffix(".zip")
        (line,) = [
            line for line in lines if line.startswith((f"failed: {label}:", f"failed: {label},"))
        ]
        assert message in line
    results = load_results("out")
    assert [entry.controller for entry in results.entries] == ["pid"]
    assert len(results.failures) == len(bad)


def test_an_own_reward_is_in_tables_and_files(here, capsys):
    (here / "my_rewards.py").write_text(
        "number = 1\n\n\ndef calm(state, actions):\n    return -abs(actions).sum(axis=1)\n"
    )
    calm = ["--scenario", "tracking", "--reward", "my_rewards:calm"]
    assert (
        main(
            [
                "evaluate",
                "pid",
                "still=my_controllers:hover",
                "--suite",
                "small.yaml",
                "-o",
                "out",
                *calm,
            ]
        )
        == 0
    )
    (line,) = [line for line in capsys.readouterr().out.splitlines() if "mean own reward" in line]
    results = load_results("out")
    assert (
        results.reward == "my_rewards:calm"
        and "my_rewards:calm" in (here / "out" / "report.md").read_text()
    )
    for name in ("pid", "still"):
        entry = results.entry(name, "tracking")
        sums = [float(row["own_reward"]) for row in rows() if row["controller"] == name]
        assert entry.metrics.own_reward.value == pytest.approx(np.mean(sums))
        assert f"{entry.metrics.own_reward.value:.2f}".replace("-", "−") in line
        np.testing.assert_allclose(read_flights(f"out/{entry.flights}")["episode_own_reward"], sums)
    assert results.entry("still", "tracking").metrics.own_reward.value == 0.0
    # Its code may change, so a finished evaluation is not shown again as if it were the same.
    assert evaluate("pid", "still=my_controllers:hover", *calm) == 2
    for reward, message in {
        "my_rewards:number": "is not a function reward(state, actions)",
        "my_rewards:nothing": "cannot be imported",
        "no_such_module:calm": "cannot be imported",
    }.items():
        capsys.readouterr()
        assert evaluate("pid", "--reward", reward, folder="other") == 2
        error = capsys.readouterr().err
        assert message in error and error.count("\n") == 1


def test_labels():
    specs = parse_controllers(["pid", "x/other.zip", "runs/lr=1/z.zip", "me=q.zip"])
    assert [spec.label for spec in specs] == ["pid", "other", "z", "me"]
    with pytest.raises(ConfigError, match="two have this label"):
        parse_controllers(["a/best.zip", "b/best.zip"])


SMALL_OFF_POLICY = {"buffer_size": 200, "learning_starts": 8, "batch_size": 8}
ALGORITHMS = {
    PPO: {"n_steps": 16, "batch_size": 16, "n_epochs": 1},
    A2C: {},
    SAC: SMALL_OFF_POLICY,
    TD3: SMALL_OFF_POLICY,
    DDPG: SMALL_OFF_POLICY,
}


@pytest.mark.parametrize("backend", ["batch", pytest.param("pybullet", marks=pytest.mark.slow)])
def test_zips_of_stock_algorithms_fly(here, capsys, backend):
    labels = []
    for algorithm, arguments in ALGORITHMS.items():
        if backend == "pybullet" and algorithm not in (PPO, SAC):
            continue
        env = QuadcopterVecEnv(2, seed=0)
        model = algorithm(
            "MlpPolicy", env, policy_kwargs={"net_arch": [8]}, device="cpu", seed=0, **arguments
        )
        model.learn(32)
        model.save(f"{algorithm.__name__}.zip")
        with zipfile.ZipFile(f"{algorithm.__name__}.zip") as archive:
            assert b"sb3_quad" not in archive.read("data")
        assert saved_algorithm(f"{algorithm.__name__}.zip") == algorithm.__name__
        assert type(load_model(f"{algorithm.__name__}.zip")) is algorithm
        labels.append(algorithm.__name__)
    arguments = ["--scenario", "tracking", "--episodes", "2", "--backend", backend]
    assert evaluate(*(f"{label}.zip" for label in labels), *arguments) == 0
    results = load_results("out")
    assert [(record.label, record.algorithm) for record in results.controllers] == [
        (label, label) for label in labels
    ]
    assert len(results.entries) == len(labels)


RECOVERY = """
name: recoveries
scenarios:
  - {name: recovery, start: {attitude: uniform}, duration: 3, episodes: 8}
"""


def test_each_agent_flies_its_own_vehicle_unless_another_is_asked_for(here, capsys):
    (here / "small.yaml").write_text(RECOVERY)
    zipped = here / "mailed.zip"
    zipped.write_bytes(pretrained_path("crazyflie-recovery").read_bytes())
    assert evaluate("mailed.zip", "itm-recovery", "pid") == 0
    results = load_results("out")
    for name in ("mailed", "itm-recovery"):
        assert results.entry(name, "recovery").metrics.survival.value == 1.0
    (warning,) = capsys.readouterr().err.splitlines()
    assert "mailed flies crazyflie, itm-recovery flies itm, pid flies itm" in warning
    assert evaluate("mailed.zip", "--vehicle", "itm", folder="other") == 0
    (warning,) = capsys.readouterr().err.splitlines()
    assert "mailed: was trained on the vehicle crazyflie and flies itm" in warning
    assert evaluate("mailed.zip", "--vehicle", "crazyflie", folder="third") == 0
    assert not capsys.readouterr().err


def test_an_agent_sees_its_own_scaling(here, capsys):
    std = np.linspace(1.0, 3.0, 18)
    env = QuadcopterVecEnv(2, seed=0, observation_std=std)
    model = PPO(
        "MlpPolicy",
        env,
        n_steps=16,
        batch_size=16,
        policy_kwargs={"net_arch": [8]},
        device="cpu",
        seed=0,
    )
    with torch.no_grad():
        model.policy.action_net.weight *= 50.0
    model.save("silent.zip")
    FlightSettings(observation_std=std).write_into(model)
    model.save("telling.zip")
    arguments = ["--scenario", "tracking", "--episodes", "3"]
    assert evaluate("silent.zip", "telling.zip", "made=my_controllers:telling", *arguments) == 0
    (warning,) = capsys.readouterr().err.splitlines()
    assert "silent.zip does not say how its agent flies; it flies itm" in warning
    results = load_results("out")
    rewards = {
        name: results.entry(name, "tracking").metrics.reward.value
        for name in ("silent", "telling", "made")
    }
    assert rewards["made"] == rewards["telling"]
    (tracking,) = load_suite("small.yaml").with_changes(["tracking"], 3).scenarios
    for name, scaling in (("silent", {}), ("telling", {"observation_std": std})):
        settings = tracking.flown_as.with_changes(**scaling)
        flights = fly_settings(
            model,
            settings,
            tracking.episode_seeds(),
            plan=sample_plan(tracking, tracking.episode_seeds()),
        )
        assert rewards[name] == pytest.approx(flights.reward.mean())
    assert rewards["silent"] != pytest.approx(rewards["telling"])


def test_nothing_flown_leaves_no_folder_and_a_bad_module_is_told_once(here, capsys):
    assert evaluate("missing.zip", "no_such_module:make") == 1
    output = capsys.readouterr()
    assert (
        output.err.count("missing.zip: no such file") == output.err.count("cannot be imported") == 1
    )
    assert output.err.count("\n") == 2 and "results in" not in output.out
    assert not (here / "out").exists()


@pytest.mark.slow
def test_workers_fly_the_same(here, capsys):
    assert evaluate("pid", "geometric", "--scenario", "starts") == 0
    assert (
        evaluate("pid", "geometric", "--scenario", "starts", "--workers", "2", folder="other") == 0
    )
    assert rows() == rows("other")
