"""Train with the gradient of an environment of your own, written in PyTorch.

    python examples/gradient_of_your_environment.py

``APG`` asks its environment for a tape, ``env.record(n_steps, substeps)``. A tape records flights
step by step and then carries gradients back, the last step first: see
``sb3_quad.algorithms.apg.Tape``. Here PyTorch differentiates each step. Your own code that returns
a vector-Jacobian product would also do.

The environment is a row of carts. A force moves each one to its mark, where it should stop.
"""

import argparse

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_quad import APG
from sb3_quad.envs import BatchVecEnv

DT = 0.05  # s
N_STEPS = 80


def move(state, action):
    """Return the state after a step, (n, 2): distance from the mark, m, and velocity, m/s."""
    force = 2.0 * action[:, 0].clamp(-1.0, 1.0)  # N, on a cart of 1 kg
    velocity = state[:, 1] + DT * (force - 0.1 * state[:, 1])
    return th.stack([state[:, 0] + DT * velocity, velocity], dim=1)


def cost_of(state, action):
    """Return the cost of each step, (n,)."""
    return state[:, 0].abs() + 0.05 * state[:, 1].square() + 0.01 * action[:, 0].square()


class CartTape:
    """The tape of :class:`Carts`."""

    def __init__(self, env, n_steps):
        self.env = env
        self.n_steps = n_steps

    def reset(self, continue_flights):
        """Begin a recording; return the observations (n, 2)."""
        self.steps = []
        return self.env.state if continue_flights else self.env.reset()

    def step(self, actions):
        """Move the carts; return the observations (n, 2)."""
        before = th.from_numpy(self.env.state).requires_grad_()
        action = th.from_numpy(actions).requires_grad_()
        after = move(before, action)
        self.steps.append((before, action, after, cost_of(after, action)))
        self.env.state = after.detach().numpy()
        return self.env.state

    def episodes(self):
        """Return the reward of each cart's flight, its length, and whether it was lost."""
        costs = th.stack([cost for *_, cost in self.steps]).sum(dim=0)
        n = self.env.num_envs
        return -costs.detach().numpy(), np.full(n, self.n_steps), np.zeros(n, dtype=bool)

    def begin(self):
        """Begin the backward pass; return the mean cost."""
        self.grad_state = th.zeros(self.env.num_envs, 2)
        return float(th.stack([cost for *_, cost in self.steps]).detach().mean())

    def backward(self, step, grad_observation):
        """Return the gradient with respect to the actions of a step, (n, 1)."""
        before, action, after, cost = self.steps[step]
        # The observation is the state.
        grad_after = self.grad_state + th.from_numpy(grad_observation)
        grad_cost = th.full_like(cost, 1.0 / (self.n_steps * self.env.num_envs))
        self.grad_state, grad_action = th.autograd.grad(
            (after, cost), (before, action), (grad_after, grad_cost)
        )
        return grad_action.numpy()


class Carts(BatchVecEnv):
    """A row of carts; an observation is the distance and the velocity of one."""

    def __init__(self, n_envs, seed):
        observations = spaces.Box(-np.inf, np.inf, (2,), np.float32)
        super().__init__(n_envs, observations, spaces.Box(-1.0, 1.0, (1,), np.float32))
        self.seed(seed)
        self.state = np.zeros((n_envs, 2), np.float32)

    def record(self, n_steps, substeps):
        """Return a tape; the carts have no substeps."""
        return CartTape(self, n_steps)

    def begin(self, rows):
        """Put these carts at random distances."""
        self.state[rows] = self.rng.normal(0.0, 2.0, (len(rows), 2))
        return self.state[rows]

    def advance(self, actions):
        """Move the carts; their episodes do not end."""
        action = th.from_numpy(actions)
        state = move(th.from_numpy(self.state), action)
        self.state = state.numpy()
        return self.state, -cost_of(state, action), np.zeros(self.num_envs, dtype=bool)


def distance(model):
    """Return the median distance of fresh carts from the mark at the end, m."""
    env = Carts(256, seed=1)
    observations = env.reset()
    for _ in range(N_STEPS):
        env.step_async(model.predict(observations, deterministic=True)[0])
        observations, *_ = env.step_wait()
    return np.median(np.abs(env.state[:, 0]))


def main():
    """Train, and print the improvement."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--updates", type=int, default=150)
    arguments = parser.parse_args()

    env = Carts(64, seed=0)
    model = APG("MlpPolicy", env, n_steps=N_STEPS, learning_rate=3e-3, seed=0)
    print(f"before: {distance(model):.3f} m from the mark")
    model.learn(arguments.updates * N_STEPS * env.num_envs)
    print(f"after: {distance(model):.3f} m from the mark")


if __name__ == "__main__":
    main()
