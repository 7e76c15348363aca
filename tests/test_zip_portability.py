"""Saved and shipped zips fly in stock Stable-Baselines3, where sb3_quad is not installed."""

import json
import subprocess
import sys

import numpy as np
import pytest
from coefficient_schedule import CoefficientSchedule
from stable_baselines3 import PPO
from stable_baselines3.common.utils import LinearSchedule

import sb3_quad
from sb3_quad import PPOBC, SACBC, DAgger, PIDExpert
from sb3_quad.controllers.agent_settings import agent_settings
from sb3_quad.controllers.pretrained import pretrained_names
from sb3_quad.envs.vec_env import QuadcopterVecEnv
from sb3_quad.simulation.settings import FlightSettings
from sb3_quad.vehicles.vehicle import load_vehicle

FLY = """
import json, sys
sys.modules["sb3_quad"] = None  # importing it, or unpickling anything of it, fails
import numpy as np
from stable_baselines3 import PPO, SAC
observations, *zips = sys.argv[1:]
models = [(SAC if path.startswith("sac") else PPO).load(path, device="cpu") for path in zips]
assert not any(name.startswith("sb3_quad.") for name in sys.modules)
assert all(model.flight_settings["vehicle"]["mass"] > 0 for model in models)
models[0].save("again.zip")
seen = np.load(observations)
own = [np.resize(seen, (len(seen), *model.observation_space.shape)) for model in models]  # some see more
actions = [model.predict(each, deterministic=True)[0].tolist() for model, each in zip(models, own)]
json.dump([actions, [model.num_timesteps for model in models]], sys.stdout)
"""
SMALL = {"n_steps": 32, "batch_size": 128, "learning_rate": LinearSchedule(1e-3, 0.0, 1.0), "seed": 0, "device": "cpu"}


@pytest.mark.slow
def test_ppo_loads_them_where_sb3_quad_cannot_be_imported(tmp_path):
    env = QuadcopterVecEnv(8, seed=0, max_episode_steps=20)
    models = [
        DAgger("MlpPolicy", env, PIDExpert(), **SMALL),
        DAgger("MlpPolicy", env, PIDExpert(), clip_range_vf=0.2, **SMALL),
        PPOBC("MlpPolicy", env, expert=PIDExpert(), clip_range_vf=0.2, **SMALL),
        PPOBC("MlpPolicy", env, expert=PIDExpert(), bc_coef=LinearSchedule(1.0, 0.0, 0.5), **SMALL),
    ]
    for number, model in enumerate(models):
        model.learn(256, callback=CoefficientSchedule("bc_coef", 1.0, 0.0) if number == 2 else None)
        assert model.ep_info_buffer  # it is saved too, so it must not be empty here
        FlightSettings(vehicle="crazyflie", noise=0.1 * number, observation_mean=np.full(18, 0.5)).write_into(model)
        model.save(tmp_path / f"{number}.zip")
    additions = {"bc_coef": LinearSchedule(0.5, 0.0, 1.0)}
    sac = SACBC("MlpPolicy", env, expert=PIDExpert(), buffer_size=2000, learning_starts=0, seed=0, device="cpu", **additions)
    sac.learn(320)
    FlightSettings().write_into(sac)
    sac.save(tmp_path / "sac.zip")
    observations = env.reset()
    np.save(tmp_path / "observations.npy", observations)
    files = ["observations.npy", *(f"{number}.zip" for number in range(len(models))), "sac.zip"]
    shipped = [sb3_quad.pretrained(name) for name in pretrained_names()]
    command = [sys.executable, "-W", "error", "-c", FLY, *files, *map(str, shipped)]
    result = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=False)
    assert result.returncode == 0, result.stderr
    actions, timesteps = json.loads(result.stdout)
    assert timesteps[: len(models)] == [256] * len(models)
    for path, noise in (("again.zip", 0.0), ("2.zip", 0.2)):
        settings, source = agent_settings(tmp_path / path)
        assert source == tmp_path / path and settings.vehicle == load_vehicle("crazyflie")
        assert (settings.noise, settings.observation_mean, settings.task) == (noise, [0.5] * 18, "target_tracking")
    for model, flown in zip([*models, sac, *map(PPO.load, shipped)], actions, strict=True):
        seen = np.resize(observations, (len(observations), *model.observation_space.shape))
        # Both processes may use different numbers of threads, whose sums round differently.
        np.testing.assert_allclose(np.float32(flown), model.predict(seen, deterministic=True)[0], atol=1e-5)
