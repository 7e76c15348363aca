"""``publish``: a trained policy as a small zip for stock PPO, with a card that says what it can and where it comes from."""

from __future__ import annotations

import argparse
import subprocess
from pathlib import Path
from typing import Any

from sb3_quad.base.errors import ConfigError

HELP = "Write a trained policy as a small zip for stock PPO, with a card: measured metrics, command, seed, versions."
EXAMPLES = """The zip holds the weights and plain numbers only, so that other versions of Stable-Baselines3 read it too. For
the card it is flown over fresh episodes: 3,840 recoveries, 960 targets at each of 10, 15 and 20 m.

examples:
  sb3-quad publish logs/ppo_bc/QuadStateRecovery-v0_1/trimmed_model.zip --name my-agent --command "sb3-quad train --seed 0"
  sb3-quad publish logs/ppo/QuadStateRecovery-v0_2/best_model.zip --name other --command "python my.py" -o published

The zip must lie in its run folder, which says how it was trained.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The flags of ``publish``."""
    add = parser.add_argument
    add("model", metavar="MODEL.zip", help="an agent of an on-policy algorithm (PPO, A2C, DAgger, PPOBC) with MlpPolicy")
    add("--name", required=True, metavar="NAME", help="the files are called NAME.zip and NAME.md")
    add("-o", metavar="FOLDER", dest="folder", default=".", help="where they go (here)")
    add("--command", metavar="TEXT", dest="made_by", required=True, help="what trained it, as typed; the card repeats it")
    add("--episodes", type=int, default=960, metavar="N", help="flown of each task (960; of recoveries four times as many)")
    add("--overwrite", action="store_true", help="replace the files if they are there")


def run(options: argparse.Namespace) -> int:
    """Slim, fly, write. Returns the exit code."""
    from sb3_quad.base.files import refuse_existing, write_bytes, write_text
    from sb3_quad.experts.models import load_model
    from sb3_quad.export.slim import slim_bytes
    from sb3_quad.report.card import measure, write_card

    if options.episodes < 1:
        raise ConfigError(f"--episodes {options.episodes}: must be at least 1")
    if Path(options.name).name != options.name:
        raise ConfigError(f"--name {options.name}: a name without folders; they are for -o")
    zip_file, card_file = (Path(options.folder) / f"{options.name}.{suffix}" for suffix in ("zip", "md"))
    for path in (zip_file, card_file):
        refuse_existing(path, options.overwrite)
    content, facts, settings = slim_bytes(options.model), _facts(options.model), _settings(options.model)
    write_bytes(zip_file, content)
    rows = measure(load_model(zip_file), options.episodes, **settings)
    card = write_card(options.name, rows, options.made_by, facts, settings)
    write_text(card_file, card)
    print(card)
    print(f"saved {zip_file} ({len(content)} bytes) and {card_file}")
    return 0


def _settings(model: str) -> dict[str, Any]:
    """The settings of the environment that a policy is flown in, from its run folder."""
    from sb3_quad.settings.trained_with import trained_with

    found = trained_with(model)
    if found.observation_mean is not None or found.observation_std is not None:
        raise ConfigError(f"model {model}: was trained with its own observation scaling, which a zip cannot tell its users")
    return {"vehicle": found.vehicle or "itm", "noise": 0.05}


def _facts(model: str) -> dict[str, str]:
    """What the run folder and the checkout know."""
    import stable_baselines3
    import torch

    import sb3_quad
    from sb3_quad.training.runs import open_run

    settings, arguments = open_run(Path(model).parent).read_yaml()
    return {
        "algorithm": f"`{arguments.get('algo')}`, {int(settings['n_timesteps']):,} timesteps"
        + (" after the agent of the stage before" if arguments.get("trained_agent") else ""),
        "environment": f"`{arguments.get('env')}`",
        "expert": f"`{settings.get('expert')}`",
        "seed": str(arguments.get("seed")),
        "commit": _commit(Path(sb3_quad.__file__).resolve().parent.parent),
        "versions": f"sb3_quad {sb3_quad.__version__}, stable-baselines3 {stable_baselines3.__version__}, "
        f"torch {torch.__version__}",
    }


def _commit(checkout: Path) -> str:
    """The commit of a checkout; a mark where files differ from it."""
    command = ["git", "-C", str(checkout), "describe", "--always", "--abbrev=40", "--exclude=*", "--dirty= and changes"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "not a checkout"
