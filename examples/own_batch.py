"""Train in a batch of your own: you write how rows begin and move, ``BatchVecEnv`` does the rest.

    python examples/own_batch.py

The batch is a row of pendulums that a motor keeps upright. All rows move in one call of compiled
code.
"""

import argparse

import numba
import numpy as np
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_quad.envs import BatchVecEnv


@numba.njit
def move(state, actions):
    """Move all pendulums, (n, 2): angle from upright, rad, and angular velocity, rad/s."""
    for row in range(len(state)):
        torque = 20.0 * actions[row, 0] + 10.0 * np.sin(state[row, 0])
        state[row, 1] += 0.02 * torque
        state[row, 0] += 0.02 * state[row, 1]


class Pendulums(BatchVecEnv):
    """Stay upright: a point for each of up to 200 steps."""

    max_episode_steps = 200

    def __init__(self, n_envs):
        observation = spaces.Box(-np.inf, np.inf, (2,), np.float32)
        super().__init__(n_envs, observation, spaces.Box(-1.0, 1.0, (1,), np.float32))
        self.state = np.zeros((n_envs, 2), np.float32)

    def begin(self, rows):
        """Put the given rows nearly upright; return their observations."""
        self.state[rows] = self.rng.normal(0.0, 0.1, (len(rows), 2))
        return self.state[rows]

    def advance(self, actions):
        """Move all rows; return observations, rewards, and which have fallen."""
        move(self.state, actions)
        fallen = np.abs(self.state[:, 0]) > 0.5
        return self.state, 1.0 - fallen, fallen


def main():
    """Train, and print the improvement."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--timesteps", type=int, default=100_000)
    arguments = parser.parse_args()

    model = PPO("MlpPolicy", Pendulums(64), n_steps=128, batch_size=1024, seed=0, device="cpu")
    print("before:", evaluate_policy(model, Pendulums(64), 64)[0], "of 200 steps upright")
    model.learn(arguments.timesteps)
    print("after:", evaluate_policy(model, Pendulums(64), 64)[0], "of 200 steps upright")


if __name__ == "__main__":
    main()
