"""Write a trained policy as a small zip for stock PPO, with a card: measured metrics, command, seed, versions.

The zip holds the weights and plain numbers only, so that other versions of Stable-Baselines3 can read it too.
For the card, the policy flies fresh episodes: 3,840 recoveries, and 960 targets at each of 10, 15 and 20 m.

examples:
  sb3-quad publish logs/ppo_bc/QuadStateRecovery-v0_1/trimmed_model.zip --name my-agent
  sb3-quad publish logs/ppo/QuadStateRecovery-v0_2/best_model.zip --name other --command "python my.py" -o published

How it was trained is taken from its run folder. What is recorded nowhere, the card calls so.
"""

import argparse
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import read_text, refuse_existing, replacing
from sb3_quad.base.signals import StopSignals
from sb3_quad.cli.parser import Parser, add_common, positive
from sb3_quad.controllers.pretrained import agent_path

UNKNOWN = "not recorded"


def add_arguments(parser: Parser) -> None:
    add = parser.add_argument
    model = "an agent of an on-policy algorithm (PPO, A2C, DAgger, PPOBC) with MlpPolicy: a zip or a run folder"
    add("model", type=agent_path, metavar="MODEL", help=model)
    add("--name", required=True, metavar="NAME", help="name of the files, NAME.zip and NAME.md")
    add("-o", metavar="FOLDER", dest="folder", default=".", help="folder for both (here)")
    add("--command", metavar="TEXT", dest="made_by", help="the command that trained it (command.txt of the run)")
    add("--episodes", type=positive, default=960, metavar="N", help="episodes of each task (960; recoveries: 4 times as many)")
    add_common(parser, "trust", "overwrite")


def run(options: argparse.Namespace) -> int:
    """Slim, fly, write. Returns the exit code."""
    from sb3_quad.controllers.agent_settings import agent_settings
    from sb3_quad.controllers.zips import load_model
    from sb3_quad.export.policy import slim_bytes
    from sb3_quad.report import card
    from sb3_quad.vehicles.vehicle import load_vehicle

    if Path(options.name).name != options.name:
        raise ConfigError(f"--name {options.name}: a name without folders; they are for -o")
    zip_file, card_file = (Path(options.folder) / f"{options.name}.{suffix}" for suffix in ("zip", "md"))
    for path in (zip_file, card_file):
        refuse_existing(path, options.overwrite)
    settings, source = agent_settings(options.model)
    content = slim_bytes(options.model, settings if source else None)
    command, facts = _origin(Path(options.model))
    if not source:
        facts["vehicle"] = f"{UNKNOWN}; measured on `{settings.vehicle}`"
    if settings.observation_mean is not None or settings.observation_std is not None:
        facts["observation"] = "scaled by a mean and std of its own, in the zip's `flight_settings`"
    how = {"noise": settings.noise, **settings.in_any_task(), "vehicle": load_vehicle(settings.vehicle)}
    with ExitStack() as last, replacing(zip_file) as zip_stream, replacing(card_file) as card_stream:
        zip_stream.write(content)
        zip_stream.flush()
        rows = card.measure(load_model(zip_stream.name), options.episodes, **how)
        text = card.write_card(options.name, rows, options.made_by or command, facts, {**how, "vehicle": how["vehicle"].name})
        card_stream.write(text.encode("utf-8"))
        signals = last.enter_context(StopSignals())  # nothing comes between replacing the one and the other
    print(text)
    print(f"saved {zip_file} ({len(content)} bytes) and {card_file}")
    return signals.exit_code


def _origin(model: Path) -> tuple[str, dict[str, str]]:
    """The command that trained an agent, and further facts; what neither its zip nor its run folder says is UNKNOWN."""
    from sb3_quad.controllers.zips import saved_algorithm, saved_data
    from sb3_quad.training.runs import MADE_WITH, open_run

    algorithm, timesteps = saved_algorithm(model), f"{saved_data(model)['num_timesteps']:,} timesteps"
    if not any(model.parent.glob("*/args.yml")):
        return f"# {UNKNOWN}", {"algorithm": f"`{algorithm}`, {timesteps}", "run": UNKNOWN}
    run = open_run(model.parent)
    settings, arguments = run.read_yaml()
    start = arguments.get("trained_agent")
    facts = {
        "algorithm": f"`{_plain(arguments.get('algo', algorithm))}`, {timesteps}"
        + (f" from `{_plain(Path(start).name)}`" if start else ""),
        "environment": f"`{_plain(arguments.get('env', run.name))}`",
        **({"expert": f"`{_plain(settings['expert'])}`"} if settings.get("expert") else {}),
        **{name: _plain(arguments.get(name, UNKNOWN)) for name in ("seed", *MADE_WITH)},
    }
    return _plain(read_text(run.command)) if run.command.is_file() else f"# {UNKNOWN}", facts


def _plain(text: Any) -> str:
    """One line that ends no code span or fence of the card, whatever a run folder says."""
    return " ".join(str(text).split()).replace("`", "'")
