"""The memory that a job needs, told before it is taken."""

import itertools
from collections.abc import Mapping

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from sb3_quad.base.memory import check_memory
from sb3_quad.training.config import TrainingConfig

ROLLOUT_COLUMNS = 6  # of a rollout buffer, float32 each, beside observations and actions
REPLAY_COLUMNS = 3  # of a replay buffer, likewise


def check_buffer(config: TrainingConfig, env: VecEnv) -> None:
    """:raises ConfigError: a rollout buffer, or a replay buffer, for which this machine has too little memory."""
    seen, done = (int(np.prod(space.shape or ())) for space in (env.observation_space, env.action_space))
    if config.is_off_policy:
        size = config.keyword("buffer_size")
        check_memory(f"buffer_size {size:,}", 4.0 * (2 * seen + done + REPLAY_COLUMNS) * size)
        return
    n_steps = config.rollout_steps
    what = f"n_steps {n_steps:,} by n_envs {env.num_envs:,}"
    check_memory(what, 4.0 * (seen + done + ROLLOUT_COLUMNS) * n_steps * env.num_envs)


def check_networks(config: TrainingConfig, env: VecEnv) -> None:
    """:raises ConfigError: hidden layers of actor and critics for which this machine has too little memory."""
    net_arch = config.policy_kwargs.get("net_arch")
    parts = ("pi", "vf", "qf", "qf")
    layers = [net_arch.get(part, []) for part in parts] if isinstance(net_arch, Mapping) else [net_arch or []] * 2
    inputs = float(np.prod(env.observation_space.shape or (1,)))
    weights = float(sum(before * after for each in layers for before, after in itertools.pairwise([inputs, *each])))
    check_memory("policy_kwargs: net_arch", 16.0 * weights)  # each with its gradient and two numbers of Adam's
