"""Saved and shipped zips fly in stock Stable-Baselines3, where sb3_quad is not installed."""

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.utils import LinearSchedule

import sb3_quad
from sb3_quad import PPOBC, DAgger, PIDExpert
from sb3_quad.agents.agent_settings import agent_settings
from sb3_quad.agents.pretrained import pretrained_names
from sb3_quad.envs.vec_env import QuadcopterVecEnv
from sb3_quad.envs.vehicles.vehicle import load_vehicle

FLY = """
import json, sys
sys.modules["sb3_quad"] = None  # importing it, or unpickling anything of it, fails
import numpy as np
from stable_baselines3 import PPO
observations, *zips = sys.argv[1:]
models = [PPO.load(path, device="cpu") for path in zips]
assert not any(name.startswith("sb3_quad.") for name in sys.modules)
assert all(model.flight_settings["vehicle"]["mass"] > 0 for model in models)
models[0].save("again.zip")
seen = np.load(observations)
# Some agents observe more than 18 features.
own = [np.resize(seen, (len(seen), *model.observation_space.shape)) for model in models]
actions = [model.predict(x, deterministic=True)[0].tolist() for model, x in zip(models, own)]
json.dump([actions, [model.num_timesteps for model in models]], sys.stdout)
"""
EXAMPLE = Path(__file__).resolve().parent.parent / "examples" / "load_in_plain_sb3.py"
RUN = (
    "import runpy, sys; sys.modules['sb3_quad'] = None; "
    "runpy.run_path(sys.argv.pop(1), run_name='__main__')"
)
SMALL = {
    "n_steps": 32,
    "batch_size": 128,
    "learning_rate": LinearSchedule(1e-3, 0.0, 1.0),
    "seed": 0,
    "device": "cpu",
}


def run(*command, folder="."):
    """Run a program without sb3_quad, and return it when it has ended."""
    command = [sys.executable, "-W", "error", "-c", *map(str, command)]
    return subprocess.run(command, capture_output=True, text=True, cwd=folder, check=False)


@pytest.mark.slow
def test_ppo_loads_them_where_sb3_quad_cannot_be_imported(tmp_path):
    own = {"vehicle": "crazyflie", "noise": 0.1, "observation_mean": np.full(18, 0.5)}
    env = QuadcopterVecEnv(8, seed=0, max_episode_steps=20, **own)
    settings = {**SMALL, "expert": PIDExpert()}
    decaying = LinearSchedule(1.0, 0.0, 0.5)
    models = [
        DAgger("MlpPolicy", env, clip_range_vf=0.2, **settings),
        PPOBC("MlpPolicy", env, clip_range_vf=0.2, **settings),
        PPOBC("MlpPolicy", env, bc_coef=decaying, **settings),
    ]
    for number, model in enumerate(models):
        model.learn(256)
        # It is saved too, so it must not be empty here.
        assert model.ep_info_buffer
        model.save(tmp_path / f"{number}.zip")
    observations = env.reset()
    np.save(tmp_path / "observations.npy", observations)
    shipped = [sb3_quad.pretrained_path(name) for name in pretrained_names()]
    result = run(FLY, "observations.npy", "0.zip", "1.zip", "2.zip", *shipped, folder=tmp_path)
    assert result.returncode == 0, result.stderr
    actions, timesteps = json.loads(result.stdout)
    assert timesteps[:3] == [256] * 3
    read, source = agent_settings(tmp_path / "again.zip")
    assert source == tmp_path / "again.zip" and read.vehicle == load_vehicle("crazyflie")
    assert (read.noise, read.observation_mean) == (0.1, [0.5] * 18)
    for model, flown in zip([*models, *map(PPO.load, shipped)], actions, strict=True):
        seen = np.resize(observations, (len(observations), *model.observation_space.shape))
        expected, _ = model.predict(seen, deterministic=True)
        # Both processes may use different numbers of threads, whose sums round differently.
        np.testing.assert_allclose(np.float32(flown), expected, atol=1e-5)


@pytest.mark.slow
def test_the_example_flies_zips_where_sb3_quad_cannot_be_imported(tmp_path):
    zips = [sb3_quad.pretrained_path(name) for name in ("itm-recovery", "any-quadcopter")]
    result = run(RUN, EXAMPLE, *zips)
    assert result.returncode == 0, result.stderr
    distances = re.findall(r": ([\d.]+) m from", result.stdout)
    assert len(distances) == 2 and max(map(float, distances)) < 0.1
    silent = tmp_path / "silent.zip"
    PPO("MlpPolicy", QuadcopterVecEnv(4), seed=0, device="cpu").save(silent)
    result = run(RUN, EXAMPLE, silent)
    assert result.returncode == 1
    assert "flight_settings" in result.stderr and "Traceback" not in result.stderr
