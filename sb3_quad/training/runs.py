"""Run folders, laid out as rl-zoo's: ``logs/<algo>/<Env>_<run>/``."""

import shlex
import subprocess
import sys
import uuid
from pathlib import Path
from typing import Any

import stable_baselines3
import torch
import yaml

from sb3_quad.base import __version__
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import make_folder, write_text
from sb3_quad.base.yaml_files import read_yaml
from sb3_quad.controllers.pretrained import BEST, CORRECTED, run_agent
from sb3_quad.controllers.zips import saved_data

MADE_WITH = ("commit", "versions")  # keys of args.yml


class RunFolder:
    """The files of one run. There are also ``rl_model_<N>_steps.zip``, its checkpoints.

    :param path: the folder.
    :param name: the environment id, as file names take it.
    """

    def __init__(self, path: Path, name: str) -> None:
        self.path, self.name = path, name
        self.model = path / f"{name}.zip"  # at the end, or where the run was interrupted
        self.best_model = path / BEST  # of the evaluations: by success, then by mean reward
        self.corrected_model = (
            path / CORRECTED
        )  # the same after trimming, where a pipeline does that
        self.evaluations = path / "evaluations.npz"  # as SB3's EvalCallback writes it
        self.episodes = path / "0.monitor.csv"  # every training episode, as SB3's Monitor writes it
        self.resume_state = path / "resume.npz"  # the snapshot of an unfinished run
        self.config = path / name / "config.yml"  # the settings
        self.arguments = (
            path / name / "args.yml"
        )  # of the command line; env_kwargs: what the agent is judged with
        self.command = path / name / "command.txt"  # what was typed

    @property
    def result(self) -> Path:
        """What the run has to offer: its trimmed agent, else its best one, else its last one."""
        return run_agent(self.path, self.name)

    @property
    def not_begun(self) -> bool:
        """Whether the run ended before its first rollout: it holds neither a snapshot nor any
        model.
        """
        return not self.resume_state.is_file() and not any(self.path.glob("*.zip"))

    @property
    def timesteps(self) -> int:
        """Timesteps of the model at the run's end; 0 before that."""
        ended = self.model.is_file() and not self.resume_state.is_file()
        return int(saved_data(self.model)["num_timesteps"]) if ended else 0

    def checkpoint(self, timesteps: int | str) -> Path:
        """Where the model after ``timesteps`` goes."""
        return self.path / f"rl_model_{timesteps}_steps.zip"

    def latest_checkpoint(self) -> Path:
        """The checkpoint after most timesteps.

        :raises ConfigError: there is none.
        """
        names = [entry.name.split("_")[2] for entry in self.path.glob("rl_model_*_steps.zip")]
        steps = [int(name) for name in names if name.isdigit()]
        if not steps:
            raise ConfigError(
                f"{self.path}: holds no checkpoint; train with --save-freq to have some"
            )
        return self.checkpoint(max(steps))

    def write_yaml(self, settings: dict[str, Any], arguments: dict[str, Any]) -> None:
        """Write config.yml and command.txt, then args.yml: a run that has it has begun."""
        self.config.parent.mkdir(exist_ok=True)
        write_text(self.config, yaml.safe_dump(settings, sort_keys=False))
        program = Path(sys.argv[0]).name
        start = ["sb3-quad"] if program in ("sb3-quad", "__main__.py") else ["python", program]
        write_text(self.command, shlex.join([*start, *sys.argv[1:]]) + "\n")
        write_text(self.arguments, yaml.safe_dump(arguments, sort_keys=False))

    def read_yaml(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """config.yml and args.yml, also of a run of rl_zoo3's.

        :raises ConfigError: either missing, unreadable or not a mapping.
        """
        return read_yaml(self.config), read_yaml(self.arguments)


def made_with() -> dict[str, str]:
    """The commit of the checkout, with a mark where files differ from it, and the versions of what
    a run is made with.
    """
    checkout = Path(__file__).resolve().parents[2]
    command = [
        "git",
        "-C",
        str(checkout),
        "describe",
        "--always",
        "--abbrev=40",
        "--exclude=*",
        "--dirty= and changes",
    ]
    try:
        commit = subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        commit = "not a checkout"
    versions = f"stable-baselines3 {stable_baselines3.__version__}, torch {torch.__version__}"
    return dict(zip(MADE_WITH, (commit, f"sb3_quad {__version__}, {versions}"), strict=True))


def file_name(env_id: str) -> str:
    """An environment id as part of a file name."""
    return env_id.replace("/", "-").replace(":", "-")


def claim_run(log_folder: str | Path, algo: str, env_id: str, unique: bool = False) -> RunFolder:
    """Make the folder of a new run, with the next free number; no other process can get the same
    one.

    :param unique: add a UUID to the name, as rl-zoo's ``--uuid`` does.
    :raises ConfigError: a folder that cannot be made.
    """
    name = file_name(env_id)
    return RunFolder(claim_folder(Path(log_folder) / algo, name, unique), name)


def claim_folder(parent: Path, name: str, unique: bool = False) -> Path:
    """Make ``<parent>/<name>_<number>`` with the next free number; no other process can get the
    same one.

    :raises ConfigError: a folder that cannot be made.
    """
    make_folder(parent, "log folder", "-f")
    number = max(_runs(parent, name), default=0) + 1
    while True:
        path = parent / (f"{name}_{number}_{uuid.uuid4()}" if unique else f"{name}_{number}")
        try:
            path.mkdir()  # fails if another run was quicker
            return path
        except FileExistsError:
            number += 1


def _runs(parent: Path, name: str) -> dict[int, Path]:
    """The folders ``<parent>/<name>_<number>…`` by their numbers."""
    entries = {
        entry: entry.name.removeprefix(f"{name}_").split("_")[0]
        for entry in sorted(parent.glob(f"{name}_*"))
    }
    return {int(number): entry for entry, number in entries.items() if number.isdigit()}


def open_run(path: str | Path) -> RunFolder:
    """The folder of an existing run.

    :raises ConfigError: a folder that holds no run.
    """
    folder = Path(path)
    if not folder.is_dir():
        raise ConfigError(f"run folder {folder}: no such folder")
    configs = sorted(folder.glob("*/config.yml"))
    if len(configs) != 1:
        raise ConfigError(f"run folder {folder}: holds no run (<Env>/config.yml is missing)")
    return RunFolder(folder, configs[0].parent.name)


def find_run(log_folder: str | Path, algo: str, env_id: str, exp_id: int = 0) -> RunFolder:
    """A run by rl-zoo's ``--exp-id``.

    :param exp_id: number of the run; 0: the latest that has an agent.
    :raises ConfigError: there is no such run; the message names those there are.
    """
    parent, name = Path(log_folder) / algo, file_name(env_id)
    runs = _runs(parent, name)
    with_agent = [number for number, path in runs.items() if any(path.glob("*.zip"))]
    number = exp_id if exp_id > 0 else max(with_agent or runs, default=0)
    if number in runs:
        return RunFolder(runs[number], name)
    if not runs:
        raise ConfigError(
            f"{parent}: there is no run of {env_id}; give another place with --env, --algo or -f"
        )
    there = ", ".join(entry.name for entry in runs.values())
    raise ConfigError(
        f"{parent}: there is no run {name}_{number}; there is {there}; give another with --exp-id"
    )
