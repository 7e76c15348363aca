"""Stock SAC beside this package: its zips load as SB3 loads them; snapshots refuse it."""

import pytest
from stable_baselines3 import SAC

from sb3_quad import QuadcopterVecEnv
from sb3_quad.agents.zips import load_zip
from sb3_quad.base.errors import ConfigError
from sb3_quad.callbacks import SnapshotFile


def test_n_step_returns_are_loaded_without_a_warning(tmp_path, recwarn):
    settings = {"n_steps": 3, "gamma": 0.9, "buffer_size": 40, "device": "cpu"}
    SAC("MlpPolicy", QuadcopterVecEnv(4), **settings).save(tmp_path / "sac.zip")
    buffer = load_zip(SAC, tmp_path / "sac.zip", env=QuadcopterVecEnv(4)).replay_buffer
    assert (buffer.n_steps, buffer.gamma) == (3, 0.9) and not recwarn.list


def test_a_snapshot_cannot_keep_a_replay_buffer(tmp_path):
    model = SAC("MlpPolicy", QuadcopterVecEnv(4), buffer_size=40, device="cpu")
    with pytest.raises(ConfigError, match="CheckpointCallback"):
        model.learn(8, callback=SnapshotFile(tmp_path / "resume.npz"))
