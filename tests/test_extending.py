"""The diffs of docs/extending.md, applied to a copy of the source tree: they are what they say, and
fly as PyBullet does.
"""

import functools
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PAGE = (ROOT / "docs" / "extending.md").read_text(encoding="utf-8")
DIFFS = re.findall(r"```diff\n(.*?)```", PAGE, flags=re.DOTALL)
STEPS = 150

SCRIPT = """
import hashlib, json
import numpy as np
from sb3_quad import DAgger, GeometricExpert
from sb3_quad.base.seeds import row_seeds
from sb3_quad.cli import main
from sb3_quad.envs import QuadcopterEnv, QuadcopterVecEnv
from sb3_quad.agents.resolve import resolve_expert
from sb3_quad.export.policy import export_policy
from sb3_quad.envs.simulation.batch import QuadcopterBatch
from sb3_quad.envs.simulation.observation import FEATURE_NAMES
from sb3_quad.envs.simulation.settings import FlightSettings

def batch(**task_kwargs):
    given = {"task_kwargs": task_kwargs, "vehicle": "trainer_quad", "noise": 0.0}
    how = FlightSettings(task="upright_fall", **given)
    made = QuadcopterBatch(2, how, seed=5, autoreset=False)
    made.reset()
    return made

def single(row):
    made = QuadcopterEnv(
        "upright_fall", task_kwargs={"speed_cost": 0.01}, vehicle="trainer_quad", noise=0.0
    )
    made.reset(seed=row_seeds(5, 2)[row])
    return made

plain, costly, twins = batch(), batch(speed_cost=0.01), [single(row) for row in range(2)]
found = {"state": 0.0, "reward": 0.0, "term": 0.0, "feature": 0.0, "observation": 0.0}
def note(name, difference):
    found[name] = max(found[name], float(np.abs(difference).max()))

actions = np.random.default_rng(0).uniform(-1, 1, (STEPS, 2, 4)).astype(np.float32)
for step in range(STEPS):
    plain.step(actions[step])
    observations, _, _ = costly.step(actions[step])
    state, reward = costly.true_state(), costly.outcome["reward"]
    note("term", plain.outcome["reward"] - reward - 0.01 * np.linalg.norm(state.velocity, axis=1))
    note("feature", observations[:, -4:] - state.rotor_speeds / 600.0)
    for row, env in enumerate(twins):
        seen, worth, _, _, _ = env.step(actions[step, row])
        for name in ("position", "rotation", "velocity", "body_rates", "rotor_speeds"):
            note("state", getattr(env.true_state(), name)[0] - getattr(state, name)[row])
        note("reward", worth - reward[row])
        note("observation", seen - observations[row])
expert = resolve_expert("hover", "trainer_quad")
found["size"] = len(FEATURE_NAMES)
found["expert"] = float(np.abs(expert.predict(observations)[0] - expert.vehicle.hover_action).max())
found["command"] = main(["vehicles"])

worlds = {"mass": [0.7, 1.3], "force": [0, 3], "gusts": {"std": 1.0}, "delay": [1, 3]}
given = {"randomize": worlds, "history": [0, 2], "last_action": True, "position_integral": {}}
env = QuadcopterVecEnv(70, task="recovery_and_tracking", **given)
sizes = {"n_steps": 20, "batch_size": 600, "n_epochs": 2}
model = DAgger("MlpPolicy", env, expert=GeometricExpert(), seed=0, **sizes).learn(2 * 70 * 20)
model.save("extended")
exported = [
    # Another order of the rotors and turned axes, too
    export_policy("extended.zip", "onnx", vehicle=vehicle, n_observations=2000)
    for vehicle in ("itm", "hummingbird")
]
found["exported"] = [each.metadata["observation"] for each in exported]
weights = b"".join(part.numpy().tobytes() for part in model.policy.state_dict().values())
found["weights"] = hashlib.sha256(weights).hexdigest()
print(json.dumps(found))
"""


def apply(diff, root):
    """Apply a unified diff, each hunk where its old lines stand."""
    for old, new, hunks in re.findall(
        r"--- (\S+)\n\+\+\+ (\S+)\n(.*?)(?=\n--- |\Z)", diff, flags=re.DOTALL
    ):
        path = root / new.removeprefix("b/")
        text = "" if old == "/dev/null" else path.read_text(encoding="utf-8")
        for hunk in re.split(r"(?:^|\n)@@.*\n", hunks)[1:]:
            lines = hunk.rstrip("\n").split("\n")
            before = "".join(f"{line[1:]}\n" for line in lines if line[:1] in " -")
            after = "".join(f"{line[1:]}\n" for line in lines if line[:1] in " +")
            assert text.count(before) == 1 or not text, f"{path.name}: {before}"
            text = text.replace(before, after) if text else after
        path.write_text(text, encoding="utf-8")


@pytest.fixture(scope="module")
def extended(tmp_path_factory):
    root = tmp_path_factory.mktemp("extended")
    for name in ("sb3_quad", "envs", "callbacks", "zoo_configs"):
        # With what is compiled already, for the modules that no diff changes, but without what
        # another worker writes now
        passing = shutil.ignore_patterns("*.tmp.*", "*.pyc.*")
        shutil.copytree(ROOT / name, root / name, ignore=passing)
    shutil.copy(ROOT / "setup.cfg", root)
    for diff in DIFFS:
        apply(diff, root)
    # As installed: the checkout's finder would give its own otherwise.
    for name in ("envs", "callbacks", "zoo_configs"):
        (root / "sb3_quad" / name).symlink_to(root / name)
    return root


@pytest.mark.parametrize("diff", DIFFS, ids=lambda diff: diff.split("\n+++ b/")[1].split("\n")[0])
def test_each_is_small_and_fits_the_code(diff, tmp_path):
    for name in re.findall(r"^\+\+\+ b/(\S+)", diff, flags=re.MULTILINE):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        if (ROOT / name).is_file():
            shutil.copy(ROOT / name, tmp_path / name)
    apply(diff, tmp_path)
    assert 1 <= diff.count("\n+++ ") <= 2
    changed = re.findall(r"^[+-](?![+-]{2} )", diff, flags=re.MULTILINE)
    assert len(changed) <= 24


@pytest.mark.slow
@pytest.mark.timeout(1300)
def test_the_extended_package_flies_as_pybullet_does(extended):
    """And what it compiles computes what its cache holds, to the last bit, also the weights of a
    training.
    """
    pytest.importorskip("pybullet")
    environment = {**os.environ, "PYTHONPATH": str(extended)}
    command = [sys.executable, "-W", "ignore", "-c", SCRIPT.replace("STEPS", str(STEPS))]
    run = functools.partial(
        subprocess.run, cwd=extended, env=environment, capture_output=True, text=True, timeout=600
    )
    done, again = run(command, check=False), run(command, check=False)
    assert done.returncode == 0, done.stderr
    assert (
        "compiling" in done.stderr
        and "compiling" not in again.stderr
        and done.stdout == again.stdout
    )
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["state"] < 1e-9 and found["reward"] < 1e-9 and found["term"] < 1e-12
    assert found["feature"] < 1e-6 and found["observation"] < 1e-6  # float32
    for line in found["exported"]:
        assert line.startswith("22 numbers")
        assert "15-17 body rates, body frame, rad/s; 18-21 rotor_speeds, rad/s" in line
    assert found["size"] == 22 and found["expert"] < 1e-6 and found["command"] == 0
    assert "trainer_quad: 1.2 kg" in done.stdout
