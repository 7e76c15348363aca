"""TrajectoryPlots: at its steps, of the policy as it is, and without a trace in the training."""

import gymnasium
import numpy as np
import pytest
import torch
from stable_baselines3 import A2C, PPO, SAC
from stable_baselines3.common.logger import Figure, KVWriter, Logger

from sb3_quad.base.errors import ConfigError
from sb3_quad.callbacks.trajectory_plots import TrajectoryPlots
from sb3_quad.envs.vec_env import QuadcopterVecEnv


def small():
    return {"policy_kwargs": {"net_arch": [4]}, "seed": 0, "device": "cpu"}  # SB3 adds to them: not the same ones again


class Kept(KVWriter):
    """Keeps the plots it is given."""

    def __init__(self):
        self.plots = {}

    def write(self, key_values, key_excluded, step=0):
        if "flights/figure" in key_values:
            assert isinstance(key_values["flights/figure"], Figure)
            assert set(key_excluded["flights/figure"]) >= {"stdout", "csv"}
            self.plots[step] = key_values["flights/figure"].figure

    def close(self):
        pass


def train(algorithm, callback, steps=100, **kwargs):
    env = QuadcopterVecEnv(2, task="state_recovery", seed=0)
    model = algorithm("MlpPolicy", env, **small(), **kwargs)
    kept = Kept()
    model.set_logger(Logger(None, [kept]))
    model.learn(steps, callback=callback)
    return model, kept.plots


def make(**kwargs):
    return TrajectoryPlots(every=40, n_flights=2, max_steps=30, task="state_recovery", **kwargs)


@pytest.mark.parametrize(
    ("algorithm", "kwargs"),
    [(PPO, {"n_steps": 10, "batch_size": 10}), (A2C, {"n_steps": 10}), (SAC, {"learning_starts": 20, "batch_size": 8})],
)
def test_plots_come_regularly_and_leave_no_trace(algorithm, kwargs):
    model, plots = train(algorithm, make(), **kwargs)
    assert list(plots) == [40, 80]
    other, none = train(algorithm, None, **kwargs)
    assert not none
    for ours, theirs in zip(model.policy.parameters(), other.policy.parameters(), strict=True):
        assert torch.equal(ours, theirs)


def test_the_plot_shows_the_same_flights_of_the_policy_as_it_is():
    _, plots = train(PPO, make(), n_steps=10, batch_size=10, learning_rate=0.1)
    space, error, actions = plots[40].axes
    assert len(error.lines) == 2 and len(actions.lines) == 4 and len(space.lines) == 4
    assert error.lines[0].get_ydata()[0] == 0.0 and error.lines[0].get_xdata()[-1] == pytest.approx(0.3)
    later = plots[80].axes[1]
    first, second = error.lines[0].get_ydata(), later.lines[0].get_ydata()
    assert first[0] == second[0] and not np.array_equal(first, second)
    assert all("(" in axes.get_xlabel() for axes in plots[40].axes)


def test_other_spaces_and_numbers_are_refused():
    with pytest.raises(ConfigError, match="every is 0"):
        TrajectoryPlots(every=0)
    model = PPO("MlpPolicy", gymnasium.make("Pendulum-v1"), n_steps=4, batch_size=4, **small())
    with pytest.raises(ConfigError, match=r"\(3,\)"):
        model.learn(4, callback=TrajectoryPlots(every=2))
