"""``publish``: a trained policy as a small zip for stock PPO, with a card that says what it can and where it comes from."""

import argparse
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import read_text, refuse_existing, replacing
from sb3_quad.base.signals import StopSignals
from sb3_quad.controllers.agent_settings import agent_settings
from sb3_quad.controllers.zips import load_model, saved_algorithm, saved_data
from sb3_quad.export.policy import slim_bytes
from sb3_quad.report.card import measure, write_card
from sb3_quad.training.runs import MADE_WITH, open_run
from sb3_quad.vehicles.vehicle import load_vehicle

UNKNOWN = "not recorded"


def run(options: argparse.Namespace) -> int:
    """Slim, fly, write. Returns the exit code."""
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
        rows = measure(load_model(zip_stream.name), options.episodes, **how)
        card = write_card(options.name, rows, options.made_by or command, facts, {**how, "vehicle": how["vehicle"].name})
        card_stream.write(card.encode("utf-8"))
        signals = last.enter_context(StopSignals())  # nothing comes between replacing the one and the other
    print(card)
    print(f"saved {zip_file} ({len(content)} bytes) and {card_file}")
    return signals.exit_code


def _plain(text: Any) -> str:
    """One line that ends no code span or fence of the card, whatever a run folder says."""
    return " ".join(str(text).split()).replace("`", "'")


def _origin(model: Path) -> tuple[str, dict[str, str]]:
    """The command that trained an agent, and further facts; what neither its zip nor its run folder says is UNKNOWN."""
    timesteps = saved_data(model)["num_timesteps"]
    facts, command = {"algorithm": f"`{saved_algorithm(model)}`, {timesteps:,} timesteps"}, f"# {UNKNOWN}"
    folder = model.parent
    if not any(folder.glob("*/args.yml")):
        return command, {**facts, "run": UNKNOWN}
    run = open_run(folder)
    settings, arguments = run.read_yaml()
    if run.command.is_file():
        command = _plain(read_text(run.command))
    start = arguments.get("trained_agent")
    facts["algorithm"] = f"`{_plain(arguments.get('algo', saved_algorithm(model)))}`, {timesteps:,} timesteps"
    if start:
        facts["algorithm"] += f" from `{_plain(Path(start).name)}`"
    facts["environment"] = f"`{_plain(arguments.get('env', run.name))}`"
    if settings.get("expert"):
        facts["expert"] = f"`{_plain(settings['expert'])}`"
    return command, facts | {name: _plain(arguments.get(name, UNKNOWN)) for name in ("seed", *MADE_WITH)}
