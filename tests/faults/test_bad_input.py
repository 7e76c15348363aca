"""Bad input is one line that names the key: ``corpus.yaml`` holds what is given, and the key."""

import errno
import logging
import shlex
import signal
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
import yaml
from stable_baselines3 import PPO
from test_pipeline import ONE, TWO
from test_sweep import TINY

import sb3_quad
from sb3_quad.base.errors import ConfigError
from sb3_quad.cli.app import main
from sb3_quad.cli.commands import evaluate
from sb3_quad.envs import QuadcopterVecEnv
from sb3_quad.envs.vehicles.vehicle import load_vehicle
from sb3_quad.evaluation.scenarios.load import load_suite
from sb3_quad.training.config import TrainingJob, build_config
from sb3_quad.training.trainer import build_model

CORPUS = yaml.safe_load(Path(__file__).with_name("corpus.yaml").read_text(encoding="utf-8"))
ITM = load_vehicle("itm").model_dump(mode="json")


def write(path, content):
    """A text, or one of ``{begin, repeat, times, end}``; an .npz of ``{arrays}``; a zip of empty
    files.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(content, str):
        path.write_text(content, encoding="utf-8")
    elif "arrays" in content:
        np.savez(path, **content["arrays"])
    elif "zip" in content:
        with zipfile.ZipFile(path, "w") as archive:
            for name in content["zip"]:
                archive.writestr(name, "")
    else:
        text = content["repeat"] * content["times"]
        path.write_text(content.get("begin", "") + text + content.get("end", ""), encoding="utf-8")


def files(folder):
    return {path for path in folder.rglob("*") if "__pycache__" not in path.parts}


@pytest.fixture(scope="module", autouse=True)
def compiled():
    QuadcopterVecEnv(1)


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    # Optuna logs to the stderr of the test that has imported it, which may be closed.
    monkeypatch.setattr(logging, "raiseExceptions", False)
    return tmp_path


def names(line, key):
    """Whether an error is one line that names the key, as a flag or in a file."""
    return key.replace("-", "_") in line.replace("-", "_") and "\n" not in line


def refused(key, function, *arguments, **keywords):
    """Assert that a call is refused in a line that names the key."""
    with pytest.raises(ConfigError) as caught:
        function(*arguments, **keywords)
    assert names(str(caught.value), key)


@pytest.mark.parametrize("name", CORPUS["commands"])
def test_a_command_ends_with_a_line_that_names_the_key_and_leaves_nothing(name, here, capsys):
    case = CORPUS["commands"][name]
    if isinstance(case, list):
        case = {"command": case[0], "key": case[1]}
    for file, content in case.get("files", {}).items():
        write(here / file, content)
    before = files(here)
    code = main([part.format(digits="1" * 5000) for part in shlex.split(case["command"])])
    lines = capsys.readouterr().err.splitlines()
    assert code == case.get("code", 2), lines
    assert lines[-1].startswith(case.get("begins", "error: ")) and names(lines[-1], case["key"])
    # A check foresaw it.
    assert not any("Traceback" in line or "--traceback" in line for line in lines)
    assert files(here) - before == set()


@pytest.mark.parametrize(("keywords", "key"), CORPUS["environments"], ids=str)
def test_an_environment_names_the_key(keywords, key):
    refused(key, QuadcopterVecEnv, **{"n_envs": 2, **keywords})


@pytest.mark.parametrize(("changes", "key"), CORPUS["vehicles"], ids=str)
def test_a_vehicles_file_names_the_key(changes, key, here):
    changed = {**ITM, **changes}
    kept = {name: value for name, value in changed.items() if value is not None}
    (here / "bad.yaml").write_text(yaml.safe_dump(kept))
    with pytest.raises(ConfigError) as caught:
        load_vehicle("bad.yaml")
    assert names(str(caught.value), key) and names(str(caught.value), "bad.yaml")


@pytest.mark.parametrize(("changes", "key"), CORPUS["scenarios"], ids=str)
def test_a_suite_names_the_key(changes, key, here):
    suite = {"name": "mine", "scenarios": [{"name": "near", "duration": 2.0, **changes}]}
    (here / "bad.yaml").write_text(yaml.safe_dump(suite))
    refused(key, load_suite, "bad.yaml")


@pytest.mark.parametrize(("algo", "settings", "key"), CORPUS["settings"], ids=str)
def test_a_training_names_the_key(algo, settings, key):
    def build():
        config = build_config(algo, "QuadTargetTracking-v0", {"n_timesteps": 1000, **settings})
        build_model(TrainingJob(config=config), QuadcopterVecEnv(2))

    refused(key, build)


@pytest.mark.parametrize(("algorithm", "arguments", "key"), CORPUS["arguments"], ids=str)
def test_an_algorithm_names_the_key(algorithm, arguments, key):
    kind = getattr(sb3_quad, algorithm)
    refused(key, kind, "MlpPolicy", QuadcopterVecEnv(2, seed=0), **arguments)


@pytest.mark.parametrize(("keywords", "key"), CORPUS["flights"], ids=str)
def test_flights_name_the_key(keywords, key):
    refused(key, sb3_quad.fly, "pid", **keywords)


@pytest.mark.parametrize(("controllers", "keywords", "key"), CORPUS["comparisons"], ids=str)
def test_a_comparison_names_the_key(controllers, keywords, key):
    refused(key, sb3_quad.compare, controllers, **keywords)


def refused_by_command(here, capsys, command, file, content, key):
    """Assert so of a command that reads a file, and that it leaves nothing."""
    (here / "pendulum.yml").write_text("Pendulum-v1: {n_timesteps: 10}")
    (here / file).write_text(yaml.safe_dump(content))
    assert main([*command.split(), file]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert names(line, key) and not (here / "logs").exists()


@pytest.mark.parametrize(("changes", "key"), CORPUS["stages"], ids=str)
def test_a_pipeline_names_the_key(changes, key, here, capsys):
    stages = {"stages": [{**ONE, **changes}, TWO]}
    refused_by_command(here, capsys, "train --conf-file", "stages.yml", stages, key)


@pytest.mark.parametrize(("changes", "key"), CORPUS["sweeps"], ids=str)
def test_a_sweep_names_the_key(changes, key, here, capsys):
    refused_by_command(here, capsys, "sweep", "sweep.yaml", {**TINY, **changes}, key)


@pytest.mark.parametrize(
    "raised",
    [SystemExit(0), OSError(errno.ENOSPC, "No space left", "run/0.monitor.csv"), ZeroDivisionError],
)
def test_what_no_check_foresees_is_a_line_too(raised, monkeypatch, capsys):
    def run(options):
        raise raised

    monkeypatch.setattr(evaluate, "run", run)
    command = ["evaluate", "pid"]
    assert main(command) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ")
    assert main([*command, "--traceback"]) == 2
    assert len(capsys.readouterr().err.splitlines()) > 1


def test_an_interrupt_while_modules_are_imported_leaves_at_once():
    code = "\n".join(
        [
            "import os, signal",
            "from sb3_quad.base.process import interrupts_leave",
            "with interrupts_leave():",
            "    try:",
            "        os.kill(os.getpid(), signal.SIGINT)",
            "    except BaseException:",  # as some compiled modules do
            "        pass",
            "print('goes on')",
        ]
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (-signal.SIGINT, "", "")


def test_an_agent_whose_parameters_are_not_finite_is_refused(here, capsys):
    agent = PPO("MlpPolicy", QuadcopterVecEnv(1), device="cpu")
    # SB3 clips the action, so that it looks sound.
    agent.policy.action_net.bias.data[0] = float("inf")
    agent.save("agent.zip")
    assert main(["enjoy", "agent.zip", "--no-render"]) == 2
    line = capsys.readouterr().err.splitlines()[-1]
    assert names(line, "agent.zip") and names(line, "action_net.bias")
