"""The bridge to rl_zoo3, in rl_zoo3's own environment (``make test-zoo``).

rl_zoo3 patches Gymnasium where it is imported, so everything of it runs in a process of its own.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from sb3_quad.cli import main
from sb3_quad.training.runs import open_run

pytest.importorskip("rl_zoo3", reason="needs rl_zoo3, the extra [zoo]")

ROOT = Path(__file__).resolve().parent.parent
ENV = "QuadStateRecovery-v0"
SETTINGS = {
    "policy_kwargs": "dict(net_arch=[8], activation_fn=nn.Tanh)",
    "policy": "MlpPolicy",
    "n_timesteps": 800,
    "n_envs": 8,
    "env_kwargs": {"task": {"state_recovery": 0.5, "target_tracking": 0.5}},
    "eval_env_kwargs": {"task": "state_recovery", "max_episode_steps": 20},
    "expert": "geometric",
    "n_steps": 50,
    "batch_size": 100,
    "learning_rate": "lin_1e-3",
}
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

pytestmark = pytest.mark.timeout(900)


def run(code, cwd):
    """Output of a program that must succeed."""
    path = os.pathsep.join(map(str, (ROOT, ROOT / "examples" / "zoo_bridge")))
    result = subprocess.run(
        [sys.executable, "-c", code],
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": path, "MPLBACKEND": "Agg"},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, f"{result.stdout}\n{result.stderr}"
    return result.stdout


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """A folder where rl_zoo3 trained and flew our algorithms, and flew a run of ours; and what it
    said.
    """
    folder = tmp_path_factory.mktemp("zoo")
    (folder / "small.yml").write_text(yaml.safe_dump({ENV: SETTINGS}))
    ours = f"train --algo ppo_bc --env {ENV} -conf {folder}/small.yml -f {folder}/ours"
    assert main([*ours.split(), "--eval-episodes", "2"]) == 0
    common = f"--env {ENV} -conf small.yml -f logs --device cpu --seed 1"
    show = f"--env {ENV} --no-render -n 40"
    lines = [
        f"train --algo dagger {common} --eval-freq 400 --eval-episodes 2 --env-kwargs noise:0.1",
        f"train --algo ppo_bc {common} --eval-freq -1 -i logs/dagger/{ENV}_1/{ENV}.zip",
        f"enjoy --algo dagger {show} -f logs --load-best",
        f"enjoy --algo ppo_bc {show} -f ours",
    ]
    (folder / "commands.json").write_text(json.dumps([line.split() for line in lines]))
    parts = run(SESSION, folder).split("COMMAND")[1:]
    assert len(parts) == len(lines)
    return folder, parts


def test_rl_zoo3_trains_with_our_settings(session):
    path = session[0] / "logs" / "dagger" / f"{ENV}_1"
    settings, arguments = open_run(path).read_yaml()
    assert settings == {**SETTINGS, "env_kwargs": {**SETTINGS["env_kwargs"], "noise": 0.1}}
    assert arguments["env_kwargs"] == {**settings["env_kwargs"], **SETTINGS["eval_env_kwargs"]}
    assert {"best_model.zip", "evaluations.npz"} < {entry.name for entry in path.iterdir()}


def test_its_zips_need_neither_rl_zoo3_nor_us(session):
    code = """
import glob, sys
sys.modules["sb3_quad"] = sys.modules["rl_zoo3"] = None
from stable_baselines3 import PPO
zips = glob.glob("logs/*/*/*.zip")
assert len(zips) >= 3
for path in zips:
    PPO.load(path, device="cpu")
"""
    run(code, session[0])


@pytest.mark.parametrize("which", [2, 3])
def test_it_shows_its_runs_and_ours(session, which):
    """As they are judged: in episodes of 20 steps, two in 40."""
    assert "Episode Length 20" in session[1][which] and "2 Episodes" in session[1][which]


def test_ours_shows_its_runs(session, capsys):
    flags = ["--algo", "dagger", "--env", ENV, "-f", str(session[0] / "logs"), "--no-render"]
    assert main(["enjoy", *flags]) == 0
    assert "after 0.20 s" in capsys.readouterr().out
