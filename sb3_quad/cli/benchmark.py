"""``benchmark``: control steps per second, in a table and as JSON."""

from __future__ import annotations

import argparse
import json
from typing import TYPE_CHECKING

from sb3_quad.base.errors import ConfigError
from sb3_quad.cli.arguments import whole
from sb3_quad.cli.output import console

if TYPE_CHECKING:
    from sb3_quad.evaluation.tables import Table
    from sb3_quad.training.benchmark import Measurement

HELP = "Measure control steps per second: PyBullet, SB3's vectorised environments, the batch, and a training loop."
EXAMPLES = """examples:
  sb3-quad benchmark                                   everything, about a minute
  sb3-quad benchmark --sizes 240 4096 --no-training    the batch at two sizes, beside PyBullet
  sb3-quad benchmark --algo ppo_bc --conf-file ppo_bc.yml --output benchmark.json
"""
SIZES = (64, 240, 1024, 4096, 16384)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The benchmark's flags."""
    add = parser.add_argument
    add("--sizes", nargs="+", type=whole, default=list(SIZES), metavar="N", help="rows of the batch")
    add("--n-envs", type=whole, default=8, metavar="N", help="environments of DummyVecEnv and SubprocVecEnv (8)")
    add("--seconds", type=float, default=3.0, metavar="S", help="for each measurement (3)")
    add("--algo", default="ppo_bc", help="algorithm of the training loop (ppo_bc)")
    add("-conf", "--conf-file", metavar="FILE", help="its settings (those that train without arguments uses)")
    add("--training", action=argparse.BooleanOptionalAction, default=True, help="measure a training loop too")
    add("--output", metavar="FILE", help="write everything as JSON, with machine, versions and thread counts")


def run(options: argparse.Namespace) -> int:
    """Measure, print, write. Returns the exit code."""
    if min(options.sizes) < 1 or options.n_envs < 1 or options.seconds <= 0:
        raise ConfigError("--sizes and --n-envs must be at least 1, --seconds above 0")
    from sb3_quad.base.files import write_text
    from sb3_quad.settings.config import config_names, load_config
    from sb3_quad.training.benchmark import ENV_ID, as_dict, single, training_loop, vectorised

    screen = console()
    default = f"geometric/{options.algo}.yml"
    conf_file = options.conf_file or (default if default in config_names() else None)
    config = load_config(options.algo, ENV_ID, conf_file) if options.training else None
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
    screen.print(_table(measurements))
    if options.output is not None:
        write_text(options.output, json.dumps(as_dict(measurements), indent=2) + "\n")
        print(f"written to {options.output}")
    return 0


def _table(measurements: list[Measurement]) -> Table:
    from sb3_quad.evaluation.tables import text_table

    first = measurements[0].rate
    rows = ((each.name, f"{each.n_envs:,}", f"{each.rate:,.0f}", f"{each.rate / first:,.1f} x") for each in measurements)
    return text_table("control steps per second (median of 5)", ("", "rows", "steps/s", "to the first line"), rows)
