"""What to type after a training."""

import shlex
import shutil
import sys
from pathlib import Path

from sb3_quad.controllers.agent_settings import agent_settings
from sb3_quad.envs.registration import ENVIRONMENTS
from sb3_quad.envs.rendering.window import has_display
from sb3_quad.training.runs import RunFolder


def print_next(run: RunFolder) -> None:
    """Print the commands that show, measure and export a run's agent, as far as they know its environment and policy."""
    if run.name not in ENVIRONMENTS:
        return
    algo, number, agent = run.path.parent.name, run.path.name.removeprefix(f"{run.name}_").split("_")[0], str(run.result)
    label = f"{algo}_{run.path.name}"
    picture = [] if has_display() else ["-o", f"{label}.png"]
    print("next:")
    commands = [
        ["enjoy", "--algo", algo, "--env", run.name, "-f", str(run.path.parent.parent), "--exp-id", number, *picture],
        ["evaluate", agent, "--suite", "quick", "-o", f"evaluations/{label}"],
    ]
    vehicle = ["--vehicle", "itm"] if agent_settings(agent)[0].vehicles else []  # else the one that it was trained on
    commands.append(["export", agent, "--format", "torchscript", *vehicle])
    for command in commands:
        print("  " + shlex.join([*_program(), *command]))


def _program() -> list[str]:
    """``sb3-quad`` where a shell would find that of this Python, else the module of this Python."""
    if Path(shutil.which("sb3-quad") or "").parent == Path(sys.executable).parent:
        return ["sb3-quad"]
    return [sys.executable, "-m", "sb3_quad.cli"]
