r"""Train many seeds and settings, and compare all agents on the same episodes.

Runs are trained in worker processes here, or on a Ray cluster.

examples:
  # list the runs of your sweep, then train them in four worker processes
  sb3-quad sweep my_sweep.yaml --dry-run
  sb3-quad sweep my_sweep.yaml --workers 4
  # a sweep of the package, such as pid or nominal
  sb3-quad sweep pid
  # a sweep without a file
  sb3-quad sweep --seed 0 1 2 --conf-file two_stage.yml thesis.yml
  sb3-quad sweep --seed 0 1 2 --algo dagger --env QuadStateRecovery-v0 \
    -n 240000 --suite quick
  # on a Ray cluster
  sb3-quad sweep my_sweep.yaml --executor ray --address auto
  # continue after Ctrl-C or a crash
  sb3-quad sweep --resume logs/sweep/my_sweep_1

The new folder receives the run folders, results.csv, results.json and
report.md. For the keys of the file, see docs/sweeps.md.
"""

import shlex
import sys
from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sb3_quad.base.types import StrDict
from sb3_quad.cli.parser import (
    EXECUTOR,
    PAIRS,
    PROGRESS,
    SEVERAL,
    SWITCH,
    TRUST,
    Flags,
    field_flags,
    given,
    positive,
    refuse_with_resume,
    seed,
)
from sb3_quad.training.options import JobOptions, RunOptions, SettingsOptions

# The keys of flags that have other names. Those with several values make a grid.
PLACES = {
    "algo": "grid.algo",
    "conf_file": "grid.conf_file",
    "suite": "evaluation.suite",
    "episodes": "evaluation.episodes",
}
FLAGS: Flags = {
    "sweep SWEEP": (
        {"nargs": "?"},
        "YAML file, or the name of a sweep of the package; the flags below override its keys",
    ),
    "--seed N": ({"nargs": "+", "type": seed}, "seeds of each configuration (0)"),
    "-conf --conf-file FILE": (
        SEVERAL,
        "settings files, of single runs or pipelines (two_stage.yml)",
    ),
    "--algo": (SEVERAL, "algorithms of single runs (dagger)"),
    "--env": "environment id of single runs (QuadTargetTracking-v0)",
    "-params --hyperparams": (PAIRS, "settings to change, such as n_steps:500"),
    "--suite": "suite for the comparison (240 fresh episodes of each task)",
    "--episodes N": (positive, "episodes of each scenario in the comparison"),
    "--gym-packages MODULE": (SEVERAL, "modules that register further environments"),
    "--workers N": (positive, "number of parallel runs (one per core)"),
    "--dry-run": (SWITCH, "list the runs and train nothing"),
    "--resume FOLDER": "continue the sweep in its folder",
    **EXECUTOR,
    **TRUST,
    **PROGRESS,
    **field_flags(SettingsOptions),
    **field_flags(JobOptions, *RunOptions.model_fields, "log_folder"),
}


def run(options: Namespace) -> int:
    """Train and compare, or list the runs. Returns the exit code."""
    from sb3_quad.base.imports import import_packages
    from sb3_quad.sweep.folder import Sweep, read_sweep
    from sb3_quad.sweep.runs import make_runs, suite_of
    from sb3_quad.sweep.spec import SweepSpec

    folder = None
    if options.resume is not None:
        refuse_with_resume(
            options, "sweep", *SweepSpec.model_fields, "suite", "episodes", "log_folder"
        )
        folder = Path(options.resume)
        sweep = read_sweep(folder)
    else:
        spec = _spec(options)
        import_packages(spec.gym_packages, "gym_packages:")
        sweep = Sweep(spec=spec, runs=make_runs(spec), suite=suite_of(spec))
    if not options.dry_run:
        return _execute(options, sweep, folder)
    for planned in sweep.runs:
        stages = [
            f"{stage.algo} on {stage.env}, {stage.settings['n_timesteps']} timesteps"
            for stage in planned.stages
        ]
        print(f"{planned.name}: {', then '.join(stages)}")
    print(_count(sweep.runs))
    return 0


def _spec(options: Namespace) -> Any:
    """Return the :class:`~sb3_quad.sweep.spec.SweepSpec` of a command line.

    Flags replace the keys of the file.

    :raises ConfigError: a flag whose key differs between the configurations of the file.
    """
    from sb3_quad.base.errors import ConfigError
    from sb3_quad.base.literals import put_key
    from sb3_quad.base.validate import validate
    from sb3_quad.sweep.spec import SweepSpec, load_sweep
    from sb3_quad.training.algorithms import as_list

    data: StrDict = {"name": "sweep"}
    if options.sweep is not None:
        data = load_sweep(options.sweep).model_dump(mode="json", exclude_defaults=True)
    # The entries of mappings as a grid has them, such as env_kwargs.noise.
    varied = set()
    cells = [
        {key: value} for key, values in data.get("grid", {}).items() for value in as_list(values)
    ]
    for configuration in [*data.get("configurations", ()), *cells]:
        for key, value in configuration.items():
            inner = [f"{key}.{name}" for name in value] if isinstance(value, dict) else [key]
            varied.update(inner)
    for name, value in given(options, *SweepSpec.model_fields, "suite", "episodes").items():
        place = PLACES.get(name, name)
        # A flag takes the place of a key of the grid, and its pairs are added to those of the file.
        if isinstance(value, dict):
            given_keys = {f"{name}.{key}" for key in value}
            value = data.get(name, {}) | value
        else:
            given_keys = {name}
            if data.get("grid", {}).pop(name, None):
                varied.discard(name)
        for key in sorted(given_keys & varied):
            raise ConfigError(
                f"{key} differs between the runs of {options.sweep}; remove the flag that gives it"
            )
        put_key(data, place, value, name)
    return validate(SweepSpec, data, options.sweep or "command line")


def _execute(options: Namespace, sweep: Any, folder: Path | None) -> int:
    """Do what is left of a sweep. Returns the exit code.

    :param sweep: The :class:`~sb3_quad.sweep.folder.Sweep`.
    :param folder: Its folder, None for a new one.
    """
    from sb3_quad.base.files import locked
    from sb3_quad.base.process import StopSignals, available_cpus
    from sb3_quad.cli.output import console, progress_bar
    from sb3_quad.executors import start_executor
    from sb3_quad.sweep.folder import write_sweep
    from sb3_quad.sweep.results import write_results
    from sb3_quad.sweep.run import execute
    from sb3_quad.training.runs import claim_folder

    with start_executor(
        options.executor,
        options.workers or available_cpus(),
        options.address,
        **dict(sweep.spec.resources),
    ) as executor:
        # A new folder only once it is known that the executor starts.
        if folder is None:
            folder = claim_folder(
                Path(options.log_folder or "logs") / "sweep", sweep.spec.name or "sweep"
            )
            write_sweep(folder, sweep)
        print(f"sweep {folder}: {_count(sweep.runs)}")
        with (
            locked(folder, "sweep folder"),
            StopSignals() as signals,
            progress_bar(options.progress) as show,
        ):
            ended = execute(folder, sweep, executor, signals, show, print)
            # Nothing interrupts the results.
            signals.hold()
            results, tables = write_results(folder, sweep, ended)
            for table in tables:
                console().print(table)
    print(
        f"{results.finished} of {results.runs} runs finished, {len(results.failed)} failed; "
        f"saved in {folder}"
    )
    for name, message in results.failed.items():
        print(f"failed: {name}: {message}", file=sys.stderr)
    if signals.received:
        print("to continue: --resume", shlex.quote(str(folder)))
        return signals.exit_code
    return int(bool(results.failed))


def _count(runs: Sequence[Any]) -> str:
    return "1 run" if len(runs) == 1 else f"{len(runs)} runs"
