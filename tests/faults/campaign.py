"""Kills commands at random moments, lets them resume, and compares what they leave with what
undisturbed ones leave.

    python tests/faults/campaign.py FOLDER KILLS [SEED]

Prints a line for each kill that cost something, and in the end how many there were. Exit code 1 if
any did. Commands run in forks of this process, which has imported everything and has no threads: a
kill may then hit their first millisecond.
"""

import csv
import os
import random
import re
import signal
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np
import torch
import yaml
from stable_baselines3.common.save_util import load_from_zip_file

import sb3_quad.cli.closing
import sb3_quad.evaluation.evaluate
import sb3_quad.evaluation.offset_correction
import sb3_quad.evaluation.report
import sb3_quad.training.snapshots
import sb3_quad.training.tune
from sb3_quad.cli import main
from sb3_quad.envs import QuadcopterVecEnv

RUNS = ("dagger", "ppo_bc", "pipeline", "evaluate", "tune", "ppo", "sac")
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
OFF_POLICY = {
    **{key: TINY[key] for key in ("n_envs", "env_kwargs", "policy_kwargs")},
    "n_timesteps": 4000,
    "learning_starts": 400,
    "train_freq": 5,
    "buffer_size": 2000,
    "batch_size": 64,
}
SETTINGS = {
    "dagger": DAGGER,
    "tune": {**DAGGER, "n_timesteps": 4000},
    "sac": OFF_POLICY,
}
# What a folder has that somebody resumes from; a run has */args.yml.
MARKS = {"pipeline": "pipeline.yml"}
NUMBERED = r"(Quad[A-Za-z]+-v0|pipeline)_\d+"
SUITE = """
name: one
scenarios:
  - {name: near, task_kwargs: {target_distance: 1}, duration: 2, n_episodes: 400}
  - name: thrown
    task: state_recovery
    duration: 2
    n_episodes: 400
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


def command(kind: str, folder: Path) -> list[str]:
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
    if kind == "tune":
        space = folder / "space.yml"
        space.write_text("learning_rate: {low: 1.0e-4, high: 1.0e-2, log: true}\n")
        more += f"--search-space {space} --storage {folder / 'study.log'} --n-trials 3".split()
        return ["tune", "--algo", "dagger", *more, "--eval-episodes", "4", "--n-evaluations", "2"]
    single = [] if kind == "pipeline" else ["--algo", kind, "--env", "QuadTargetTracking-v0"]
    often = "--eval-freq 1500 --eval-episodes 4 --save-freq 4000 --snapshot-every 0.2"
    return ["train", *single, *more, *often.split()]


def forked(arguments: list[str], log: Path, folder: str | Path = ".", seconds: int = 0) -> int:
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
    """What a user types after a kill: ``--resume``, or the same command if there is nothing to go
    on with yet.
    """
    begun = {"pipeline": "pipeline/*/pipeline.yml"}.get(kind, f"{kind}/*/*/args.yml")
    found = sorted(folder.glob(f"logs/{begun}"))
    if not found:
        return command(kind, folder)
    place = found[-1].parent if kind == "pipeline" else found[-1].parent.parent
    return ["train", "--resume", str(place)]


def never_began(path: Path) -> bool:
    """Whether a file is in a folder of a command that was killed before it had written its
    settings, or in that of a run before its pipeline had noted it; it is nobody's.
    """
    folders = [each for each in path.parents if re.fullmatch(NUMBERED, each.name)]
    return not all(
        any(each.glob(MARKS.get(each.name.rpartition("_")[0], "0.monitor.csv"))) for each in folders
    )


def outcome(folder: Path) -> dict[str, object]:
    """What a command has left, by file: weights of agents, all arrays and numbers but seconds and
    dates; only names else.

    Of a search: settings and values of its trials that were finished, in their order.
    """
    found: dict[str, object] = {}
    tables = sorted(
        folder.glob("logs/tune/*/*/trials.csv"), key=lambda path: path.stat().st_mtime_ns
    )
    if tables:  # the runs of killed trials are there beside those that were tried again
        rows = csv.DictReader(tables[-1].read_text().splitlines())
        return {
            "trials": [
                (row["params_learning_rate"], row["value"])
                for row in rows
                if row["state"] == "COMPLETE"
            ]
        }
    for path in sorted(folder.glob("logs/*/*/**/*")):
        if never_began(path):
            continue
        name = re.sub(rf"(?<=/){NUMBERED}(?=/|$)", r"\1", str(path.relative_to(folder)))
        if path.suffix == ".zip":
            found[name] = {
                key: each.tolist()
                for key, each in load_from_zip_file(path, device="cpu")[1]["policy"].items()
            }
        elif path.suffix == ".npz":
            with np.load(path) as file:
                found[name] = {
                    key: (file[key].dtype.str, file[key].tobytes())
                    for key in file.files
                    if key != "seconds"
                }
        elif path.name in ("0.monitor.csv", "episodes.csv"):
            timed = path.name == "0.monitor.csv"
            found[name] = [
                line.split(",")[: 2 if timed else None]
                for line in path.read_text().splitlines()[timed:]
            ]
        elif path.name == "results.json":
            found[name] = re.sub(r'"(seconds|date)": [^,}\n]+', "", path.read_text())
        elif path.is_file():
            found[name] = None
    return found


def campaign(folder: Path, kills: int, seed: int) -> int:
    """How many kills cost something."""
    for module, name, value in (
        (sb3_quad.cli.closing, "FRESH_EPISODES", 4),
        (sb3_quad.cli.closing, "PIPELINE_EPISODES", 4),
        (sb3_quad.training.snapshots, "PAUSE", 0.1),
        # Agents that have hardly learnt crash on the way.
        (sb3_quad.evaluation.offset_correction, "hover_offset", lambda *_, **__: np.zeros(3)),
    ):
        assert hasattr(module, name)
        setattr(module, name, value)
    QuadcopterVecEnv(1)  # loads what is compiled
    rng, done, failed, trial = random.Random(seed), 0, 0, 0
    kills_of = Counter[str]()
    whole: dict[str, dict[str, object]] = {}
    seconds: dict[str, float] = {}
    while done < kills:
        kind, trial = RUNS[trial % len(RUNS)], trial + 1
        if kind not in whole:
            place, start = folder / f"whole_{kind}", time.monotonic()
            assert run(command(kind, place), folder / "whole.txt") == 0, (
                folder / "whole.txt"
            ).read_text()
            seconds[kind], whole[kind] = time.monotonic() - start, outcome(place)
        place = folder / f"{trial}_{kind}"
        arguments, log, code = command(kind, place), folder / f"{trial}.txt", None
        for _ in range(rng.choice([1, 1, 2])):
            start = time.monotonic()
            code = run(arguments, log, rng.uniform(0.0, seconds[kind]))
            if code is not None:  # it was faster than the undisturbed one
                seconds[kind] = min(seconds[kind], time.monotonic() - start)
                break
            done += 1
            kills_of[kind] += 1
            arguments = again(kind, place)
        if code is None:
            code = run(arguments, log)
        ours = outcome(place)
        differing = sorted(
            name for name in ours | whole[kind] if ours.get(name, 0) != whole[kind].get(name, 0)
        )
        if code != 0 or differing:
            failed += 1
            print(
                f"{place.name}: exit code {code}, differing: {differing}; {log.read_text()[-600:]}"
            )
    counts = ", ".join(f"{kind} {count}" for kind, count in kills_of.items())
    print(f"{done} kills of {counts}; {failed} cost something")
    return failed


if __name__ == "__main__":
    target, count, *chosen = sys.argv[1:]
    Path(target).mkdir(parents=True, exist_ok=True)
    sys.exit(campaign(Path(target), int(count), int(chosen[0]) if chosen else 0) > 0)
