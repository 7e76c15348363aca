"""Run folders, laid out as rl-zoo's: ``logs/<algo>/<Env>_<run>/``."""

import shlex
import subprocess
import sys
from pathlib import Path

import stable_baselines3
import torch

from sb3_quad.agents.pretrained import BEST, CORRECTED, run_agent
from sb3_quad.agents.zips import saved_data
from sb3_quad.base import __version__
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import make_folder, read_arrays, refuse_outside, write_text
from sb3_quad.base.process import trusted
from sb3_quad.base.types import StrDict, StrMapping, StrPath
from sb3_quad.base.yaml_files import read_yaml, write_yaml
from sb3_quad.training.config import TrainingJob

MADE_WITH = ("commit", "versions")  # keys of args.yml


class RunFolder:
    """The files of one run, besides its checkpoints, ``rl_model_<N>_steps.zip``.

    :param path: the folder.
    :param name: the environment id, as part of file names.
    """

    def __init__(self, path: Path, name: str) -> None:
        self.path = path
        self.name = name
        # The model at the end, or where the run was interrupted.
        self.model = path / f"{name}.zip"
        # The best model of the evaluations, which may be the one that the run started from.
        self.best_model = path / BEST
        # The model after the offset correction, if a pipeline does one.
        self.corrected_model = path / CORRECTED
        # Evaluations as SB3's EvalCallback writes them.
        self.evaluations = path / "evaluations.npz"
        # Every training episode, as SB3's Monitor writes them.
        self.episodes = path / "0.monitor.csv"
        # The snapshot of an unfinished run.
        self.resume_state = path / "resume.npz"
        # The traceback of the error that ended the run.
        self.error = path / "error.txt"
        # The settings.
        self.config = path / name / "config.yml"
        # The options; its env_kwargs are those of the evaluations.
        self.arguments = path / name / "args.yml"
        # The command that was typed, for the card of a published agent.
        self.command = path / name / "command.txt"

    @property
    def result(self) -> Path:
        """The run's agent: the corrected model, or else the best one, or else the last one."""
        return run_agent(self.path, self.name)

    @property
    def not_begun(self) -> bool:
        """Whether the run ended before its first rollout, without a snapshot or a model of its own.

        The best model may be there already: the one that it starts from.
        """
        if self.resume_state.is_file():
            return False
        zips = [*self.path.glob("*.zip")]
        if zips == [self.best_model] and self.evaluations.is_file():
            return not read_arrays(self.evaluations)["timesteps"].any()
        return not zips

    @property
    def timesteps(self) -> int:
        """Timesteps of the model at the run's end; 0 before that."""
        if self.resume_state.is_file() or not self.model.is_file():
            return 0
        return int(saved_data(self.model)["num_timesteps"])

    def checkpoint(self, timesteps: int | str) -> Path:
        """Return the path of the model after ``timesteps``."""
        return self.path / f"rl_model_{timesteps}_steps.zip"

    def latest_checkpoint(self) -> Path:
        """Return the path of the latest checkpoint.

        :raises ConfigError: the run has no checkpoint.
        """
        checkpoints = _numbered(self.path, "rl_model")
        if not checkpoints:
            raise ConfigError(
                f"{self.path}: holds no checkpoint; train with --save-freq to have some"
            )
        return self.checkpoint(max(checkpoints))

    def write_yaml(self, settings: StrDict, arguments: StrDict) -> None:
        """Write config.yml, command.txt and args.yml.

        args.yml comes last, so that a run with it is complete.
        """
        self.config.parent.mkdir(exist_ok=True)
        write_yaml(self.config, settings)
        write_text(self.command, f"{shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])}\n")
        write_yaml(self.arguments, arguments)

    def read_yaml(self) -> tuple[StrDict, StrDict]:
        """Read config.yml and args.yml, including those of rl_zoo3.

        :raises ConfigError: either is missing, unreadable or not a mapping.
        """
        return read_yaml(self.config), read_yaml(self.arguments)


def made_with() -> StrDict:
    """Return the commit of the checkout and the versions of the packages that train a run.

    The commit is marked if files differ from it.
    """
    try:
        commit = subprocess.check_output(
            shlex.split("git describe --always --abbrev=40 --exclude=* '--dirty= and changes'"),
            cwd=Path(__file__).parent,
            text=True,
            stderr=subprocess.DEVNULL,
        )
    except (OSError, subprocess.CalledProcessError):
        commit = "not a checkout"
    return {
        "commit": commit.strip(),
        "versions": f"sb3_quad {__version__}, stable-baselines3 {stable_baselines3.__version__}, "
        f"torch {torch.__version__}",
    }


def file_name(env_id: str) -> str:
    """Return an environment id as part of a file name."""
    return env_id.replace("/", "-").replace(":", "-")


def claim_run(log_folder: StrPath, algo: str, env_id: str) -> RunFolder:
    """Make the folder of a new run, with the next free number.

    No other process can get the same one.

    :raises ConfigError: a folder that cannot be made.
    """
    name = file_name(env_id)
    return RunFolder(claim_folder(Path(log_folder) / algo, name), name)


def claim_folder(parent: Path, name: str) -> Path:
    """Make ``<parent>/<name>_<number>`` with the next free number.

    No other process can get the same one.

    :raises ConfigError: a folder that cannot be made.
    """
    make_folder(parent, "log folder", "-f")
    folders = _numbered(parent, name)
    # Numbers of removed runs before the last one are not reused.
    number = max(folders, default=0) + 1
    while True:
        path = parent / f"{name}_{number}"
        try:
            path.mkdir()
            return path
        except FileExistsError:
            # Another process was quicker.
            number += 1


def _numbered(parent: Path, name: str) -> dict[int, Path]:
    """Return the folders or files ``<parent>/<name>_<number>…`` by their numbers."""
    paths = {}
    for path in sorted(parent.glob(f"{name}_*")):
        number = path.name.removeprefix(f"{name}_").split("_")[0]
        if number.isdigit():
            paths[int(number)] = path
    return paths


def open_run(path: StrPath) -> RunFolder:
    """Open the folder of an existing run.

    :raises ConfigError: a folder that holds no run.
    """
    folder = Path(path)
    if not folder.is_dir():
        raise ConfigError(f"run folder {folder}: no such folder")
    configs = sorted(folder.glob("*/config.yml"))
    if len(configs) != 1:
        raise ConfigError(f"run folder {folder}: holds no run (<Env>/config.yml is missing)")
    return RunFolder(folder, configs[0].parent.name)


def refuse_elsewhere(job: TrainingJob, where: str, log_folder: Path, given: StrMapping) -> None:
    """Refuse what may write elsewhere in a run, which may be a stranger's: callbacks, wrappers, and
    a folder for TensorBoard.

    :param where: what the message calls the run's settings.
    :param given: options that the user gives instead of the run's.
    :raises ConfigError: it has a path out of the log folder and the current one.
    """
    if job.tensorboard_log and not given.get("tensorboard_log"):
        refuse_outside(job.tensorboard_log, where, log_folder, Path())
    config = job.config
    for name, keywords in (*config.callback, *config.env_wrapper, *config.vec_env_wrapper):
        for value in keywords.values():
            if isinstance(value, str) and not trusted():
                refuse_outside(value, f"{where}: {name}", log_folder, Path())


def find_run(log_folder: StrPath, algo: str, env_id: str, exp_id: int = 0) -> RunFolder:
    """Find a run by rl-zoo's ``--exp-id``.

    :param exp_id: number of the run; 0: the latest that has an agent.
    :raises ConfigError: there is no such run; the message names the existing ones.
    """
    parent = Path(log_folder) / algo
    name = file_name(env_id)
    folders = _numbered(parent, name)
    if not folders:
        raise ConfigError(
            f"{parent}: there is no run of {env_id}; give another place with --env, --algo or -f"
        )
    if exp_id <= 0:
        with_agent = [number for number, path in folders.items() if any(path.glob("*.zip"))]
        exp_id = max(with_agent or folders)
    if exp_id not in folders:
        raise ConfigError(
            f"{parent}: there is no run {name}_{exp_id}; "
            f"there is {', '.join(folder.name for folder in folders.values())}; "
            "give another with --exp-id"
        )
    return RunFolder(folders[exp_id], name)
