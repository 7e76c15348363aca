"""``plot``: learning curves of one or more runs as a picture."""

import argparse
import glob
from pathlib import Path

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import write_bytes
from sb3_quad.report.curves import plot_curves, read_curve
from sb3_quad.report.plots import picture


def run(options: argparse.Namespace) -> int:
    """Read the runs, draw, write. Returns the exit code."""
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
