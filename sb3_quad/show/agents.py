"""Agents in run folders, by rl-zoo's names."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sb3_quad.base.errors import ConfigError
from sb3_quad.settings.literals import parse_mapping
from sb3_quad.training.runs import RunFolder, find_run, latest_checkpoint


@dataclass(frozen=True)
class Agent:
    """A trained agent."""

    label: str  # heads its picture
    path: Path  # of its zip
    env_kwargs: dict[str, Any]  # the settings of the environment it was judged in


def find_agent(log_folder: str, algo: str, env_id: str, exp_id: int = 0, which: str | int | None = None) -> Agent:
    """The agent of a run.

    :param exp_id: number of the run; 0: the latest.
    :param which: ``best``, ``last checkpoint``, or the timesteps of a checkpoint; None: trimmed, else best, else last.
    :raises ConfigError: no such run or file, or one whose environment cannot be shown.
    """
    run = find_run(log_folder, algo, env_id, exp_id)
    if isinstance(which, int):
        path = run.checkpoint(which)
    elif which == "last checkpoint":
        path = latest_checkpoint(run)
    else:
        path = run.best_model if which == "best" else run.result
    if not path.is_file():
        zips = ", ".join(sorted(each.name for each in run.path.glob("*.zip")))
        raise ConfigError(f"{path}: no such file; the run holds {zips}")
    return Agent(f"{algo} {run.path.name}", path, _env_kwargs(run))


def _env_kwargs(run: RunFolder) -> dict[str, Any]:
    """What the run's agent was judged with.

    :raises ConfigError: settings that cannot be read, or a wrapper around the environment that flights to be shown lack.
    """
    settings, arguments = run.read_yaml()
    for key in ("env_wrapper", "vec_env_wrapper", "frame_stack", "normalize"):
        if settings.get(key):
            raise ConfigError(f"{run.path}: was trained with {key}, which enjoy does not put around the environment")
    if arguments.get("env_kwargs") is not None:
        return parse_mapping(arguments["env_kwargs"], f"{run.arguments}: env_kwargs")
    given = [parse_mapping(settings.get(key), f"{run.config}: {key}") for key in ("env_kwargs", "eval_env_kwargs")]
    return {**given[0], **given[1]}
