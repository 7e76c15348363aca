"""``plot``: learning curves of one or more runs as a picture."""

from __future__ import annotations

import argparse
import glob
from pathlib import Path

from sb3_quad.base.errors import ConfigError

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


def run(options: argparse.Namespace) -> int:
    """Read the runs, draw, write. Returns the exit code."""
    from sb3_quad.base.files import write_bytes
    from sb3_quad.report.curves import plot_curves, read_curve
    from sb3_quad.report.plots import picture

    groups = {}
    for text in options.groups:
        name, separator, pattern = text.partition("=")
        folders = sorted(glob.glob(pattern))
        if not separator or not name:
            raise ConfigError(f"{text!r}: give NAME=PATTERN, such as 'RL-agent=logs/ppo_bc/*'")
        if not folders:
            raise ConfigError(f"{name}: no folder fits {pattern}")
        groups[name] = [read_curve(folder, options.task) for folder in folders]
    kind = Path(options.output).suffix.removeprefix(".")
    if kind not in ("png", "svg", "pdf"):
        raise ConfigError(f"--output {options.output}: must end in .png, .svg or .pdf")
    figure = plot_curves(groups, dict(map(_line, options.line)), options.title)
    write_bytes(options.output, picture(figure, kind, dpi=130))
    print(f"saved {options.output}")
    return 0


def _line(text: str) -> tuple[str, tuple[float, float]]:
    try:
        name, success, reward = text.split(":")
        return name, (float(success) / 100, float(reward))
    except ValueError:
        raise ConfigError(f"--line {text!r}: give NAME:SUCCESS:REWARD, such as expert:31.9:-16.1") from None
