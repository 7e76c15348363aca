"""Gives every option of every command, and every key of every file, values that nobody should give.

    python tests/faults/inputs.py FOLDER COUNT [SEED]

Of all cases ``COUNT`` are tried, drawn by the seed; ``all`` tries all. A case must end within
``SECONDS`` with an exit code of 0, 1 or 2, without a traceback, without a message that no check
foresaw, within ``MEMORY``, and must write nothing outside its folder nor run what it is given.
Prints a line for each case that does not. Exit code 1 if any did.
"""

import argparse
import os
import random
import resource
import shutil
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml
from campaign import forked

import sb3_quad.cli.closing
from sb3_quad.algorithms.dagger import DAgger
from sb3_quad.cli.app import make_parser
from sb3_quad.envs.simulation.tasks import Task
from sb3_quad.envs.vehicles.vehicle import Vehicle, load_vehicle
from sb3_quad.evaluation.scenarios.scenario import Scenario
from sb3_quad.training.algorithms import constructor_parameters
from sb3_quad.training.config import TrainingConfig

SECONDS, MEMORY = 60.0, 3 * 2**30  # bytes; the imports take half a GB
OUTSIDE = "../escaped"
TEXTS = [  # as arguments; values that are only large are those of the corpus
    *("", " ", "-1", "0", "nan", "inf", "1e400", "1e-400", "0x10", "1,2", "a:b", "a:b:c", "[["),
    *("{a: b}", "(1, 2)", "lin_x", ".", "no/such/file", "x" * 5000, "\udcff", "ü<b>", "None"),
    *("os.system", "os:system", "-", "--", "a=b=c", "__import__('os').system('touch escaped')"),
    "!!python/object/apply:os.system ['touch escaped']",
]
VALUES: list[Any] = [  # in YAML
    *(None, True, "", "x", "nan", -1, 0, 0.5, float("nan"), float("inf"), 10**30, [], [[]], [None]),
    *({}, {"a": "b"}, {1: 2}, "os.system", {"os.system": {}}, "lin_x", "../escaped"),
    *("x" * 5000, "\x00", [1, 2], [1, 2, 3], ["a"] * 4, [float("nan")] * 3, {"name": {"name": {}}}),
    "__import__('os').system('touch escaped')",
]
SUITE = {
    "name": "one",
    "scenarios": [{"name": "near", "target": {"distance": 1.0}, "duration": 2.0, "episodes": 2}],
}
ENV = "QuadTargetTracking-v0"
SETTINGS: dict[str, Any] = {"n_timesteps": 20, "n_envs": 2, "n_steps": 10, "batch_size": 20}
SETTINGS |= {"policy_kwargs": {"net_arch": [4]}}
BASES = {
    "check-vehicle": "itm -n 1",
    "demo": "pid",
    "enjoy": "pid --no-render -n 3",
    "evaluate": "pid --suite suite.yaml --no-report",
    "export": "itm-recovery --format onnx",
    "report": "no_results",
    "train": "--algo dagger --conf-file settings.yml --eval-episodes 0 --no-progress -f logs",
}
Case = tuple[str, list[str], dict[str, str]]  # what it is, a command, files


def arguments() -> Iterator[Case]:
    """Every option of every command, with every text."""
    files = {"settings.yml": _yaml({ENV: SETTINGS}), "suite.yaml": _yaml(SUITE)}
    subparsers: Any = next(
        each for each in make_parser()._actions if isinstance(each, argparse._SubParsersAction)
    )
    for command in sorted(BASES.keys() & subparsers.choices.keys()):
        base = BASES[command].split()
        for action in subparsers.choices[command]._actions:
            if action.nargs == 0 or isinstance(action, argparse.BooleanOptionalAction):
                continue
            is_path = action.metavar in ("FILE", "FOLDER", "DIR", "PATH", "WHERE", "AGENT")
            for text in TEXTS if is_path else [*TEXTS, OUTSIDE]:
                given = [text, *base[1:]]
                if action.option_strings:
                    given = [*base, action.option_strings[-1], text]
                yield f"{command} {action.dest}", [command, *given], files


def keys() -> Iterator[Case]:
    """Every key of every kind of file, with every value."""
    train = ["train", *BASES["train"].split()]
    settings = {*TrainingConfig.model_fields, *constructor_parameters(DAgger)}
    settings -= {"algo", "env_id", "settings", "hyperparams"}
    itm = load_vehicle("itm").model_dump(mode="json", exclude_none=True)
    for value in VALUES:
        for key in sorted(settings):
            yield key, train, {"settings.yml": _yaml({ENV: {**SETTINGS, key: value}})}
        for key in Task.model_fields:
            changed = {**SETTINGS, "env_kwargs": {"task_kwargs": {key: value}}}
            yield f"task {key}", train, {"settings.yml": _yaml({ENV: changed})}
        for key in Vehicle.model_fields:
            command = ["check-vehicle", "v.yaml", "-n", "1"]
            yield f"vehicle {key}", command, {"v.yaml": _yaml({**itm, key: value})}
        for key in Scenario.model_fields:
            suite = {"name": "one", "scenarios": [{**SUITE["scenarios"][0], key: value}]}
            command = ["evaluate", *BASES["evaluate"].split()]
            yield f"scenario {key}", command, {"suite.yaml": _yaml(suite)}


def _yaml(content: Any) -> str:
    return str(yaml.safe_dump(content, allow_unicode=True, width=10**6))


def attempt(case: Case, folder: Path) -> str:
    """What is wrong with how the case ends; empty if nothing is."""
    what, command, files = case
    place = folder / "place"
    shutil.rmtree(folder, ignore_errors=True)
    place.mkdir(parents=True)
    for name, text in files.items():
        (place / name).write_text(text, encoding="utf-8", errors="surrogateescape")
    start, log = time.monotonic(), folder / "log.txt"
    _, status, usage = os.wait4(forked(command, log, place, int(SECONDS)), 0)
    code, text = os.waitstatus_to_exitcode(status), log.read_text(errors="replace")
    last = text.splitlines()[-1] if text else ""
    strange = {
        f"exit code {code}": code not in (0, 1, 2),
        "no line says why": code == 2 and not last.startswith("error: "),
        "a traceback": "Traceback (most recent call last)" in text,
        "unforeseen": "add --traceback" in text,
        f"{usage.ru_maxrss / 2**20:.1f} GB": usage.ru_maxrss * 1024 > MEMORY,
        f"{time.monotonic() - start:.0f} s": time.monotonic() - start > SECONDS,
        "something outside": len(list(folder.iterdir())) > 2,
        "foreign code": (place / "escaped").exists(),
    }
    wrong = ", ".join(name for name, is_so in strange.items() if is_so)
    return wrong and f"{what}: {wrong}: {command} {last[-300:]}"


def campaign(folder: Path, count: int | None, seed: int) -> int:
    """How many cases end as none should."""
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    chosen = [*arguments(), *keys()]
    if count is not None:
        chosen = random.Random(seed).sample(chosen, count)
    failed = 0
    for number, case in enumerate(chosen):
        wrong = attempt(case, folder / f"case_{seed}")
        failed += bool(wrong)
        if wrong:
            print(f"{number}: {wrong}", flush=True)
    print(f"{len(chosen)} inputs, {failed} ended as none should")
    return failed


if __name__ == "__main__":
    target, asked, *more = sys.argv[1:]
    sb3_quad.cli.closing.FRESH_EPISODES = sb3_quad.cli.closing.PIPELINE_EPISODES = 2
    sys.exit(
        campaign(Path(target), None if asked == "all" else int(asked), int(more[0]) if more else 0)
        > 0
    )
