r"""Fly controllers through scenarios and compare them in tables.

All controllers fly the same episodes.

controllers:
  pid, geometric          an expert
  itm-robust              an agent that comes with the package
                          (docs/agents.md)
  path/to/agent.zip       an agent of any Stable-Baselines3 algorithm, or its
                          run folder
  package.module:factory  a function that takes the vehicle and returns a
                          controller
  NAME=CONTROLLER         any of these, with a name for the tables

examples:
  # chapter 4 of the thesis for both experts
  sb3-quad evaluate pid geometric
  sb3-quad evaluate pid agent=logs/ppo_bc/QuadStateRecovery-v0_1 \
    --suite thesis -o evaluations/mine
  # a quick look, in less than a minute
  sb3-quad evaluate pid agent.zip --suite quick
  # your own controller and scenarios
  sb3-quad evaluate pid my_package.control:make --suite my_scenarios.yaml
  # two scenarios with another vehicle
  sb3-quad evaluate pid geometric agent.zip --scenario tracking recovery \
    --vehicle crazyflie -o evaluations/crazyflie

The folder receives results.json, all flights and a report. It holds the
results of one command, so give all controllers at once. After an interruption,
the same command continues where it stopped.
"""

import sys
from argparse import Namespace

from pydantic import NonNegativeInt, PositiveInt

from sb3_quad.cli.parser import (
    PROGRESS,
    SEVERAL,
    TRUST,
    YES_OR_NO,
    Flags,
)

FLAGS: Flags = {
    "controllers CONTROLLER": (SEVERAL, "controllers to fly, as listed above"),
    "--suite": (
        str,
        "thesis",
        "suite of scenarios: thesis (default), robustness, wind, quadcopters, trajectories, quick "
        "or a file",
    ),
    "-o --output FOLDER": "folder for the results (evaluations/SUITE)",
    "--scenario NAME": (SEVERAL, [], "fly only these scenarios of the suite"),
    "-n --n-episodes N": (PositiveInt, "episodes of each scenario (the suite's number)"),
    "--seed N": (NonNegativeInt, "seed of each scenario (the suite's seed)"),
    "--vehicle": "vehicle, by name or YAML file (the suite's, else each agent's own)",
    "--report": (YES_OR_NO, True, "write report.md and its plots (yes)"),
    **TRUST,
    **PROGRESS,
}


def run(options: Namespace) -> int:
    """Fly, print the table and the failures. Returns the exit code."""
    from sb3_quad.cli.output import console, progress_bar, warn
    from sb3_quad.evaluation.controllers import parse_controllers
    from sb3_quad.evaluation.evaluate import evaluate
    from sb3_quad.evaluation.metric_tables import overview
    from sb3_quad.evaluation.scenarios.load import load_suite

    suite = load_suite(options.suite).with_changes(
        options.scenario, options.n_episodes, options.seed, options.vehicle
    )
    folder = options.output or f"evaluations/{suite.name}"
    with progress_bar(options.progress) as show:
        results = evaluate(
            suite,
            parse_controllers(options.controllers),
            folder,
            progress=show,
            report=warn,
        )
    if results.entries:
        console().print(*overview(results))
        print(f"results in {folder}: results.json, flights/")
        if options.report:
            # Matplotlib takes a second.
            from sb3_quad.evaluation.report import write_report

            print("report in", write_report(folder))
    for failure in results.failures:
        print("failed:", failure, file=sys.stderr)
    return int(bool(results.failures))
