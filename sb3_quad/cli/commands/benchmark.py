"""Measure control steps per second: PyBullet, SB3's vectorised environments, the batch, and training loops.

examples:
  sb3-quad benchmark                                   everything, about a minute
  sb3-quad benchmark --sizes 240 4096 --no-training    the batch at two sizes, and PyBullet
  sb3-quad benchmark --training                        rollouts and updates of trainings
  sb3-quad benchmark --algo ppo_bc --conf-file pid/ppo_bc.yml --output benchmark.json
"""

import argparse
import json
from dataclasses import asdict

from sb3_quad.base.files import write_text
from sb3_quad.cli.parser import YES_OR_NO, Parser, above_zero, positive


def add_arguments(parser: Parser) -> None:
    add = parser.add_argument
    add("--sizes", nargs="+", type=positive, default=[64, 240, 1024, 4096, 16384], metavar="N", help="rows of the batch")
    add("--n-envs", type=positive, default=8, metavar="N", help="environments of DummyVecEnv and SubprocVecEnv (8)")
    add("--seconds", type=above_zero, default=3.0, metavar="S", help="duration of each measurement (3)")
    add("--algo", nargs="+", default=["dagger", "ppo_bc"], help="algorithms of the training loops (dagger ppo_bc)")
    add("-conf", "--conf-file", metavar="FILE", help="its settings (those of train without arguments)")
    add("--training", help="only, or no, training loops: their rollouts and updates", **YES_OR_NO)
    add("--output", metavar="FILE", help="write everything as JSON, with machine, versions and thread counts")


def run(options: argparse.Namespace) -> int:
    """Measure, print, write. Returns the exit code."""
    from sb3_quad.cli.output import console
    from sb3_quad.evaluation.tables import text_table
    from sb3_quad.training.benchmark import TRAINED, machine, single, training_loop, vectorised
    from sb3_quad.training.config import load_config

    screen = console()
    loops = [] if options.training is False else [load_config(algo, TRAINED, options.conf_file) for algo in options.algo]
    measurements = []
    if options.training is not True:
        with screen.status("one PyBullet environment"):
            measurements.extend(single(options.seconds))
        randomize = load_config("dagger", TRAINED).env_kwargs["randomize"]
        kinds = [("dummy", options.n_envs, None), ("subproc", options.n_envs, None)]
        for kind, n_envs, randomized in [*kinds, *(("batch", size, randomize) for size in options.sizes)]:
            with screen.status(f"{kind}, {n_envs}"):
                measurements.extend(vectorised(kind, n_envs, options.seconds, randomized))
    for config in loops:
        with screen.status(f"training loop of {config.algo}"):
            measurements.extend(training_loop(config))
    first = measurements[0].rate
    rows = [(each.name, f"{each.n_envs:,}", f"{each.rate:,.0f}", f"{each.rate / first:,.1f} x") for each in measurements]
    screen.print(text_table("control steps per second (median of 5)", ("", "rows", "steps/s", "to the first line"), rows))
    if options.output is not None:
        content = {"machine": machine(), "results": [asdict(each) for each in measurements]}
        write_text(options.output, json.dumps(content, indent=2) + "\n")
        print(f"written to {options.output}")
    return 0
