"""DAgger and PPOBC on Gymnasium's Pendulum, from an expert of five lines.

    python examples/pendulum.py

DAgger imitates a swing-up controller. Then an expert that uses half of the torque is imitated, and
PPOBC makes the agent better than this expert. PPO with the same settings learns from scratch, for
comparison. All fly the same hundred fresh episodes.
"""

import argparse
from functools import partial

import numpy as np
from gymnasium.wrappers import RescaleAction
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.utils import LinearSchedule

from sb3_quad import PPOBC, DAgger

N_EPISODES = 100


def swing_up(observations, limit=2.0):
    """Add the energy that is missing to swing up, then balance; torques by their limit of 2 N m,
    (n, 1).
    """
    cosine, sine, rate = observations.T
    missing = 15.0 * (1.0 - cosine) - 0.5 * rate**2
    hold = -10.0 * np.arctan2(sine, cosine) - 2.0 * rate
    torque = np.where(cosine > 0.9, hold, 2.0 * np.sign(rate * missing))
    return torque[:, None].clip(-limit, limit) / 2.0


class Flown:
    """An expert as ``evaluate_policy`` takes it."""

    def __init__(self, expert):
        self.expert = expert

    def predict(self, observations, state=None, episode_start=None, deterministic=True):
        """Return the torques, and no state."""
        return self.expert(observations).astype(np.float32), None


def make_env(seed):
    """Make 16 pendulums."""
    return make_pendulums(16, seed)


def make_pendulums(n, seed):
    """Make n pendulums with actions in [-1, 1], as cloning asks for."""
    unit = {"min_action": np.float32(-1.0), "max_action": np.float32(1.0)}
    return make_vec_env(
        "Pendulum-v1", n, seed=seed, wrapper_class=RescaleAction, wrapper_kwargs=unit
    )


def report(name, controller):
    """Print the mean reward of fresh episodes, the same for all."""
    env = make_pendulums(N_EPISODES, 1_000_000)
    rewards, _ = evaluate_policy(controller, env, N_EPISODES, return_episode_rewards=True)
    print(f"{name}: mean reward {np.mean(rewards):.1f}, worst {np.min(rewards):.0f}", flush=True)


def imitate(expert, timesteps, seed):
    """Train by DAgger. A rollout is an episode of every pendulum."""
    model = DAgger(
        "MlpPolicy",
        make_env(seed),
        expert=expert,
        n_steps=200,
        batch_size=256,
        gradient_steps=200,
        beta_decay=0.05,
        beta_final=0.0,
        gamma=0.95,
        learning_rate=LinearSchedule(2e-3, 1e-4, 1.0),
        seed=seed,
        device="cpu",
    )
    return model.learn(timesteps)


parser = argparse.ArgumentParser(
    description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
)
parser.add_argument(
    "--timesteps", type=int, default=100_000, help="of PPOBC, and of PPO (%(default)s)"
)
parser.add_argument(
    "--imitation-timesteps", type=int, default=32_000, help="of DAgger (%(default)s)"
)
parser.add_argument("--seed", type=int, default=0, help="of all trainings (%(default)s)")
arguments = parser.parse_args()
seed = arguments.seed

report("expert", Flown(swing_up))
imitation = imitate(swing_up, arguments.imitation_timesteps, seed)
report("DAgger", imitation)
imitation.save("pendulum_dagger")

gentle = partial(swing_up, limit=1.0)
report("gentle expert", Flown(gentle))
imitation = imitate(gentle, arguments.imitation_timesteps, seed)
report("DAgger from it", imitation)

settings = {
    "n_steps": 200,
    "batch_size": 320,
    "gamma": 0.95,
    "gae_lambda": 0.95,
    "learning_rate": LinearSchedule(1e-3, 5e-5, 1.0),
    "policy_kwargs": {"log_std_init": -0.9},
    "seed": seed,
    "device": "cpu",
}
agent = PPOBC("MlpPolicy", make_env(seed), expert=gentle, initial_policy=imitation, **settings)
agent.learn(arguments.timesteps)
report("PPOBC from there", agent)
agent.save("pendulum_ppo_bc")

alone = PPO("MlpPolicy", make_env(seed), **settings).learn(arguments.timesteps)
report("PPO alone", alone)
