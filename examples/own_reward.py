"""A reward of your own: the task's coefficients by name, and a wrapper for anything else.

    python examples/own_reward.py

Here restless actions cost something, and an agent that comes with sb3_quad learns to fly with
calmer ones. The wrapper is SB3's, around many vehicles at once; around a single environment
(`gymnasium.make`), use a `gymnasium.Wrapper` with the same two lines.
"""

import argparse

import numpy as np
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnvWrapper, VecMonitor

from sb3_quad import PPOBC, QuadcopterVecEnv, fly


class CalmActions(VecEnvWrapper):
    """Subtracts `cost` times the mean squared change of the action from the reward of every control
    step.
    """

    changes = ""  # neither observations nor actions

    def __init__(self, venv, cost):
        super().__init__(venv)
        self.cost = cost

    def reset(self):
        """Begin a new episode in every row; hover is the action before."""
        shape = self.action_space.shape or ()
        self.last = np.zeros((self.num_envs, *shape), dtype=np.float32)
        return self.venv.reset()

    def step_async(self, actions):
        """Note how much the action changes."""
        self.change = np.square(actions - self.last).mean(axis=1)
        self.last = actions.copy()
        self.venv.step_async(actions)

    def step_wait(self):
        """Return the environment's own reward minus the cost."""
        observations, rewards, dones, infos = self.venv.step_wait()
        # These rows begin their next episode.
        self.last[dones] = 0.0
        return observations, rewards - self.cost * self.change.astype(np.float32), dones, infos


def make_env(n_envs, seed):
    """Coefficients of Eqs. 4.5 to 4.9 are `task_kwargs`: here a tilt costs twice as much as in the
    thesis.
    """
    env = QuadcopterVecEnv(
        n_envs,
        "target_tracking",
        task_kwargs={"tilt_cost": 0.004},
        max_episode_steps=500,
        seed=seed,
    )
    # With this, ep_rew_mean is that of the new reward; SB3 warns about it.
    return VecMonitor(CalmActions(env, cost=2.0))


parser = argparse.ArgumentParser(
    description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
)
parser.add_argument(
    "--timesteps",
    type=int,
    default=600_000,
    help="transitions, over all environments (%(default)s)",
)
arguments = parser.parse_args()

model = PPOBC(
    "MlpPolicy",
    make_env(240, 0),
    expert="geometric",
    initial_policy="itm-imitation",
    bc_coef=5.0,
    bc_loss="huber_mse",
    bc_filter="none",
    n_steps=125,
    batch_size=5000,
    n_epochs=6,
    gamma=0.99,
    gae_lambda=0.98,
    critic_warmup=2,
    learning_rate=LinearSchedule(3e-4, 1.5e-5, 1.0),
    policy_kwargs={"log_std_init": -2.6},
    seed=0,
    device="cpu",
)
for when in ("before", "after"):
    if when == "after":
        model.learn(arguments.timesteps)
    reward, _ = evaluate_policy(model, make_env(96, 1_000_000), n_eval_episodes=96)
    flights = fly(model, "target_tracking", n_episodes=480, seed=1_000_000)
    shares = f"success {flights.success.mean():.1%}, survival {flights.survival.mean():.1%}"
    print(f"agent {when} training: mean reward {reward:.2f}, {shares}")
