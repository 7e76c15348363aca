"""``benchmark``: control steps per second, in a table and as JSON."""

import argparse
import json
from dataclasses import asdict

from sb3_quad.base.files import write_text
from sb3_quad.cli.output import console
from sb3_quad.evaluation.tables import text_table
from sb3_quad.settings.config import load_config
from sb3_quad.training.benchmark import ENV_ID, machine, single, training_loop, vectorised


def run(options: argparse.Namespace) -> int:
    """Measure, print, write. Returns the exit code."""
    screen = console()
    config = load_config(options.algo, ENV_ID, options.conf_file) if options.training else None
    measurements = []
    with screen.status("one PyBullet environment"):
        measurements.append(single(options.seconds))
    kinds = [("dummy", options.n_envs), ("subproc", options.n_envs), *(("batch", size) for size in options.sizes)]
    for kind, n_envs in kinds:
        with screen.status(f"{kind}, {n_envs}"):
            measurements.append(vectorised(kind, n_envs, options.seconds))
    if config is not None:
        with screen.status(f"training loop of {config.algo}"):
            measurements.extend(training_loop(config))
    first = measurements[0].rate
    rows = ((each.name, f"{each.n_envs:,}", f"{each.rate:,.0f}", f"{each.rate / first:,.1f} x") for each in measurements)
    screen.print(text_table("control steps per second (median of 5)", ("", "rows", "steps/s", "to the first line"), rows))
    if options.output is not None:
        content = {"machine": machine(), "results": [asdict(each) for each in measurements]}
        write_text(options.output, json.dumps(content, indent=2) + "\n")
        print(f"written to {options.output}")
    return 0
