"""The options of a training: flags of ``train``, ``tune`` and ``sweep``, keys of a sweep's file.

Cheap to import, so that ``--help`` is quick.
"""

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, NonNegativeFloat, PositiveInt, model_validator

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.imports import require
from sb3_quad.base.seeds import Seed
from sb3_quad.base.types import StrDict
from sb3_quad.base.validate import Frozen


def option(default: Any, description: str, *flags: str, metavar: str | None = "N") -> Any:
    """Make a field that is also a flag.

    :param flags: rl-zoo's short names of the flag.
    """
    return Field(
        default=default,
        description=description,
        json_schema_extra={"flags": list(flags), "metavar": metavar},
    )


def _check_device(device: str) -> str:
    """Refuse CUDA on a machine without it; SB3 would take the CPU without a warning."""
    import torch

    if device.startswith("cuda") and not torch.cuda.is_available():
        raise ConfigError(f"device {device}: PyTorch finds no CUDA here; give cpu or auto")
    return device


class SettingsOptions(Frozen):
    """Keys of a settings file that have a flag of their own; None keeps the file's value."""

    n_timesteps: int | None = option(
        None, "timesteps, in whole rollouts; fewer than one shorten it", "-n"
    )
    n_envs: int | None = option(None, "number of parallel environments")
    vec_env: str | None = option(
        None, "batch (compiled), dummy (PyBullet) or subproc (one process each)", metavar="KIND"
    )
    expert: str | None = option(
        None, "pid, geometric, path/to/model.zip or package.module:factory", metavar="SPEC"
    )
    env_kwargs: StrDict | None = option(
        None, "environment keywords, such as noise:0", metavar="K:V"
    )


class RunOptions(Frozen):
    """Run options outside the settings file; the configurations of a sweep may override them."""

    eval_env_kwargs: StrDict | None = option(
        None, "environment keywords for evaluations only", metavar="K:V"
    )
    trained_agent: str | None = option(
        None, "agent to start from: an SB3 zip, a run folder or a name", "-i", metavar="ZIP"
    )
    n_eval_envs: PositiveInt | None = option(
        None, "environments of an evaluation (batch: one per episode; else 1)"
    )
    device: Annotated[str, AfterValidator(_check_device)] = option(
        "cpu", "cpu, cuda or auto", metavar=None
    )
    eval_freq: int = option(250_000, "timesteps between evaluations; below 1: one at the end")
    eval_episodes: int = option(48, "episodes per evaluation; 0: no evaluations")
    save_freq: int = option(-1, "timesteps between checkpoints; below 1: none")
    snapshot_every: NonNegativeFloat = option(
        60.0,
        "seconds between snapshots, from which --resume continues after a crash; 0: none",
        metavar="SECONDS",
    )


class JobOptions(RunOptions):
    """All options of a training. All its random numbers follow from ``seed``."""

    log_folder: str = option("logs", "folder for the run folders", "-f", metavar="DIR")
    seed: Seed = option(0, "seed of policy, environments and exploration")
    log_interval: PositiveInt = option(1, "rollouts between two tables of --verbose 1")
    tensorboard_log: str | None = option(None, "folder for TensorBoard", "-tb", metavar="DIR")
    verbose: Literal[0, 1, 2] = option(0, "1: SB3's tables, 2: debugging")
    uuid: bool = option(False, "add a UUID to the run folder's name", "-uuid", metavar=None)
    progress: bool = option(
        False, "progress bar; without it, a line each minute", "-P", metavar=None
    )
    track: bool = option(
        False, "track with Weights & Biases; -tb is runs unless you give it", metavar=None
    )
    wandb_project_name: str = option("sb3", "project in Weights & Biases", metavar="NAME")
    wandb_entity: str | None = option(None, "entity there, a user or team", metavar="NAME")
    wandb_group: str | None = option(None, "group of runs there", metavar="NAME")
    wandb_tags: list[str] | None = option(None, "tags of the run there", "-tags", metavar="TAG")

    @model_validator(mode="before")
    @classmethod
    def _tracked(cls, given: StrDict) -> StrDict:
        """Weights & Biases shows what TensorBoard is given, so there must be a folder for that."""
        if not given.get("track"):
            return given
        require("wandb", "track", "--track")
        return {**given, "tensorboard_log": given.get("tensorboard_log") or "runs"}
