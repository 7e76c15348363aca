"""Train many seeds and settings, here or on a Ray cluster; compare all on the same fresh episodes.

examples:
  sb3-quad sweep my_sweep.yaml --dry-run                   lists the runs
  sb3-quad sweep my_sweep.yaml --workers 4                 four worker processes, one core each
  sb3-quad sweep pid                                       a sweep of the package, such as nominal or random_worlds
  sb3-quad sweep --seed 0 1 2 --conf-file two_stage.yml thesis.yml
  sb3-quad sweep --seed 0 1 2 --algo dagger --env QuadStateRecovery-v0 -n 240000 --suite quick
  sb3-quad sweep my_sweep.yaml --executor ray --address auto
  sb3-quad sweep --resume logs/sweep/my_sweep_1            goes on after Ctrl-C or a crash

A folder is left: run folders, results.csv, results.json, report.md and report.html. The file's
keys: docs/sweeps.md.
"""

import argparse
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sb3_quad.base.errors import ConfigError
from sb3_quad.cli.commands.train import DEFAULT_ALGO, DEFAULT_ENV, DEFAULT_PIPELINE
from sb3_quad.cli.parser import PAIRS, Parser, add_common, add_fields, given, positive, seed
from sb3_quad.controllers.pretrained import agent_path
from sb3_quad.training.options import JobOptions, RunOptions, SettingsOptions


def add_arguments(parser: Parser) -> None:
    add = parser.add_argument
    add(
        "sweep",
        nargs="?",
        metavar="SWEEP",
        help="YAML file, or a name; the flags below go before what it says",
    )
    add("--seed", nargs="+", type=seed, metavar="N", help="seeds of each configuration (0)")
    add(
        "-conf",
        "--conf-file",
        nargs="+",
        metavar="FILE",
        help="settings files, of single runs or pipelines (two_stage.yml)",
    )
    add("--algo", nargs="+", help="algorithms of single runs (dagger)")
    add("--env", help="environment id of single runs (QuadTargetTracking-v0)")
    add_fields(parser, SettingsOptions)
    add("-params", "--hyperparams", help="settings to change, such as n_steps:500", **PAIRS)
    add_fields(
        parser,
        JobOptions,
        *RunOptions.model_fields,
        "log_folder",
        trained_agent={"type": agent_path},
    )
    add(
        "--suite",
        metavar="SUITE",
        help="what the agents fly in the end (fresh episodes of both tasks, 240 each)",
    )
    add("--episodes", type=positive, metavar="N", help="episodes of each scenario in the end")
    add(
        "--gym-packages",
        nargs="+",
        metavar="MODULE",
        help="modules that register further environments",
    )
    add("--workers", type=positive, metavar="N", help="runs side by side (the cores)")
    add("--dry-run", action="store_true", help="list the runs, train nothing")
    add("--resume", metavar="FOLDER", help="go on with a sweep: what is not finished in its folder")
    add_common(parser, "executor", "trust", "progress")


def run(options: argparse.Namespace) -> int:
    """Train, compare, print where everything is. Returns the exit code."""
    from sb3_quad.base.imports import import_packages
    from sb3_quad.sweep.folder import Sweep, SweepFolder
    from sb3_quad.sweep.runs import make_runs, suite_of
    from sb3_quad.sweep.spec import SweepSpec

    if options.resume is not None:
        for name in given(options, "sweep", *SweepSpec.model_fields, "suite", "episodes"):
            raise ConfigError(
                f"--resume keeps the sweep's own settings; leave {name.replace('_', '-')} away"
            )
        place = SweepFolder(options.resume)
        return _go_on(options, place.read(), place)
    spec = _spec(options)
    import_packages(spec.gym_packages, "gym_packages:")
    sweep = Sweep(spec=spec, runs=tuple(make_runs(spec)), suite=suite_of(spec))
    if not options.dry_run:
        return _go_on(options, sweep, None)
    for each in sweep.runs:
        stages = (
            f"{stage.algo} on {stage.env}, {stage.settings['n_timesteps']} timesteps"
            for stage in each.stages
        )
        print(f"{each.name}: {', then '.join(stages)}")
    configurations = len({each.configuration for each in sweep.runs})
    print(f"{_count(len(sweep.runs), 'run')} of {_count(configurations, 'configuration')}")
    return 0


def _spec(options: argparse.Namespace) -> Any:
    """The :class:`~sb3_quad.sweep.spec.SweepSpec` of a command line: a file's, with the flags over
    it.
    """
    from sb3_quad.base.validate import validate
    from sb3_quad.sweep.spec import SweepSpec, load_sweep

    data: dict[str, Any] = {"name": "sweep"}
    if options.sweep is not None:
        data = load_sweep(options.sweep).model_dump(mode="json", exclude_defaults=True)
    flags = given(options, *SweepSpec.model_fields)
    for name in {"hyperparams", "env_kwargs"} & flags.keys():
        flags[name] = {**data.get(name, {}), **flags[name]}
    grid = {key: values for key, values in data.get("grid", {}).items() if key not in flags}
    for name in ("conf_file", "algo"):
        if isinstance(values := flags.get(name), list):
            data.pop(name, None)
            flags.pop(name)
            (grid if len(values) > 1 else flags)[name] = values if len(values) > 1 else values[0]
    evaluation = {**data.get("evaluation", {}), **given(options, "suite", "episodes")}
    return validate(
        SweepSpec,
        _with_defaults({**data, **flags, "grid": grid, "evaluation": evaluation}),
        options.sweep or "command line",
    )


def _with_defaults(data: Mapping[str, Any]) -> Mapping[str, Any]:
    """A sweep that trains, where nothing is said, what ``train`` does: its pipeline, or its
    algorithm in its environment.
    """
    from sb3_quad.training.pipeline import is_pipeline

    said = {**data, **data["grid"]}
    files = said.get("conf_file") or []
    if data.get("configurations") or any(
        is_pipeline(file) for file in ([files] if isinstance(files, str) else files)
    ):
        return data
    if not said.keys() & {"conf_file", "algo", "env"}:
        return {**data, "conf_file": DEFAULT_PIPELINE}
    return {"algo": DEFAULT_ALGO, "env": DEFAULT_ENV, **data}


def _go_on(options: argparse.Namespace, sweep: Any, place: Any) -> int:
    """Do what is left of a Sweep, in its SweepFolder (None: a new one). Returns the exit
    code.
    """
    from sb3_quad.base.cores import available_cpus
    from sb3_quad.base.files import locked
    from sb3_quad.base.signals import StopSignals
    from sb3_quad.cli.output import console, progress_bar
    from sb3_quad.executors import start_executor
    from sb3_quad.sweep.folder import SweepFolder
    from sb3_quad.sweep.results import summarize, tables, write_report, write_results
    from sb3_quad.sweep.run import execute
    from sb3_quad.training.runs import claim_folder

    start, needs = time.perf_counter(), sweep.spec.resources
    workers = min(options.workers or available_cpus(), len(sweep.runs))
    with start_executor(
        options.executor, workers, options.address, needs.num_cpus, needs.num_gpus
    ) as executor:
        if place is None:
            place = SweepFolder(
                claim_folder(
                    Path(options.log_folder or "logs") / "sweep", sweep.spec.name or "sweep"
                )
            )
            place.write(sweep)
        where = f"{executor.workers} side by side, executor {options.executor}"
        print(f"sweep {place.path}: {_count(len(sweep.runs), 'run')}, {where}")
        with (
            locked(place.path, "sweep folder"),
            StopSignals() as signals,
            progress_bar(options.progress) as show,
        ):
            records = execute(place, sweep, executor, signals, show, print)
            signals.hold()
            found = summarize(sweep, records)
            write_results(place, found)
            if found.groups:
                shown = tables(found)
                for table in (table for each in shown.values() for table in each):
                    console().print(table)
                write_report(place, found, shown)
    failures = [record for record in records.values() if record.state == "failed"]
    finished = (
        f"{found.finished} of {_count(len(sweep.runs), 'run')} finished, {len(failures)} failed"
    )
    print(f"{finished}; {time.perf_counter() - start:.1f} s")
    print(
        f"saved in {place.path}: results.csv, results.json, runs/"
        + (", report.md, report.html" if found.groups else "")
    )
    for record in failures:
        print(f"failed: {record.name}: {record.message}", file=sys.stderr)
    if signals.received is not None:
        print(f"to go on: --resume {place.path}")
        return signals.exit_code
    return 1 if failures else 0


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" + ("" if number == 1 else "s")
