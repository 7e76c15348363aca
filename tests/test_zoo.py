"""rl_zoo3 and this package: docs/reference/zoo_flags.md, and the bridge in rl_zoo3's own
environment (``make test-zoo``).

rl_zoo3 patches Gymnasium where it is imported, so everything of it runs in processes of its own;
skipped where it is missing.
"""

import argparse
import importlib.util
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

from sb3_quad.cli import main
from sb3_quad.cli.app import COMMANDS
from sb3_quad.cli.parser import add_flags
from sb3_quad.training.runs import open_run

ROOT = Path(__file__).resolve().parent.parent
ENV = "QuadStateRecovery-v0"
SETTINGS = {
    "policy_kwargs": "dict(net_arch=[8], activation_fn=nn.Tanh)",
    "policy": "MlpPolicy",
    "n_timesteps": 800,
    "n_envs": 8,
    "env_kwargs": {
        "task": {"state_recovery": 0.5, "target_tracking": 0.5},
        "max_episode_steps": 30,
    },
    "eval_env_kwargs": {"task": "state_recovery", "max_episode_steps": 20},
    "expert": "geometric",
    "n_steps": 50,
    "batch_size": 100,
    "learning_rate": "lin_1e-3",
    "ent_coef": "1e-4",
}

pytestmark = pytest.mark.timeout(900)
with_zoo = pytest.mark.skipif(
    importlib.util.find_spec("rl_zoo3") is None, reason="needs rl_zoo3, the extra [zoo]"
)


@pytest.mark.parametrize("command", ["train", "enjoy"])
def test_the_flags_that_the_page_calls_the_same_are_there(command):
    page = (ROOT / "docs/reference/zoo_flags.md").read_text(encoding="utf-8")
    section = page.split(f"## {command}\n")[1].split("\n## ")[0]
    (line,) = re.findall(r"^Same name and meaning: (.*)\.$", section, flags=re.MULTILINE)
    parser = argparse.ArgumentParser()
    add_flags(parser, COMMANDS[command].FLAGS)
    flags = re.findall(r"`(--[\w-]+)`", line)
    assert len(flags) > 6
    assert {*flags} <= parser._option_string_actions.keys()


def run(*arguments, cwd, **environment):
    """Output of a command of this interpreter that must succeed."""
    path = os.pathsep.join(map(str, (ROOT, ROOT / "examples" / "zoo_bridge")))
    given = {**os.environ, "PYTHONPATH": path, **environment}
    command = [sys.executable, *map(str, arguments)]
    how = {"cwd": cwd, "env": given, "stdin": subprocess.DEVNULL, "capture_output": True}
    result = subprocess.run(command, **how, text=True, check=False)
    assert result.returncode == 0, f"{command}\n{result.stdout}\n{result.stderr}"
    return result.stdout


# Several commands of one process: importing rl_zoo3 takes longer than what they do.
SESSION = """
import json, runpy, sys
import custom_envs
for arguments in json.load(open("commands.json")):
    print("COMMAND", *arguments[:3], flush=True)
    sys.argv = arguments
    try:
        runpy.run_module("rl_zoo3." + arguments[0], run_name="__main__")
    except SystemExit as leaving:
        assert not leaving.code, (arguments, leaving.code)
"""


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """A folder where rl_zoo3 trained and flew our algorithms, and flew a run of ours; and what it
    said.
    """
    folder = tmp_path_factory.mktemp("zoo")
    (folder / "small.yml").write_text(yaml.safe_dump({ENV: SETTINGS}))
    ours = f"train --algo ppo_bc --env {ENV} -conf {folder}/small.yml -f {folder}/ours"
    assert main([*ours.split(), "--eval-episodes", "2", "--env-kwargs", "noise:0"]) == 0
    common = f"--env {ENV} -conf small.yml -f logs --device cpu --seed 1 --verbose 1"
    often = "--eval-freq 400 --eval-episodes 2 --save-freq 400"
    from_dagger = f"--eval-freq -1 -i logs/dagger/{ENV}_1/{ENV}.zip"
    shown = f"--env {ENV} --no-render -n 40"
    lines = [
        f"train --algo dagger {common} {often} -params dataset_capacity:1000",
        f"train --algo ppo_bc {common} {from_dagger} -params vec_env:'dummy' n_envs:2",
        f"enjoy --algo dagger {shown} -f logs --load-best",
        f"enjoy --algo ppo_bc {shown} -f ours",
    ]
    commands = [line.split() for line in lines]
    commands[0] += ["--env-kwargs", "noise:0.1"]
    (folder / "commands.json").write_text(json.dumps(commands))
    parts = run("-c", SESSION, cwd=folder).split("COMMAND")[1:]
    assert len(parts) == len(commands)
    return folder, parts


@with_zoo
def test_rl_zoo3_trains_with_our_settings(session):
    folder, _ = session
    path = folder / "logs" / "dagger" / f"{ENV}_1"
    assert {
        f"{ENV}.zip",
        "best_model.zip",
        "rl_model_400_steps.zip",
        "evaluations.npz",
        "0.monitor.csv",
    } <= {entry.name for entry in path.iterdir()}
    settings, arguments = open_run(path).read_yaml()
    assert settings == {
        **SETTINGS,
        "env_kwargs": {**SETTINGS["env_kwargs"], "noise": 0.1},
        "dataset_capacity": 1000,
    }
    assert arguments["env_kwargs"] == {**settings["env_kwargs"], **SETTINGS["eval_env_kwargs"]}
    assert arguments["algo"] == "dagger" and arguments["env"] == ENV
    with np.load(path / "evaluations.npz") as file:
        assert (file["ep_lengths"] <= 20).all()  # eval_env_kwargs, not env_kwargs
    lines = (path / "0.monitor.csv").read_text().splitlines()
    assert lines[1].split(",") == ["r", "l", "t", "is_success"]
    assert len(lines) > 10 and all(int(line.split(",")[1]) <= 30 for line in lines[2:])


@with_zoo
def test_its_zips_need_neither_rl_zoo3_nor_us(session):
    folder, _ = session
    code = """
import sys, warnings
sys.modules["sb3_quad"] = sys.modules["rl_zoo3"] = None
from stable_baselines3 import PPO
warnings.simplefilter("error")
for path in sys.argv[1:]:
    PPO.load(path, device="cpu")
"""
    run("-c", code, *sorted(folder.glob("logs/*/*/*.zip")), cwd=folder)


@with_zoo
def test_a_second_stage_starts_from_the_first(session):
    folder, (_, output, *_) = session
    path = folder / "logs" / "ppo_bc" / f"{ENV}_1"
    settings, _ = open_run(path).read_yaml()
    assert settings["vec_env"] == "dummy" and "Using 2 environments" in output
    assert (path / "0.monitor.csv").read_text().splitlines()[1] == "r,l,t,is_success"


@with_zoo
@pytest.mark.parametrize("which", [2, 3])
def test_it_shows_its_runs_and_ours(session, which):
    """As they are judged: in episodes of 20 steps, two in 40."""
    assert "Episode Length 20" in session[1][which] and "2 Episodes" in session[1][which]


@with_zoo
def test_ours_shows_its_runs(session, capsys):
    folder, _ = session
    shown = f"enjoy --algo dagger --env {ENV} -f {folder}/logs --no-render --load-best"
    assert main(shown.split()) == 0
    assert "after 0.20 s" in capsys.readouterr().out


@with_zoo
def test_the_plain_command_knows_us_by_custom_envs(tmp_path):
    code = (
        "import sys; sys.argv = ['rl_zoo3', 'train', '--help']; "
        "from rl_zoo3.cli import main; main()"
    )
    assert "dagger,ppo_bc" in "".join(run("-c", code, cwd=tmp_path).split())
