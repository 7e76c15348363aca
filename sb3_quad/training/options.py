"""The options of a training: flags of ``train``, ``tune`` and ``sweep``, keys of a sweep's file.

Cheap to import, so that ``--help`` is quick.
"""

from typing import Annotated, Literal

from pydantic import AfterValidator, BeforeValidator, NonNegativeFloat, PositiveInt

from sb3_quad.base.errors import ConfigError, raised_as
from sb3_quad.base.literals import parse_number
from sb3_quad.base.seeds import Seed
from sb3_quad.base.types import StrDict, StrMapping
from sb3_quad.base.validate import Frozen

# What is trained if neither algorithm, environment nor settings file is given; and the defaults of
# a single run
DEFAULT_PIPELINE = "two_stage.yml"
DEFAULT_ALGO = "dagger"
DEFAULT_ENV = "QuadTargetTracking-v0"
# A pipeline's stages have their own values of these.
KEPT_BY_STAGES = ("algo", "env", "n_timesteps", "initial_policy")
# YAML reads 1e6 as text.
Number = Annotated[int, BeforeValidator(parse_number)]


def _check_device(device: str) -> str:
    """Refuse a device that PyTorch does not know, and CUDA on a machine without it, where SB3 would
    use the CPU without a warning.
    """
    import torch

    if device != "auto":
        with raised_as(ConfigError, f"device {device}; give cpu or auto"):
            torch.device(device)
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise ConfigError(f"device {device}: PyTorch finds no CUDA here; give cpu or auto")
    return device


class SettingsOptions(Frozen):
    """Keys of a settings file that have their own flag; None keeps the file's value."""

    n_timesteps: Number | None = None
    """timesteps, rounded up to whole rollouts; fewer than one rollout shorten the rollout"""
    n_envs: Number | None = None
    """number of parallel environments"""
    vec_env: str | None = None
    """batch (compiled), dummy (PyBullet) or subproc (one process each)"""
    expert: str | None = None
    """pid, geometric, path/to/model.zip or package.module:factory"""
    env_kwargs: StrDict | None = None
    """environment keywords, such as noise:0"""
    eval_env_kwargs: StrDict | None = None
    """environment keywords for evaluations only"""


def all_changes(hyperparams: StrMapping, options: StrMapping) -> StrDict:
    """Return the changes to a settings file: hyperparameters, and keys that have their own flag.

    :raises ConfigError: a key that is in both, one of which would be ignored.
    """
    for key in sorted(hyperparams.keys() & options.keys()):
        raise ConfigError(f"{key}: given by itself and in hyperparams; remove it from one of them")
    return {**hyperparams, **options}


class RunOptions(Frozen):
    """Run options outside the settings file; the configurations of a sweep may override them."""

    initial_policy: str | None = None
    """agent to start from: an SB3 zip, a run folder or a name"""
    n_eval_envs: PositiveInt | None = None
    """environments of an evaluation (batch: one per episode; else 1)"""
    device: Annotated[str, AfterValidator(_check_device)] = "cpu"
    """cpu, cuda or auto"""
    eval_freq: Number = 250_000
    """timesteps between evaluations; below 1: one at the end"""
    eval_episodes: Number = 48
    """episodes per evaluation; 0: no evaluations"""
    save_freq: Number = -1
    """timesteps between checkpoints; below 1: none"""
    snapshot_every: NonNegativeFloat = 60.0
    """seconds between snapshots, from which --resume continues after a crash; 0: only when a signal
    ends it"""


class JobOptions(RunOptions):
    """All options of a training. All its random numbers follow from ``seed``."""

    log_folder: str = "logs"
    """folder for the run folders"""
    seed: Seed = 0
    """seed of policy, environments and exploration"""
    log_interval: PositiveInt = 1
    """rollouts between two tables of --verbose 1"""
    tensorboard_log: str | None = None
    """folder for TensorBoard"""
    verbose: Literal[0, 1, 2] = 0
    """1: SB3's tables, 2: debugging"""
    progress: bool = False
    """progress bar; without it, a line each minute"""
    track: bool = False
    """track with Weights & Biases, which needs -tb, see docs/zoo.md"""
