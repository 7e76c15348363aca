"""``plot``: learning curves of one or more runs as a picture."""

import argparse
import glob
from pathlib import Path

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import write_bytes
from sb3_quad.cli.arguments.plot import THESIS
from sb3_quad.evaluation.learning_curves import read_curve
from sb3_quad.evaluation.scenarios.load import load_suite
from sb3_quad.report.curves import plot_curves
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
    lines = {**(_thesis(THESIS[options.thesis]) if options.thesis else {}), **dict(map(_line, options.line))}
    show = options.show or (["survival" if options.thesis else "success", "reward"])
    figure = plot_curves(groups, lines, options.title, show)
    write_bytes(options.output, picture(figure, kind, dpi=130))
    print(f"saved {options.output}")
    return 0


def _thesis(scenario: str) -> dict[str, dict[str, float]]:
    """What the thesis prints of a scenario; its success is our survival."""
    (found,) = (each for each in load_suite("thesis").scenarios if each.name == scenario)
    printed = {"survival", "reward"}
    known = {name: each.model_dump(include=printed, exclude_none=True) for name, each in found.reference.items()}
    return {f"thesis: {name}": heights for name, heights in known.items() if heights}


def _line(text: str) -> tuple[str, dict[str, float]]:
    try:
        name, success, reward = text.split(":")
        return name, {"success": float(success) / 100, "survival": float(success) / 100, "reward": float(reward)}
    except ValueError:
        raise ConfigError(f"--line {text!r}: give NAME:SUCCESS:REWARD, such as expert:31.9:-16.1") from None
