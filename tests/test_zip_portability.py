"""The saved zip flies in stock Stable-Baselines3, where sb3_quad is not installed."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest
from stable_baselines3.common.utils import LinearSchedule

from sb3_quad.dagger import DAgger
from sb3_quad.envs.vec_env import QuadcopterVecEnv
from sb3_quad.experts.pid import PIDExpert

FLY = """
import json, sys, warnings
sys.modules["sb3_quad"] = None  # importing it, or unpickling anything of it, fails
import numpy as np
from stable_baselines3 import PPO
warnings.simplefilter("error")
model = PPO.load(sys.argv[1], device="cpu")
assert not any(name.startswith("sb3_quad.") for name in sys.modules)
json.dump(model.predict(np.load(sys.argv[2]), deterministic=True)[0].tolist(), sys.stdout)
"""


@pytest.mark.parametrize("clip_range_vf", [None, 0.2])
def test_ppo_loads_it_where_sb3_quad_cannot_be_imported(tmp_path, clip_range_vf):
    env = QuadcopterVecEnv(16, seed=0, max_episode_steps=20)
    model = DAgger(
        "MlpPolicy",
        env,
        PIDExpert(),
        learning_rate=LinearSchedule(1e-3, 0.0, 1.0),
        n_steps=32,
        batch_size=128,
        clip_range_vf=clip_range_vf,
        seed=0,
        device="cpu",
    ).learn(1024)
    assert model.ep_info_buffer  # it is saved too, so it must not be empty here
    observations = env.reset()
    np.save(tmp_path / "observations.npy", observations)
    model.save(tmp_path / "model.zip")
    command = [sys.executable, "-c", FLY, str(tmp_path / "model.zip"), str(tmp_path / "observations.npy")]
    result = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=False)
    assert result.returncode == 0, result.stderr
    np.testing.assert_array_equal(
        np.array(json.loads(result.stdout), dtype=np.float32), model.predict(observations, deterministic=True)[0]
    )
