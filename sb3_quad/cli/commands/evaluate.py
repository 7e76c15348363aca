"""``evaluate``: any number of controllers through a suite of scenarios, side by side on the same episodes."""

import argparse
import sys
import time

from sb3_quad.base.errors import MissingExtra
from sb3_quad.cli.arguments.evaluate import DEFAULT_FOLDER
from sb3_quad.cli.commands.report import report
from sb3_quad.cli.output import console, progress_bar
from sb3_quad.evaluation.controllers import parse_controllers
from sb3_quad.evaluation.evaluate import evaluate
from sb3_quad.evaluation.metric_tables import overview
from sb3_quad.evaluation.scenarios.load import load_suite


def run(options: argparse.Namespace) -> int:
    """Fly, print the table, tell where everything is. Returns the exit code."""
    suite = load_suite(options.suite).with_changes(options.scenario, options.episodes, options.seed, options.vehicle)
    controllers = parse_controllers(options.controllers, options.scaling)
    folder = options.output or f"{DEFAULT_FOLDER}/{suite.name}"
    start = time.perf_counter()
    with progress_bar(options.progress) as show:
        show(0, None, "loading")
        how = options.backend, options.workers, options.overwrite
        results = evaluate(suite, controllers, folder, *how, show, _warn, options.executor, options.address)
    flown = results.model_copy(update={"scenarios": list(suite.scenarios)})
    labels = [spec.label for spec in controllers if any(entry.controller == spec.label for entry in results.entries)]
    if labels:
        console().print(overview(flown, labels))
    if results.entries:
        print(f"{time.perf_counter() - start:.1f} s; results in {folder}: results.json, episodes.csv, flights/")
    if options.report and results.entries:
        try:
            report(folder, overwrite=True, pictures=True)
        except MissingExtra as error:
            print(f"{error}; report.md and figures/ are there without it", file=sys.stderr)
    asked = {spec.label for spec in controllers}
    failures = [failure for failure in results.failures if failure.controller in asked]
    for failure in failures:
        where = "" if failure.scenario is None else f", scenario {failure.scenario}"
        print(f"failed: {failure.controller}{where}: {failure.message}", file=sys.stderr)
    return 1 if failures else 0


def _warn(line: str) -> None:
    print(f"warning: {line}", file=sys.stderr)
