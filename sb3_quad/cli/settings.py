"""The settings that the flags of ``train`` and ``tune`` describe."""

from __future__ import annotations

import argparse
import importlib
import random
from typing import Any

import torch

from sb3_quad.base.errors import ConfigError
from sb3_quad.cli.arguments.train import DEFAULT_ALGO, DEFAULT_ENV
from sb3_quad.cli.parser import pairs
from sb3_quad.settings.config import TrainingConfig, load_config


def prepare(options: argparse.Namespace) -> None:
    """Import further environments, set the number of threads.

    :raises ConfigError: a module that cannot be imported, a number below one.
    """
    for package in options.gym_packages:
        try:
            importlib.import_module(package)
        except ImportError as error:
            raise ConfigError(f"--gym-packages {package}: cannot be imported ({error})") from None
    if options.num_threads is not None:
        if options.num_threads < 1:
            raise ConfigError(f"--num-threads {options.num_threads}: must be at least 1")
        torch.set_num_threads(options.num_threads)


def make_config(options: argparse.Namespace) -> TrainingConfig:
    """The settings that a command line describes."""
    return load_config(options.algo or DEFAULT_ALGO, options.env or DEFAULT_ENV, options.conf_file, make_overrides(options))


def make_overrides(options: argparse.Namespace) -> dict[str, Any]:
    """The settings that a command line changes."""
    overrides = pairs(options.hyperparams, "--hyperparams")
    for name in ("n_timesteps", "n_envs", "vec_env", "expert"):
        if getattr(options, name) is not None:
            overrides[name] = getattr(options, name)
    if options.env_kwargs is not None:
        overrides["env_kwargs"] = pairs(options.env_kwargs, "--env-kwargs")
    return overrides


def make_seed(options: argparse.Namespace) -> int:
    """The seed that is asked for: 0 by default, a random one for a negative one."""
    if options.seed is None:
        return 0
    return options.seed if options.seed >= 0 else random.SystemRandom().randrange(2**31)
