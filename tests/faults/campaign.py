"""Kills trainings at random moments, lets them go on, and compares them with undisturbed ones.

    python tests/faults/campaign.py FOLDER KILLS [SEED]

Prints a line for each kill that cost something, and in the end how many there were. Exit code 1 if any did. Commands run in
forks of this process, which has imported everything and has no threads: a kill may then hit their first millisecond.
"""

import os
import random
import signal
import sys
import time
from pathlib import Path

import numpy as np
import torch
import yaml
from stable_baselines3.common.save_util import load_from_zip_file

import sb3_quad.cli.closing
import sb3_quad.training.trim
from sb3_quad.cli import main

RUNS = ("dagger", "ppo_bc", "pipeline")
TINY = {
    "n_timesteps": 8000,
    "n_envs": 16,
    "n_steps": 50,
    "batch_size": 200,
    "n_epochs": 2,
    "env_kwargs": {"max_episode_steps": 60},
    "policy_kwargs": {"net_arch": [16]},
}
DAGGER = {**TINY, "dataset_capacity": 4000, "gradient_steps": 5}  # a ring that has been round
STAGES = [
    {
        "name": "one",
        "algo": "dagger",
        "env": "QuadTargetTracking-v0",
        "conf_file": "nominal/dagger.yml",
        "settings": DAGGER,
        "trim": "hover",
        "pass_on": "last",
    },
    {
        "name": "two",
        "algo": "ppo_bc",
        "env": "QuadStateRecovery-v0",
        "conf_file": "nominal/ppo_bc.yml",
        "settings": TINY,
        "pass_on": "last",
    },
]


def command(kind: str, folder: Path) -> list[str]:
    """Arguments of a training of a second or two, into ``folder``."""
    settings = folder / f"{kind}.yml"
    folder.mkdir(exist_ok=True)
    content = {"stages": STAGES} if kind == "pipeline" else {"QuadTargetTracking-v0": DAGGER if kind == "dagger" else TINY}
    settings.write_text(yaml.safe_dump(content))
    single = [] if kind == "pipeline" else ["--algo", kind, "--env", "QuadTargetTracking-v0"]
    more = ["--eval-freq", "2000", "--eval-episodes", "4", "--save-freq", "4000", "--snapshot-every", "0.2"]
    return ["train", *single, "--conf-file", str(settings), "-f", str(folder / "logs"), *more, "--no-progress"]


def forked(arguments: list[str], log: Path, folder: str | Path = ".", seconds: int = 0) -> int:
    """The process of a command that begins in ``folder``, reads nothing, and is ended after so many seconds, if any."""
    child = os.fork()
    if child > 0:
        return child
    with log.open("a") as stream, open(os.devnull) as nothing:
        for number, file in enumerate((nothing, stream, stream)):
            os.dup2(file.fileno(), number)
    os.chdir(folder)
    torch.set_num_threads(1)
    signal.alarm(seconds)
    code = 70
    try:
        code = main(arguments)
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def run(arguments: list[str], log: Path, kill_after: float | None = None) -> int | None:
    """The command's exit code; None if it was killed after so many seconds."""
    child = forked(arguments, log)
    end = np.inf if kill_after is None else time.monotonic() + kill_after
    while True:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status)
        if time.monotonic() >= end:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return None
        time.sleep(0.002)


def again(kind: str, folder: Path) -> list[str]:
    """What a user types after a kill: ``--resume``, or the same command if there is nothing to go on with yet."""
    if kind == "pipeline":
        begun = [path.parent for path in folder.glob("logs/pipeline/*/pipeline.yml")]
    else:
        begun = [path.parent.parent for path in folder.glob(f"logs/{kind}/*/*/args.yml")]
    return ["train", "--resume", str(begun[-1])] if begun else command(kind, folder)


def at_its_end(kind: str, folder: Path) -> bool:
    """Whether a single run's model is saved already, and only its table was cut short."""
    zips = [*folder.glob(f"logs/{kind}/*/Quad*.zip")]
    return kind != "pipeline" and bool(zips) and not (zips[0].parent / "resume.npz").exists()


def outcome(folder: Path) -> dict[str, object]:
    """What the trainings have left, by file: weights of agents, rows of evaluations and episodes, only names else.

    A run that was killed before its settings were written never began; what is half-written there is nobody's.
    """
    found: dict[str, object] = {}
    for path in sorted(folder.glob("logs/*/*/**/*")):
        if path.name.endswith(".tmp") and not (path.parent / "args.yml").exists():
            continue
        name = "/".join(part.rsplit("_", 1)[0] if part[-1].isdigit() else part for part in path.relative_to(folder).parts)
        if path.suffix == ".zip":
            found[name] = {key: each.tolist() for key, each in load_from_zip_file(path, device="cpu")[1]["policy"].items()}
        elif path.name.startswith("evaluations"):
            with np.load(path) as file:
                found[name] = [file[key].tolist() for key in ("timesteps", "results", "successes")]
        elif path.name == "0.monitor.csv":
            found[name] = [line.split(",")[:2] for line in path.read_text().splitlines()[1:]]
        elif path.is_file():
            found[name] = None
    return found


def campaign(folder: Path, kills: int, seed: int) -> int:
    """How many kills cost something."""
    for module, name, value in (
        (sb3_quad.cli.closing, "PIPELINE_EPISODES", 4),
        (sb3_quad.training.trim, "N_FLIGHTS", 4),
        (sb3_quad.training.trim, "N_HEADINGS", 4),
    ):
        assert hasattr(module, name)
        setattr(module, name, value)
    rng, done, failed, trial = random.Random(seed), 0, 0, 0
    whole: dict[str, dict[str, object]] = {}
    seconds: dict[str, float] = {}
    while done < kills:
        kind, trial = RUNS[trial % len(RUNS)], trial + 1
        if kind not in whole:
            place, start = folder / f"whole_{kind}", time.monotonic()
            assert run(command(kind, place), folder / "whole.txt") == 0, (folder / "whole.txt").read_text()
            seconds[kind], whole[kind] = time.monotonic() - start, outcome(place)
        place = folder / f"{trial}_{kind}"
        arguments, log, code = command(kind, place), folder / f"{trial}.txt", None
        for _ in range(rng.choice([1, 1, 2])):
            code = run(arguments, log, rng.uniform(0.0, seconds[kind]))
            if code is not None:
                break
            done += 1
            arguments = again(kind, place)
        if code is None:
            code = 0 if at_its_end(kind, place) else run(arguments, log)
        ours = outcome(place)
        differing = sorted(name for name in ours | whole[kind] if ours.get(name, 0) != whole[kind].get(name, 0))
        if code != 0 or differing:
            failed += 1
            print(f"{place.name}: exit code {code}, differing: {differing}; {log.read_text()[-600:]}")
    print(f"{done} kills, {failed} cost something")
    return failed


if __name__ == "__main__":
    target, count, *chosen = sys.argv[1:]
    Path(target).mkdir(parents=True, exist_ok=True)
    sys.exit(campaign(Path(target), int(count), int(chosen[0]) if chosen else 0) > 0)
