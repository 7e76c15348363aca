"""``benchmark``: control steps per second, in a table and as JSON."""

import argparse
import json
from dataclasses import asdict

from sb3_quad.base.files import write_text
from sb3_quad.cli.output import console
from sb3_quad.evaluation.tables import text_table
from sb3_quad.training.benchmark import PARTS, TRAINED, machine, single, training_loop, vectorised
from sb3_quad.training.config import load_config


def _share(seconds: dict[str, float], part: str) -> str:
    return f"{1000 * seconds[part]:,.1f}  ({seconds[part] / sum(seconds.values()):.0%})"


def run(options: argparse.Namespace) -> int:
    """Measure, print, write. Returns the exit code."""
    screen = console()
    loops = [] if options.training is False else [load_config(algo, TRAINED, options.conf_file) for algo in options.algo]
    measurements, parts = [], {}
    if options.training is not True:
        with screen.status("one PyBullet environment"):
            measurements.extend(single(options.seconds))
        worlds = load_config("dagger", TRAINED).env_kwargs["randomize"]
        kinds = [("dummy", options.n_envs, None), ("subproc", options.n_envs, None)]
        kinds += [("batch", size, worlds) for size in options.sizes]
        for kind, n_envs, randomize in kinds:
            with screen.status(f"{kind}, {n_envs}"):
                measurements.extend(vectorised(kind, n_envs, options.seconds, randomize))
    for config in loops:
        with screen.status(f"training loop of {config.algo}"):
            rates, parts[config.algo] = training_loop(config)
            measurements.extend(rates)
    first = measurements[0].rate
    rows = [(each.name, f"{each.n_envs:,}", f"{each.rate:,.0f}", f"{each.rate / first:,.1f} x") for each in measurements]
    screen.print(text_table("control steps per second (median of 5)", ("", "rows", "steps/s", "to the first line"), rows))
    if parts:
        shares = [(part, *(_share(seconds, part) for seconds in parts.values())) for part in PARTS]
        screen.print(text_table("a rollout and its update, ms", ("", *parts), shares))
    if options.output is not None:
        content = {"machine": machine(), "results": [asdict(each) for each in measurements], "seconds": parts}
        write_text(options.output, json.dumps(content, indent=2) + "\n")
        print(f"written to {options.output}")
    return 0
