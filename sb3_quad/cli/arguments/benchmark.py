"""Measure control steps per second: PyBullet, SB3's vectorised environments, the batch, and training loops.

examples:
  sb3-quad benchmark                                   everything, about a minute
  sb3-quad benchmark --sizes 240 4096 --no-training    the batch at two sizes, and PyBullet
  sb3-quad benchmark --training                        where the time of a training goes
  sb3-quad benchmark --algo ppo_bc --conf-file pid/ppo_bc.yml --output benchmark.json
"""

import argparse

from sb3_quad.cli.parser import Parser, above_zero, positive


def add_arguments(parser: Parser) -> None:
    add = parser.add_argument
    add("--sizes", nargs="+", type=positive, default=[64, 240, 1024, 4096, 16384], metavar="N", help="rows of the batch")
    add("--n-envs", type=positive, default=8, metavar="N", help="environments of DummyVecEnv and SubprocVecEnv (8)")
    add("--seconds", type=above_zero, default=3.0, metavar="S", help="duration of each measurement (3)")
    add("--algo", nargs="+", default=["dagger", "ppo_bc"], help="algorithms of the training loops (dagger ppo_bc)")
    add("-conf", "--conf-file", metavar="FILE", help="its settings (those of train without arguments)")
    training = "only, or no, training loops: where the time goes in rollouts and updates"
    add("--training", action=argparse.BooleanOptionalAction, help=training)
    add("--output", metavar="FILE", help="write everything as JSON, with machine, versions and thread counts")
