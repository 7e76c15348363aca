"""Kills commands at random moments, lets them resume, and compares what they leave with what
undisturbed ones leave.

    python tests/faults/campaign.py FOLDER KILLS [SEED]

Prints a line for each kill that cost something, and in the end how many there were. Exit code 1 if
any did. Commands run in forks of this process, which has imported everything and has no threads: a
kill may then hit their first millisecond.
"""

import itertools
import os
import random
import re
import signal
import sys
import time
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import yaml
from stable_baselines3.common.save_util import load_from_zip_file

import sb3_quad.cli.closing
import sb3_quad.evaluation.evaluate
import sb3_quad.evaluation.offset_correction
import sb3_quad.evaluation.report
import sb3_quad.training.snapshots
from sb3_quad.cli import main
from sb3_quad.envs import QuadcopterVecEnv

RUNS = ("dagger", "ppo_bc", "pipeline", "evaluate", "ppo")
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
SETTINGS = {"dagger": DAGGER}
# Where the next folder of a kind gets the next number.
NUMBERED = r"(Quad[A-Za-z]+-v0|pipeline)_\d+"
SUITE = """
name: one
scenarios:
  - {name: near, task_kwargs: {target_distance: 1}, duration: 2, n_episodes: 400}
  - {name: thrown, task: state_recovery, duration: 2, n_episodes: 400}
"""
STAGES = [
    {
        "name": "one",
        "algo": "dagger",
        "env": "QuadTargetTracking-v0",
        "conf_file": "nominal/dagger.yml",
        "settings": DAGGER,
        "correct_offset": 0.7,
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


def command(kind, folder):
    """Arguments of a command of a few seconds, into ``folder``."""
    logs, settings = folder / "logs", folder / f"{kind}.yml"
    folder.mkdir(exist_ok=True)
    if kind == "evaluate":
        settings.write_text(SUITE)
        given = f"evaluate pid geometric itm-recovery --suite {settings} -o {logs / kind / 'out'}"
        return given.split()
    small = {"QuadTargetTracking-v0": SETTINGS.get(kind, TINY)}
    settings.write_text(yaml.safe_dump({"stages": STAGES} if kind == "pipeline" else small))
    more = ["--conf-file", str(settings), "-f", str(logs), "--no-progress"]
    single = [] if kind == "pipeline" else ["--algo", kind, "--env", "QuadTargetTracking-v0"]
    often = "--eval-freq 1500 --eval-episodes 4 --save-freq 4000 --snapshot-every 0.2"
    return ["train", *single, *more, *often.split()]


def forked(arguments, log, folder=".", seconds=0):
    """The process of a command that begins in ``folder``, reads nothing, and is ended after so many
    seconds, if any.
    """
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


def run(arguments, log, kill_after=None):
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


def again(kind, folder):
    """What a user types after a kill: ``--resume``, or the same command if there is nothing to go
    on with yet.
    """
    begun = "pipeline/*/pipeline.yml" if kind == "pipeline" else f"{kind}/*/*/args.yml"
    found = sorted(folder.glob(f"logs/{begun}"))
    if not found:
        return command(kind, folder)
    place = found[-1].parent
    if kind != "pipeline":
        place = place.parent
    return ["train", "--resume", str(place)]


def never_began(path):
    """Whether a file is in a folder of a command that was killed before it had written its
    settings, or in that of a run before its pipeline had noted it; it is nobody's.
    """
    for folder in path.parents:
        if re.fullmatch(NUMBERED, folder.name):
            mark = "pipeline.yml" if folder.name.startswith("pipeline") else "0.monitor.csv"
            if not any(folder.glob(mark)):
                return True
    return False


def content(path):
    """Weights of an agent, all arrays and numbers but seconds and dates; None of other files."""
    if path.suffix == ".zip":
        weights = load_from_zip_file(path, device="cpu")[1]["policy"]
        return {key: each.tolist() for key, each in weights.items()}
    if path.suffix == ".npz":
        with np.load(path) as file:
            kept = [key for key in file.files if key != "seconds"]
            return {key: (file[key].dtype.str, file[key].tobytes()) for key in kept}
    if path.name == "0.monitor.csv":
        return [line.split(",")[:2] for line in path.read_text().splitlines()[1:]]
    if path.name == "results.json":
        return re.sub(r'"(seconds|date)": [^,}\n]+', "", path.read_text())
    return None


def outcome(folder):
    """What a command has left, by file."""
    found: dict[str, object] = {}
    for path in sorted(folder.glob("logs/*/*/**/*")):
        if path.is_file() and not never_began(path):
            name = re.sub(rf"(?<=/){NUMBERED}(?=/|$)", r"\1", str(path.relative_to(folder)))
            found[name] = content(path)
    return found


def prepare():
    """Make commands short: small closing tables, frequent snapshots, no offset correction.

    Agents that have hardly learnt crash on the way.
    """
    sb3_quad.cli.closing.FRESH_EPISODES = 4
    sb3_quad.cli.closing.PIPELINE_EPISODES = 4
    sb3_quad.training.snapshots.PAUSE = 0.1
    sb3_quad.evaluation.offset_correction.hover_offset = lambda *_, **__: np.zeros(3)
    QuadcopterVecEnv(1)  # loads what is compiled


class Undisturbed(NamedTuple):
    """A command that nobody has killed: how long it takes, and what it leaves."""

    seconds: float
    outcome: dict[str, object]


def undisturbed(kind, folder):
    place = folder / f"whole_{kind}"
    log = folder / f"whole_{kind}.txt"
    start = time.monotonic()
    assert run(command(kind, place), log) == 0, log.read_text()
    return Undisturbed(time.monotonic() - start, outcome(place))


def campaign(folder, kills, seed):
    """How many kills cost something."""
    prepare()
    rng = random.Random(seed)
    whole: dict[str, Undisturbed] = {}
    kills_of = Counter[str]()
    failed = 0
    for trial, kind in enumerate(itertools.cycle(RUNS)):
        if kills_of.total() >= kills:
            break
        if kind not in whole:
            whole[kind] = undisturbed(kind, folder)
        place = folder / f"{trial}_{kind}"
        log = folder / f"{trial}.txt"
        arguments = command(kind, place)
        code = None
        for _ in range(rng.choice([1, 1, 2])):
            code = run(arguments, log, rng.uniform(0.0, whole[kind].seconds))
            if code is not None:
                break
            kills_of[kind] += 1
            arguments = again(kind, place)
        if code is None:
            code = run(arguments, log)
        ours = outcome(place)
        theirs = whole[kind].outcome
        differing = sorted(
            name for name in ours | theirs if ours.get(name, 0) != theirs.get(name, 0)
        )
        if code != 0 or differing:
            failed += 1
            print(
                f"{place.name}: exit code {code}, differing: {differing}; {log.read_text()[-600:]}"
            )
    counts = ", ".join(f"{kind} {count}" for kind, count in kills_of.items())
    print(f"kills of {counts}; {failed} cost something")
    return failed


if __name__ == "__main__":
    target, count, *chosen = sys.argv[1:]
    Path(target).mkdir(parents=True, exist_ok=True)
    sys.exit(campaign(Path(target), int(count), int(chosen[0]) if chosen else 0) > 0)
