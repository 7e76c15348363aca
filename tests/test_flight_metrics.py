"""FlightMetrics: the metrics that evaluation measures, of the training's own flights."""

import gymnasium
import numpy as np
import pytest
from flight_metrics import FlightMetrics
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.env_util import make_vec_env

import sb3_quad  # noqa: F401
from sb3_quad import DAgger, GeometricExpert
from sb3_quad.base.errors import ConfigError
from sb3_quad.envs.vec_env import QuadcopterVecEnv
from sb3_quad.evaluation.flights import fly


def small():
    return {"policy_kwargs": {"net_arch": [4]}, "seed": 0, "device": "cpu"}


def test_flights_of_the_expert_are_measured_as_evaluation_does():
    """With β = 1 the expert flies the whole training: the same episodes as in an evaluation with
    these seeds.
    """
    env = QuadcopterVecEnv(6, "target_tracking", max_episode_steps=300)
    model = DAgger(
        "MlpPolicy",
        env,
        expert=GeometricExpert(),
        n_steps=300,
        batch_size=1800,
        n_epochs=1,
        beta=1.0,
        beta_final=1.0,
        **small(),
    )
    metrics = FlightMetrics(tolerance=0.5)
    model.learn(1800, callback=metrics)
    # The model seeds its environments, from 0.
    flights = fly("geometric", "target_tracking", 6, 0, max_episode_steps=300)
    assert metrics.metrics() == {
        "rollout/reached_0.5m": 1.0,
        "rollout/collision_rate": 0.0,
        "rollout/out_of_range_rate": 0.0,
        "rollout/final_distance": pytest.approx(flights.final_error.mean(), abs=1e-5),
        "rollout/time_to_0.5m": pytest.approx(flights.time_to[0.5].mean()),
    }


class Falling(gymnasium.ActionWrapper):
    """Rotors at their least: the ground is 15 m below."""

    def action(self, action):
        return -np.ones(4, dtype=np.float32)


@pytest.mark.parametrize("algorithm", [PPO, SAC])
def test_single_environments_and_lost_flights(algorithm, tmp_path):
    env = make_vec_env("QuadTargetTracking-v0", 2, seed=0, wrapper_class=Falling)
    size = (
        {"n_steps": 100, "batch_size": 200, "n_epochs": 1}
        if algorithm is PPO
        else {"learning_starts": 10_000}
    )
    model = algorithm("MlpPolicy", env, **size, **small())
    metrics = FlightMetrics()
    model.learn(600, callback=metrics)
    assert metrics.metrics() == {
        "rollout/reached_0.1m": 0.0,
        "rollout/collision_rate": 1.0,
        "rollout/out_of_range_rate": 0.0,
    }
    env.close()


def test_an_episode_that_began_unseen_is_left_out():
    env = QuadcopterVecEnv(2, "state_recovery", max_episode_steps=30, seed=0)
    model = PPO("MlpPolicy", env, n_steps=20, batch_size=40, n_epochs=1, **small())
    model.learn(40)
    metrics = FlightMetrics()
    model.learn(40, callback=metrics, reset_num_timesteps=False)
    assert metrics.metrics() == {}
    model.learn(160, callback=metrics, reset_num_timesteps=False)
    assert metrics.metrics()["rollout/time_to_0.1m"] == 0.0  # a recovery begins at its target


def test_other_environments_and_numbers_are_refused():
    with pytest.raises(ConfigError, match="must be positive"):
        FlightMetrics(tolerance=0.0)
    with pytest.raises(ConfigError, match="window 0"):
        FlightMetrics(window=0)
    with pytest.raises(ConfigError, match="not a quadcopter"):
        PPO("MlpPolicy", "Pendulum-v1", n_steps=10, batch_size=10, **small()).learn(
            10, callback=FlightMetrics()
        )
