"""``sweep``: many trainings, compared on the same fresh episodes."""

import argparse
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sb3_quad.base.cores import available_cpus
from sb3_quad.base.errors import ConfigError, MissingExtra
from sb3_quad.base.files import locked
from sb3_quad.base.imports import import_packages
from sb3_quad.base.signals import StopSignals
from sb3_quad.base.validate import validate
from sb3_quad.cli.arguments.train import DEFAULT_ALGO, DEFAULT_ENV, DEFAULT_PIPELINE
from sb3_quad.cli.output import console, progress_bar
from sb3_quad.cli.parser import given
from sb3_quad.executors import start_executor
from sb3_quad.sweep.drive import execute
from sb3_quad.sweep.expand import expand, suite_of
from sb3_quad.sweep.folder import Plan, SweepFolder
from sb3_quad.sweep.page import write_report
from sb3_quad.sweep.records import RunRecord
from sb3_quad.sweep.results import Found, evaluate, tables, write_results
from sb3_quad.sweep.spec import SweepSpec, load_sweep
from sb3_quad.training.pipeline import is_pipeline
from sb3_quad.training.runs import claim_folder

KEPT_BY_RESUME = (
    *("sweep", "seed", "conf_file", "algo", "env", "n_timesteps", "hyperparams", "env_kwargs", "eval_freq", "eval_episodes"),
    *("suite", "episodes", "storage"),
)
LISTS = ("conf_file", "algo")  # flags that take several values: a grid, where they do


def run(options: argparse.Namespace) -> int:
    """Train, compare, tell where everything is. Returns the exit code."""
    if options.resume is not None:
        for name in given(options, *KEPT_BY_RESUME):
            raise ConfigError(f"--resume keeps the sweep's own settings; leave --{name.replace('_', '-')} away")
        place = SweepFolder(options.resume)
        return run_sweep(options, place.read(), place)
    return run_spec(options, spec_of(options))


def run_spec(options: argparse.Namespace, spec: SweepSpec) -> int:
    """A new sweep, or with ``--dry-run`` the list of its runs. Returns the exit code."""
    import_packages(spec.gym_packages, "gym_packages:")
    plan = Plan(spec=spec, runs=tuple(expand(spec)), suite=suite_of(spec))
    if options.dry_run:
        for each in plan.runs:
            print(f"{each.name}: {_what(each)}")
        print(f"{_count(len(plan.runs), 'run')} of {_count(len(plan.configurations), 'configuration')}")
        return 0
    return run_sweep(options, plan, None)


def run_sweep(options: argparse.Namespace, plan: Plan, place: SweepFolder | None) -> int:
    """Do what is left of a sweep. Returns the exit code.

    :param place: its folder; None: a new one.
    """
    start = time.perf_counter()
    needs, workers = plan.spec.resources, options.workers or available_cpus()
    workers = min(workers, len(plan.runs))
    with start_executor(options.executor, workers, options.address, needs.num_cpus, needs.num_gpus) as executor:
        if place is None:
            name = plan.spec.name or "sweep"
            place = SweepFolder(claim_folder(Path(options.log_folder) / "sweep", name))
            place.write(plan)
        where = f"{executor.workers} side by side, executor {options.executor}"
        print(f"sweep {place.path}: {_count(len(plan.runs), 'run')}, {where}")
        with locked(place.path, "sweep folder"), StopSignals() as signals, progress_bar(options.progress) as show:
            records = execute(place, plan, executor, signals, show, print)
            signals.hold()
            executor.close()
            found = evaluate(plan, records)
            write_results(place, plan, records, found)
            code = _finish(place, plan, records, found, time.perf_counter() - start)
    if signals.received is not None:
        print(f"to go on: --resume {place.path}")
        return signals.exit_code
    return code


def spec_of(options: argparse.Namespace) -> SweepSpec:
    """The sweep that a command line describes: a file's, with the flags over it.

    :raises ConfigError: see :func:`~sb3_quad.sweep.spec.load_sweep`.
    """
    data: dict[str, Any] = {}
    if options.sweep is not None:
        data = load_sweep(options.sweep).model_dump(mode="json", exclude_defaults=True)
    flags = given(options, "seed", "env", "n_timesteps", "eval_freq", "eval_episodes", "storage")
    for name in ("hyperparams", "env_kwargs"):
        if getattr(options, name) is not None:
            flags[name] = {**data.get(name, {}), **getattr(options, name)}
    grid = {key: value for key, value in data.get("grid", {}).items() if key not in flags}
    for name in LISTS:
        values = getattr(options, name)
        if values is not None:
            grid.pop(name, None)
            data.pop(name, None)
            if len(values) > 1:
                grid[name] = values
            else:
                flags[name] = values[0]
    evaluation = {**data.get("evaluation", {}), **given(options, "suite", "episodes")}
    whole = {**data, **flags, "grid": grid, "evaluation": evaluation}
    return validate(SweepSpec, with_defaults(whole), options.sweep or "command line")


def with_defaults(data: Mapping[str, Any]) -> dict[str, Any]:
    """What ``train`` trains where nothing is said: its pipeline, or its algorithm in its environment."""
    whole, grid = {"name": "sweep", **data}, data.get("grid", {})
    if whole.get("configurations"):
        return whole
    files = grid.get("conf_file", [whole["conf_file"]] if whole.get("conf_file") else [])
    if not files and not any(key in whole or key in grid for key in ("algo", "env")):
        return {**whole, "conf_file": DEFAULT_PIPELINE}
    if isinstance(files, list) and not any(is_pipeline(file) for file in files):
        missing = {"algo": DEFAULT_ALGO, "env": DEFAULT_ENV}
        whole |= {key: value for key, value in missing.items() if key not in whole and key not in grid}
    return whole


def _finish(place: SweepFolder, plan: Plan, records: Mapping[str, RunRecord], found: Found, seconds: float) -> int:
    """Print the tables, write the report, tell what failed. Returns the exit code."""
    if found.groups:
        shown = tables(found)
        for table in (table for each in shown.values() for table in each):
            console().print(table)
        try:
            write_report(place, plan, records, found, shown)
        except MissingExtra as error:
            print(f"{error}; report.md and figures/ are there without it", file=sys.stderr)
    failures = [record for record in records.values() if record.state == "failed"]
    print(f"{found.n_finished} of {_count(len(plan.runs), 'run')} finished, {len(failures)} failed; {seconds:.1f} s")
    print(f"saved in {place.path}: results.csv, results.json, runs/" + (", report.md, report.html" if found.groups else ""))
    for record in failures:
        print(f"failed: {record.name}: {record.message}", file=sys.stderr)
    return 1 if failures else 0


def _what(each: Any) -> str:
    if each.pipeline is not None:
        return f"pipeline {each.stem}: " + ", ".join(f"{stage.algo} on {stage.env}" for stage in each.pipeline.stages)
    return f"{each.algo} on {each.env}, {each.settings['n_timesteps']:,} timesteps"


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" + ("" if number == 1 else "s")
