"""DAgger on Gymnasium's LunarLander, from the controller that Gymnasium itself tests it with.

    pip install "gymnasium[box2d]"
    python examples/lunar_lander.py

Expert and agent fly the same hundred fresh episodes.
"""

import argparse

import numpy as np
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.utils import LinearSchedule

from sb3_quad import DAgger

ENV = "LunarLanderContinuous-v3"
N_EPISODES = 100


def land(observations):
    """Do what ``gymnasium.envs.box2d.lunar_lander.heuristic`` does, for many landers at once."""
    x, y, x_velocity, y_velocity, angle, rate, left, right = observations.T
    tilt = np.clip(0.5 * x + x_velocity, -0.4, 0.4)
    turn = 0.5 * (tilt - angle) - rate
    climb = 0.5 * (0.55 * np.abs(x) - y) - 0.5 * y_velocity
    on_ground = (left > 0) | (right > 0)
    turn = np.where(on_ground, 0.0, turn)
    climb = np.where(on_ground, -0.5 * y_velocity, climb)
    return np.stack([20.0 * climb - 1.0, -20.0 * turn], axis=1).clip(-1.0, 1.0)


class Flown:
    """An expert as ``evaluate_policy`` takes it."""

    def predict(self, observations, state=None, episode_start=None, deterministic=True):
        """Return the actions, and no state."""
        return land(observations).astype(np.float32), None


def report(name, controller):
    """Print the mean reward of fresh episodes, the same for all."""
    env = make_vec_env(ENV, N_EPISODES, seed=1_000_000)
    rewards, _ = evaluate_policy(controller, env, N_EPISODES, return_episode_rewards=True)
    print(f"{name}: mean reward {np.mean(rewards):.1f}, worst {np.min(rewards):.0f}", flush=True)


parser = argparse.ArgumentParser(
    description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
)
parser.add_argument("--timesteps", type=int, default=48_000, help="of DAgger (%(default)s)")
parser.add_argument("--seed", type=int, default=0, help="of the training (%(default)s)")
arguments = parser.parse_args()

report("expert", Flown())
model = DAgger(
    "MlpPolicy",
    make_vec_env(ENV, 16, seed=arguments.seed),
    expert=land,
    n_steps=250,
    batch_size=256,
    gradient_steps=200,
    beta_decay=0.05,
    beta_final=0.0,
    gamma=0.99,
    learning_rate=LinearSchedule(2e-3, 1e-4, 1.0),
    seed=arguments.seed,
    device="cpu",
)
model.learn(arguments.timesteps)
report("DAgger", model)
model.save("lunar_lander")
