"""The flags by which ``train`` and ``tune`` are given settings, and what they say."""

from __future__ import annotations

import argparse
import importlib
import random
import sys
from typing import TYPE_CHECKING, Any

from sb3_quad.base.errors import ConfigError
from sb3_quad.cli.arguments import pairs, whole
from sb3_quad.pretrained_policies import agent_path

if TYPE_CHECKING:
    from sb3_quad.settings.config import TrainingConfig

DEFAULT_ALGO, DEFAULT_ENV = "dagger", "QuadTargetTracking-v0"


def add_settings(parser: argparse.ArgumentParser) -> None:
    """The flags of rl-zoo's ``train.py`` for what is trained, with their meanings."""
    add = parser.add_argument
    add("--algo", help=f"algorithm: dagger, ppo_bc or ppo ({DEFAULT_ALGO})")
    add("--env", help=f"environment id ({DEFAULT_ENV}); any id that Gymnasium knows, with --vec-env dummy or subproc")
    add("-conf", "--conf-file", metavar="FILE", help="settings: a YAML file, or one of the package, such as thesis/dagger.yml")
    add("-n", "--n-timesteps", type=whole, metavar="N", help="transitions to train on")
    add("--n-envs", type=whole, metavar="N", help="environments side by side")
    add("--vec-env", metavar="KIND", help="batch (compiled), dummy (PyBullet, one process) or subproc (one process each)")
    add("--expert", metavar="SPEC", help="pid, geometric, path/to/model.zip or package.module:factory")
    add("-params", "--hyperparams", nargs="+", metavar="K:V", help="settings to change, such as n_steps:500")
    add("--env-kwargs", nargs="+", metavar="K:V", help="keywords of the environment, such as noise:0")
    add("--eval-env-kwargs", nargs="+", metavar="K:V", help="the same, for the evaluation's environments only")
    add("--gym-packages", nargs="+", default=[], metavar="MODULE", help="modules that register further environments")
    start = "agent to start from: policy and critic of an SB3 on-policy zip, or a name such as itm-recovery"
    add("-i", "--trained-agent", type=agent_path, metavar="ZIP", help=start)


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
        import torch

        if options.num_threads < 1:
            raise ConfigError(f"--num-threads {options.num_threads}: must be at least 1")
        torch.set_num_threads(options.num_threads)


def make_config(options: argparse.Namespace) -> TrainingConfig:
    """The settings that a command line describes."""
    from sb3_quad.settings.config import load_config

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


def shows_progress(options: argparse.Namespace) -> bool:
    """Whether a progress bar is wanted: in a terminal, unless asked otherwise."""
    return sys.stderr.isatty() if options.progress is None else bool(options.progress)


def say(line: str) -> None:
    """Print a line at once, also into a pipe."""
    print(line, flush=True)
