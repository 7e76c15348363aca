r"""Draw learning curves with mean and range over seeds.

They show success, reward and losses over timesteps and wall-clock time.

examples:
  sb3-quad plot logs/ppo_bc/QuadStateRecovery-v0_1
  # all runs of an agent as one curve
  sb3-quad plot "RL-agent=logs/ppo_bc/QuadStateRecovery-v0_*" -o curves.png
  # two agents and the expert's success and reward
  sb3-quad plot "PPO+BC=logs/ppo_bc/*" "PPO only=logs/ppo/*" \
    --line expert:32.8:-16.0 --title "state recovery" -o curves.svg
  # with the thesis's results
  sb3-quad plot "PPO+BC=logs/ppo_bc/QuadStateRecovery-v0_*" \
    --thesis state_recovery --show survival reward losses
"""

import glob
from argparse import ArgumentTypeError, Namespace
from pathlib import Path

from sb3_quad.base.errors import ConfigError, refuse_unknown
from sb3_quad.base.files import refuse_existing, write_bytes
from sb3_quad.cli.parser import (
    OVERWRITE,
    SEVERAL,
    Flags,
)
from sb3_quad.evaluation.scenarios import THESIS_SCENARIOS

PANELS = ("success", "survival", "reward", "losses")


def _line(text: str) -> tuple[str, dict[str, float]]:
    try:
        name, success, reward = text.split(":")
        share = float(success) / 100
        return name, {"success": share, "survival": share, "reward": float(reward)}
    except ValueError:
        raise ArgumentTypeError(
            f"{text!r}: give NAME:SUCCESS:REWARD, such as expert:32.8:-16.0"
        ) from None


FLAGS: Flags = {
    "groups RUN": (
        SEVERAL,
        "run folder, or NAME=PATTERN: an agent's name and its runs; quote a *",
    ),
    "--line NAME:SUCCESS:REWARD": (
        {"action": "append", "type": _line},
        [],
        "draw horizontal lines at a success in %% and a reward",
    ),
    "--thesis TASK": (
        {"choices": [*THESIS_SCENARIOS]},
        f"draw the thesis's results for {' or '.join(THESIS_SCENARIOS)} as horizontal lines",
    ),
    "--show PANEL": (
        {"nargs": "+", "choices": PANELS},
        [],
        f"panels to draw, of {', '.join(PANELS)} (success reward)",
    ),
    "--task": "draw the evaluations on this one of the runs' eval_tasks (the runs' own task)",
    "--title": (str, "", "title of the picture"),
    "-o --output FILE": (str, "curves.png", "picture to write: .png, .svg or .pdf (curves.png)"),
    **OVERWRITE,
}


def run(options: Namespace) -> int:
    """Read the runs, draw, write. Returns the exit code."""
    from sb3_quad.evaluation.learning_curves import read_curve
    from sb3_quad.evaluation.scenarios.load import load_suite
    from sb3_quad.report.curves import plot_curves
    from sb3_quad.report.plots import picture

    groups = {}
    for text in options.groups:
        name, folders = _group(text)
        if name in groups:
            raise ConfigError(f"{name!r}: two groups have this name; give NAME=PATTERN")
        groups[name] = [read_curve(folder, options.task) for folder in folders]
    kind = Path(options.output).suffix.removeprefix(".")
    refuse_unknown("ending of --output", [kind], ("png", "svg", "pdf"))
    lines = {}
    show = options.show
    if options.thesis:
        # Its success is our survival.
        show = show or ["survival", "reward"]
        scenario = load_suite("thesis").scenario(THESIS_SCENARIOS[options.thesis])
        for name, published in scenario.published.items():
            lines[f"thesis: {name}"] = published.model_dump(exclude_none=True)
    figure = plot_curves(groups, {**lines, **dict(options.line)}, options.title, show)
    refuse_existing(options.output, options.overwrite)
    write_bytes(options.output, picture(figure, kind, dpi=130))
    print("saved", options.output)
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
