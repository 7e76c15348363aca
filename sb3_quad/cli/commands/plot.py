r"""Draw learning curves with mean and range over seeds.

examples:
  sb3-quad plot logs/ppo_bc/QuadStateRecovery-v0_1
  # all runs of an agent as one curve
  sb3-quad plot "RL-agent=logs/ppo_bc/QuadStateRecovery-v0_*" -o curves.png
  # two agents, and other panels than success and reward
  sb3-quad plot "PPO+BC=logs/ppo_bc/*" "PPO only=logs/ppo/*" \
    --show survival reward -o curves.svg
"""

import glob
from argparse import Namespace
from pathlib import Path

from sb3_quad.base.errors import ConfigError, refuse_unknown
from sb3_quad.base.files import refuse_existing
from sb3_quad.cli.parser import (
    OVERWRITE,
    SEVERAL,
    Flags,
)

FLAGS: Flags = {
    "groups RUN": (
        SEVERAL,
        "run folder, or NAME=PATTERN: an agent's name and its runs; quote a *",
    ),
    "--show PANEL": (
        SEVERAL,
        [],
        "panels to draw: success, survival, reward or a loss such as bc_loss (success reward)",
    ),
    "--task": "draw the evaluations on this one of the runs' eval_tasks (the runs' own task)",
    "-o --output FILE": (str, "curves.png", "picture to write: .png, .svg or .pdf (curves.png)"),
    **OVERWRITE,
}


def run(options: Namespace) -> int:
    """Read the runs, draw, write. Returns the exit code."""
    from sb3_quad.evaluation.learning_curves import read_curve
    from sb3_quad.evaluation.plots import plot_curves, save_figure

    groups = {}
    for text in options.groups:
        name, folders = _group(text)
        if name in groups:
            raise ConfigError(f"{name!r}: two groups have this name; give NAME=PATTERN")
        groups[name] = [read_curve(folder, options.task) for folder in folders]
    output = Path(options.output)
    refuse_unknown("ending of --output", [output.suffix], (".png", ".svg", ".pdf"))
    refuse_existing(output, options.overwrite)
    save_figure(plot_curves(groups, options.show), output)
    print("saved", output)
    return 0


def _group(text: str) -> tuple[str, list[str]]:
    """Return the name and the run folders of an argument.

    :raises ConfigError: No such folder, or no name.
    """
    path = Path(text)
    name, equals, pattern = text.partition("=")
    if path.is_dir() or not equals:
        name = "/".join(path.parts[-2:])
        pattern = text
    # A folder's own name may hold a *.
    folders = [pattern] if Path(pattern).is_dir() else sorted(glob.glob(pattern))
    if not name or not folders:
        raise ConfigError(
            f"{text!r}: no such folder; give run folders, "
            "or NAME=PATTERN such as 'RL-agent=logs/ppo_bc/*'"
        )
    return name, folders
