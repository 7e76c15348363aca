"""ObservationStatistics: NumPy's mean and deviation of all observations, in physical units."""

import gymnasium
import numpy as np
import pytest
import yaml
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

import sb3_quad  # noqa: F401
from sb3_quad.base.errors import ConfigError
from sb3_quad.callbacks import ObservationStatistics
from sb3_quad.envs.vec_env import QuadcopterVecEnv


class Keep(BaseCallback):
    """All observations, as they come."""

    def _on_training_start(self):
        self.kept = []

    def _on_step(self):
        normalised = self.model.get_vec_normalize_env()
        self.kept.append((self.locals["new_obs"] if normalised is None else normalised.get_original_obs()).copy())
        return True


def make(env, algorithm=PPO):
    size = {"n_steps": 20, "batch_size": 20, "n_epochs": 1} if algorithm is PPO else {"learning_starts": 100}
    return algorithm("MlpPolicy", env, policy_kwargs={"net_arch": [4]}, seed=0, device="cpu", **size)


@pytest.mark.parametrize(("algorithm", "batched"), [(PPO, True), (SAC, False)])
def test_on_the_quadcopter_they_are_physical(algorithm, batched):
    if batched:
        env = QuadcopterVecEnv(3, "state_recovery", seed=0, observation_std=np.arange(1.0, 19.0))
    else:
        env = make_vec_env("QuadStateRecovery-v0", 3, seed=0)
    keep, statistics = Keep(), ObservationStatistics()
    make(env, algorithm).learn(180, callback=[keep, statistics])
    physical = np.concatenate(keep.kept).astype(np.float64) * env.get_attr("observation_std")[0]
    assert statistics.count == len(physical) == 180
    np.testing.assert_allclose(statistics.std, physical.std(axis=0), rtol=1e-10)
    np.testing.assert_allclose(statistics.mean, physical.mean(axis=0), rtol=1e-9, atol=1e-10)
    expected = {"position": (0, 3), "rotation": (3, 12), "velocity": (12, 15), "body_rates": (15, 18)}
    for name, (first, last) in expected.items():
        assert statistics.groups()[name] == pytest.approx(np.sqrt(physical.var(axis=0)[first:last].mean()), rel=1e-10)
    env.close()


def test_the_start_of_the_tasks_has_the_deviations_that_table_a2_is_made_of():
    """Position 10/√3 is that of targets 10 m away (3.3.1); here of hovering at the start of many episodes."""
    env = QuadcopterVecEnv(400, "target_tracking", noise=0.0, max_episode_steps=1, seed=0)
    statistics = ObservationStatistics()
    PPO("MlpPolicy", env, n_steps=2, batch_size=800, n_epochs=1, device="cpu").learn(800, callback=statistics)
    assert statistics.groups()["position"] == pytest.approx(10.0 / np.sqrt(3.0), rel=0.01)
    assert "5.774 m" in statistics.table()


def test_elsewhere_they_are_of_what_comes_before_normalisation():
    env = VecNormalize(make_vec_env("Pendulum-v1", 2, seed=0))
    keep, statistics = Keep(), ObservationStatistics()
    make(env).learn(80, callback=[keep, statistics])
    np.testing.assert_allclose(statistics.std, np.concatenate(keep.kept).astype(np.float64).std(axis=0), rtol=1e-10)
    assert list(statistics.groups()) == ["all"] and "Table A.2" not in statistics.table()


def test_the_file_is_read_back_by_a_training_that_goes_on_and_by_no_other(tmp_path, capsys):
    path, env = tmp_path / "folder" / "sigma.yaml", QuadcopterVecEnv(3, "state_recovery", seed=0)
    keep, model = Keep(), make(env)
    model.learn(60, callback=[keep, ObservationStatistics(path)])
    first = keep.kept
    with pytest.raises(ConfigError, match="exists already"):
        make(env).learn(60, callback=ObservationStatistics(path))
    continued = ObservationStatistics(path, verbose=1)
    model.learn(60, callback=[keep, continued], reset_num_timesteps=False)
    everything = np.concatenate(first + keep.kept).astype(np.float64) * env.observation_std[0]
    assert "Table A.2" in capsys.readouterr().out
    content = yaml.safe_load(path.read_text())
    assert content["count"] == 120 and len(content["features"]) == 18
    np.testing.assert_allclose(content["observation_std"], everything.std(axis=0), rtol=1e-9)
    scaled = QuadcopterVecEnv(2, observation_std=content["observation_std"])  # as env_kwargs takes it
    assert scaled.observation_std.shape == (2, 18)
    assert [entry.name for entry in path.parent.iterdir()] == ["sigma.yaml"]
    path.write_text("count: 5")
    with pytest.raises(ConfigError, match="holds no observation statistics"):
        model.learn(60, callback=ObservationStatistics(path), reset_num_timesteps=False)


def test_what_does_not_fit_is_refused():
    with pytest.raises(ConfigError, match=r"\.yaml"):
        ObservationStatistics("sigma.txt")
    with pytest.raises(ConfigError, match="every is 0"):
        ObservationStatistics(every=0)
    with pytest.raises(ConfigError, match="must be a Box"):
        make(gymnasium.make("FrozenLake-v1")).learn(20, callback=ObservationStatistics())
