"""Fly controllers through scenarios, side by side on the same episodes; tables, results.json and
episodes.csv.

controllers:
  pid, geometric          the experts
  path/to/agent.zip       an agent of any Stable-Baselines3 algorithm, or the run folder of one
  package.module:factory  a function that takes the vehicle and returns a controller
  name=…                  any of these, under that name in the tables

examples:
  sb3-quad evaluate pid geometric                              the thesis's chapter 4 for both experts
  sb3-quad evaluate pid "agent=logs/ppo_bc/QuadStateRecovery-v0_1/corrected_model.zip" --suite thesis -o evaluations/mine
  sb3-quad evaluate pid agent.zip --suite quick                a quick look, in less than a minute
  sb3-quad evaluate agent.zip --suite robustness --workers 2
  sb3-quad evaluate agent.zip --suite robustness --executor ray --address auto
  sb3-quad evaluate pid my_package.control:make --suite my_scenarios.yaml
  sb3-quad evaluate pid agent.zip --reward my_package.rewards:calm   the mean of your own reward, too
  sb3-quad evaluate pid --suite quick --backend pybullet       the same episodes on PyBullet
  sb3-quad evaluate pid geometric agent.zip --scenario tracking recovery --vehicle crazyflie -o evaluations/crazyflie

A folder holds the results of one command: give all controllers at once. The same command resumes
where it was interrupted.
"""

import argparse
import sys
import time

from sb3_quad.cli.parser import YES_OR_NO, Parser, add_common, whole

DEFAULT_FOLDER = "evaluations"


def add_arguments(parser: Parser) -> None:
    add = parser.add_argument
    add("controllers", nargs="+", metavar="CONTROLLER", help="who flies, see below")
    add(
        "--suite",
        default="thesis",
        metavar="SUITE",
        help="thesis (default), robustness, wind, quadcopters, quick or a file",
    )
    add("-o", "--output", metavar="FOLDER", help=f"where the results go ({DEFAULT_FOLDER}/SUITE)")
    add(
        "--scenario",
        nargs="+",
        default=[],
        metavar="NAME",
        help="only these scenarios of the suite",
    )
    add(
        "--episodes",
        type=whole,
        metavar="N",
        help="episodes per scenario, instead of its own number",
    )
    add("--seed", type=whole, metavar="N", help="seed of each scenario, instead of its own")
    add(
        "--vehicle",
        metavar="V",
        help="vehicle for all, by name or YAML file (each agent's own, where the suite names none)",
    )
    add("--backend", default="batch", metavar="KIND", help="batch (compiled, default) or pybullet")
    add("--workers", type=whole, default=1, metavar="N", help="processes that fly side by side (1)")
    add("--overwrite", action="store_true", help="remove the results that the folder holds")
    add(
        "--reward",
        metavar="MODULE:FUNCTION",
        help="show the mean of a reward of your own, function(state, actions) per control step",
    )
    add("--report", default=True, help="update report.html and its plots (yes)", **YES_OR_NO)
    add_common(parser, "executor", "trust", "progress")


def run(options: argparse.Namespace) -> int:
    """Fly, print the table, print where everything is. Returns the exit code."""
    from sb3_quad.cli.commands.report import report
    from sb3_quad.cli.output import console, progress_bar, warn
    from sb3_quad.evaluation.controllers import parse_controllers
    from sb3_quad.evaluation.evaluate import evaluate
    from sb3_quad.evaluation.metric_tables import overview
    from sb3_quad.evaluation.scenarios.load import load_suite

    suite = load_suite(options.suite).with_changes(
        options.scenario, options.episodes, options.seed, options.vehicle
    )
    controllers = parse_controllers(options.controllers)
    folder = options.output or f"{DEFAULT_FOLDER}/{suite.name}"
    start = time.perf_counter()
    with progress_bar(options.progress) as show:
        show(0, None, "loading")
        results = evaluate(
            suite,
            controllers,
            folder,
            options.backend,
            options.workers,
            options.overwrite,
            progress=show,
            report=warn,
            executor=options.executor,
            address=options.address,
            reward=options.reward,
        )
    asked, flown = (
        {spec.label for spec in controllers},
        {entry.controller for entry in results.entries},
    )
    if asked & flown:
        labels = [spec.label for spec in controllers if spec.label in flown]
        console().print(
            overview(results.model_copy(update={"scenarios": list(suite.scenarios)}), labels)
        )
    if flown:
        print(
            f"{time.perf_counter() - start:.1f} s; results in {folder}: results.json, episodes.csv, flights/"
        )
    if options.report and flown:
        report(folder, overwrite=True)
    failures = [failure for failure in results.failures if failure.controller in asked]
    for failure in failures:
        where = "" if failure.scenario is None else f", scenario {failure.scenario}"
        print(f"failed: {failure.controller}{where}: {failure.message}", file=sys.stderr)
    return 1 if failures else 0
