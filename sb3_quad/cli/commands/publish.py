"""``publish``: a trained policy as a small zip for stock PPO, with a card that says what it can and where it comes from."""

import argparse
import subprocess
from pathlib import Path
from typing import Any

import stable_baselines3
import torch

import sb3_quad
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import read_text, refuse_existing, write_bytes, write_text
from sb3_quad.experts.models import load_model
from sb3_quad.export.policy import slim_bytes
from sb3_quad.report.card import measure, write_card
from sb3_quad.settings.flight import FlightSettings
from sb3_quad.training.runs import RunFolder, open_run


def run(options: argparse.Namespace) -> int:
    """Slim, fly, write. Returns the exit code."""
    if Path(options.name).name != options.name:
        raise ConfigError(f"--name {options.name}: a name without folders; they are for -o")
    zip_file, card_file = (Path(options.folder) / f"{options.name}.{suffix}" for suffix in ("zip", "md"))
    for path in (zip_file, card_file):
        refuse_existing(path, options.overwrite)
    content, run = slim_bytes(options.model), open_run(Path(options.model).parent)
    command, facts, settings = options.made_by or _command(run), _facts(run, options.model), _settings(options.model)
    write_bytes(zip_file, content)
    rows = measure(load_model(zip_file), options.episodes, **settings)
    card = write_card(options.name, rows, command, facts, settings)
    write_text(card_file, card)
    print(card)
    print(f"saved {zip_file} ({len(content)} bytes) and {card_file}")
    return 0


def _settings(model: str) -> dict[str, Any]:
    """The settings of the environment that a policy is flown in, from its run folder."""
    found, _ = FlightSettings.beside(model)
    if found.observation_mean is not None or found.observation_std is not None:
        raise ConfigError(f"model {model}: was trained with its own observation scaling, which a zip cannot tell its users")
    return {"vehicle": found.vehicle, "noise": 0.05}


def _command(run: RunFolder) -> str:
    if not run.command.is_file():
        raise ConfigError(f"{run.command}: no such file; give what trained the agent by --command")
    return read_text(run.command).strip()


def _facts(run: RunFolder, model: str) -> dict[str, str]:
    """What the zip, the run folder and the checkout know."""
    settings, arguments = run.read_yaml()
    return {
        "algorithm": f"`{arguments.get('algo')}`, {load_model(model).num_timesteps:,} timesteps"
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
