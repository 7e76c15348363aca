"""Agents in run folders, by rl-zoo's names."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from sb3_quad.base.errors import ConfigError
from sb3_quad.settings.flight import FlightSettings
from sb3_quad.training.runs import find_run


@dataclass(frozen=True)
class Agent:
    """A trained agent."""

    label: str  # heads its picture
    path: Path  # of its zip
    settings: FlightSettings  # that it was judged with


def find_agent(log_folder: str, algo: str, env_id: str, exp_id: int = 0, which: str | int | None = None) -> Agent:
    """The agent of a run.

    :param exp_id: number of the run; 0: the latest.
    :param which: ``best``, ``last checkpoint``, or the timesteps of a checkpoint; None: trimmed, else best, else last.
    :raises ConfigError: no such run or file, settings that cannot be read, or a wrapper that flights to be shown lack.
    """
    run = find_run(log_folder, algo, env_id, exp_id)
    if isinstance(which, int):
        path = run.checkpoint(which)
    elif which == "last checkpoint":
        path = run.latest_checkpoint()
    else:
        path = run.best_model if which == "best" else run.result
    if not path.is_file():
        zips = ", ".join(sorted(each.name for each in run.path.glob("*.zip")))
        raise ConfigError(f"{path}: no such file; the run holds {zips}")
    settings, _ = run.read_yaml()
    for key in ("env_wrapper", "vec_env_wrapper", "frame_stack", "normalize"):
        if settings.get(key):
            raise ConfigError(f"{run.path}: was trained with {key}, which enjoy does not put around the environment")
    return Agent(f"{algo} {run.path.name}", path, FlightSettings.beside(path)[0])
