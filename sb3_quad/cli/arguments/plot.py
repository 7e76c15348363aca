"""The flags of ``plot``."""

from __future__ import annotations

import argparse

HELP = "Draw learning curves: success and reward over timesteps and wall-clock time, seeds as mean and range."
EXAMPLES = """examples:
  sb3-quad plot "RL-agent=logs/ppo_bc/QuadStateRecovery-v0_*" -o curves.png
  sb3-quad plot "PPO+BC=logs/ppo_bc/*" "PPO only=logs/ppo/*" --line expert:31.9:-16.1 --title "state recovery" -o curves.svg
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The flags of ``plot``."""
    add = parser.add_argument
    add("groups", nargs="+", metavar="NAME=PATTERN", help="an agent's name and its run folders, * allowed (quote it)")
    add("--line", action="append", default=[], metavar="NAME:SUCCESS:REWARD", help="a horizontal line: success in %%, reward")
    add("--task", help="draw the evaluations on this one of the runs' eval_tasks, instead of those on their own task")
    add("--title", default="", help="above the picture")
    add("-o", "--output", default="curves.png", metavar="FILE", help="picture to write: .png, .svg or .pdf (curves.png)")
