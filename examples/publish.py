"""Write a trained policy as a small zip for stock PPO, with a card: measured metrics, command,
seed, versions.

    python examples/publish.py logs/ppo_bc/QuadStateRecovery-v0_1/corrected_model.zip --name my-agent
    python examples/publish.py logs/ppo/QuadStateRecovery-v0_2/best_model.zip --name other --command
    "my.py" -o published python examples/publish.py itm-recovery --name itm-recovery --hub python
    examples/publish.py itm-recovery --name itm-recovery --push somebody/itm-recovery

The zip holds the weights and plain numbers only, so that other versions of Stable-Baselines3 can
read it too. For the card, as model hubs show it, the policy flies fresh episodes: 3,840 recoveries,
and 960 targets at each of 10, 15 and 20 m. How it was trained is taken from its run folder; what is
recorded nowhere, the card calls so. The agents of the package were made so.

With --hub a folder NAME is laid out as huggingface_sb3 lays out a model: the card as README.md,
with its metadata, the zip and what is in it, config.json and results.json, whose rewards are those
of the agent's own task. --push also uploads it to the Hugging Face Hub, with `pip install
huggingface-hub` and `hf auth login`.
"""

import argparse
import datetime
import io
import json
import sys
import zipfile
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import jinja2
import stable_baselines3
import yaml
from stable_baselines3 import PPO

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import read_text, refuse_existing, replacing
from sb3_quad.base.imports import require
from sb3_quad.base.seeds import seed_for
from sb3_quad.base.signals import StopSignals
from sb3_quad.cli import app
from sb3_quad.cli.parser import Parser, add_common, positive
from sb3_quad.controllers.agent_settings import agent_settings
from sb3_quad.controllers.pretrained import agent_path
from sb3_quad.controllers.zips import load_model, saved_algorithm, saved_data
from sb3_quad.envs.registration import ENVIRONMENTS
from sb3_quad.evaluation.flights import Flights, fly
from sb3_quad.evaluation.metric_tables import (
    LIMIT,
    MEDIAN,
    QUANTILE,
    REWARD,
    SUCCESS,
    SURVIVAL,
    metric_cells,
    settling_row,
    time_row,
)
from sb3_quad.evaluation.metrics import Metrics, summarise
from sb3_quad.evaluation.results import file_name
from sb3_quad.evaluation.scenarios.parts import Target
from sb3_quad.evaluation.scenarios.scenario import Scenario
from sb3_quad.evaluation.tables import Cell, Column, Row, Table, text_table
from sb3_quad.export.network import check_policy
from sb3_quad.simulation.frames import ObservationSettings
from sb3_quad.simulation.settings import FlightSettings, in_words
from sb3_quad.training.runs import MADE_WITH, open_run
from sb3_quad.vehicles.vehicle import load_vehicle

UNKNOWN = "not recorded"

N_RECOVERIES = 4  # times as many recoveries as targets at each distance
TARGETS = {f"targets {distance:.0f} m away": distance for distance in (10.0, 15.0, 20.0)}  # m
RECOVERY, TIMES = "state recovery", (settling_row(0.1), LIMIT, time_row(0.1))
SHOWN = (SUCCESS, SURVIVAL, REWARD, *TIMES, MEDIAN, QUANTILE)


def add_arguments(parser: Parser) -> None:
    """Add the flags."""
    add = parser.add_argument
    model = "an agent of an on-policy algorithm (PPO, A2C, DAgger, PPOBC) with MlpPolicy: a zip or a run folder"
    add("model", type=agent_path, metavar="MODEL", help=model)
    add("--name", required=True, metavar="NAME", help="name of the files, NAME.zip and NAME.md")
    add("-o", metavar="FOLDER", dest="folder", default=".", help="folder for both (here)")
    add(
        "--command",
        metavar="TEXT",
        dest="made_by",
        help="the command that trained it (command.txt of the run)",
    )
    add(
        "--episodes",
        type=positive,
        default=960,
        metavar="N",
        help="episodes of each task (960; recoveries: 4 times as many)",
    )
    add(
        "--hub",
        action="store_true",
        help="lay out a folder NAME as huggingface_sb3 does, instead of the two files",
    )
    add("--push", metavar="USER/REPO", help="also upload that folder to the Hugging Face Hub")
    add_common(parser, "trust", "overwrite")


def run(options: argparse.Namespace) -> int:
    """Slim, fly, write. Returns the exit code."""
    if file_name(options.name) != options.name:
        raise ConfigError(
            f"--name {options.name!r}: letters, digits and, between them, '_', '.' and '-'; folders are for -o"
        )
    api = require("huggingface_hub", "", "--push").HfApi() if options.push else None
    laid_out, folder = options.hub or options.push, Path(options.folder)
    folder = folder / options.name if laid_out else folder
    zip_file, card_file = (
        folder / f"{options.name}.zip",
        folder / ("README.md" if laid_out else f"{options.name}.md"),
    )
    for path in (zip_file, card_file):
        refuse_existing(path, options.overwrite)
    settings, source = agent_settings(options.model)
    content = slim_bytes(options.model, settings if source else None)
    command, facts = _origin(Path(options.model))
    if not source:
        facts["vehicle"] = f"{UNKNOWN}; measured on `{settings.vehicle}`"
    if settings.observation_mean is not None or settings.observation_std is not None:
        facts["observation"] = "scaled by a mean and std of its own, in the zip's `flight_settings`"
    how = {
        "noise": settings.noise,
        **settings.in_any_task(),
        "vehicle": load_vehicle(settings.vehicle),
    }
    with (
        ExitStack() as last,
        replacing(zip_file) as zip_stream,
        replacing(card_file) as card_stream,
    ):
        zip_stream.write(content)
        zip_stream.flush()
        flown = measure(load_model(zip_stream.name), options.episodes, **how)
        rows = {name: summarise(each) for name, each in flown.items()}
        text = write_card(options.name, rows, options.made_by or command, facts, how)
        metadata, files = (
            hub_layout(options.name, content, settings.task, flown) if laid_out else ("", {})
        )
        card_stream.write(f"{metadata}{text}".encode())
        signals = last.enter_context(
            StopSignals()
        )  # nothing comes between replacing the one and the other
        for path, data in files.items():
            last.enter_context(replacing(folder / path)).write(data)
    print(text)
    print(f"saved {zip_file} ({len(content)} bytes) and {card_file}")
    if api is not None and not signals.exit_code:
        api.create_repo(repo_id=options.push, exist_ok=True)
        print(
            api.upload_folder(
                repo_id=options.push, folder_path=folder, commit_message=f"Add {options.name}"
            )
        )
    return signals.exit_code


def _origin(model: Path) -> tuple[str, dict[str, str]]:
    """The command that trained an agent, and further facts; what neither its zip nor its run folder
    says is UNKNOWN.
    """
    algorithm, timesteps = (
        saved_algorithm(model),
        f"{saved_data(model)['num_timesteps']:,} timesteps",
    )
    if not any(model.parent.glob("*/args.yml")):
        return f"# {UNKNOWN}", {"algorithm": f"`{algorithm}`, {timesteps}", "run": UNKNOWN}
    run = open_run(model.parent)
    settings, arguments = run.read_yaml()
    start = arguments.get("trained_agent")
    facts = {
        "algorithm": f"`{_plain(arguments.get('algo', algorithm))}`, {timesteps}"
        + (f" from `{_plain(Path(start).name)}`" if start else ""),
        "environment": f"`{_plain(arguments.get('env', run.name))}`",
        **(
            {"expert": f"`{_plain(settings['expert'])}`"}
            if settings.get("expert") and settings.get("bc_coef") != 0
            else {}
        ),
        **{name: _plain(arguments.get(name, UNKNOWN)) for name in ("seed", *MADE_WITH)},
    }
    return _plain(read_text(run.command)) if run.command.is_file() else f"# {UNKNOWN}", facts


def _plain(text: Any) -> str:
    """One line that ends no code span or fence of the card, whatever a run folder says."""
    return " ".join(str(text).split()).replace("`", "'")


def slim_bytes(path: str | Path, settings: FlightSettings | None = None) -> bytes:
    """The zip of a stock PPO model with the policy of an on-policy agent's zip, to hand on; SB3 2.4
    and later read it.

    Gone are the optimizer's moments, the last observations and the episodes' statistics; the
    settings are PPO's own, as plain numbers, since SB3's classes of schedules differ from version
    to version. The weights are the same.

    :param settings: how it flies, for the zip to say; None: it says nothing.
    :raises ConfigError: a file that cannot be read, or whose policy is not ``MlpPolicy`` of an
        on-policy algorithm.
    """
    source: Any = load_model(path)
    check_policy(source.policy, f"model {path}")
    if source.use_sde:
        raise ConfigError(f"model {path}: was trained with gSDE (use_sde), which is not handed on")
    kwargs = {
        key: value
        for key, value in source.policy_kwargs.items()
        if key in ("net_arch", "activation_fn")
    }
    model: Any = PPO("MlpPolicy", None, policy_kwargs=kwargs, device="cpu", _init_setup_model=False)  # type: ignore[arg-type]
    model.observation_space, model.action_space, model.n_envs = (
        source.observation_space,
        source.action_space,
        1,
    )
    model._setup_model()
    model.policy.load_state_dict(source.policy.state_dict())
    model.num_timesteps = source.num_timesteps
    if settings is not None:
        settings.write_into(model)
    model.clip_range = 0.2  # plain numbers, of which loading makes the schedules of its own version
    buffer = io.BytesIO()
    model.save(buffer, exclude=["lr_schedule", "clip_range_vf", "start_time"])
    return buffer.getvalue()


def measure(policy: Any, n_flights: int, **settings: Any) -> dict[str, Flights]:
    """The flights of the table's rows, by name: recoveries, then targets at each distance.

    :param n_flights: at each distance.
    :param settings: ``vehicle``, ``noise`` and ``observation_std``, as
        :func:`~sb3_quad.evaluation.flights.fly` takes them.
    """
    parts = [
        fly(policy, "state_recovery", n_flights, seed_for("card", k), **settings)
        for k in range(N_RECOVERIES)
    ]
    rows = {RECOVERY: Flights.concatenate(parts)}
    for name, distance in TARGETS.items():
        task = {"target_distance": distance}
        seed = seed_for("card", int(1000 * distance))
        rows[name] = fly(policy, "target_tracking", n_flights, seed, task_kwargs=task, **settings)
    return rows


def hub_layout(
    name: str, content: bytes, task: Any, flown: Mapping[str, Flights]
) -> tuple[str, dict[str, bytes]]:
    """What huggingface_sb3 puts before a card and beside a zip: the metadata, and the other files
    by their paths.

    :param content: of the zip, whose parts lie unpacked in a folder ``name``.
    :param task: that the agent was trained for; of several the recovery.
    :param flown: what :func:`measure` gave.
    """
    tracks = task == "target_tracking"
    (env_id,) = (each for each, its in ENVIRONMENTS.items() if (its == "target_tracking") == tracks)
    rewards = next(flights.reward for row, flights in flown.items() if (row == RECOVERY) != tracks)
    mean, std = float(rewards.mean()), float(rewards.std())
    metric = {
        "type": "mean_reward",
        "value": f"{mean:.2f} +/- {std:.2f}",
        "name": "mean_reward",
        "verified": False,
    }
    kind, dataset = "reinforcement-learning", {"name": env_id, "type": env_id}
    result = {"task": {"type": kind, "name": kind}, "dataset": dataset, "metrics": [metric]}
    metadata = {
        "library_name": "stable-baselines3",
        "tags": [env_id, "deep-reinforcement-learning", kind, "stable-baselines3"],
        "model-index": [{"name": "PPO", "results": [result]}],
    }
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        files = {f"{name}/{member}": archive.read(member) for member in archive.namelist()}
    config = {
        **json.loads(files[f"{name}/data"]),
        "system_info": stable_baselines3.get_system_info(print_info=False)[0],
    }
    results = {
        "mean_reward": mean,
        "std_reward": std,
        "is_deterministic": True,
        "n_eval_episodes": len(rewards),
        "eval_datetime": datetime.datetime.now().isoformat(),
    }
    files |= {
        f"{key}.json": json.dumps(each).encode()
        for key, each in (("config", config), ("results", results))
    }
    return f"---\n{yaml.safe_dump(metadata, sort_keys=False)}---\n\n", files


def write_card(
    name: str,
    measured: Mapping[str, Metrics],
    command: str,
    facts: Mapping[str, str],
    settings: Mapping[str, Any],
) -> str:
    """The card of a policy, Markdown.

    :param measured: of each row of :func:`measure` with ``settings``.
    :param command: what was typed to train it.
    :param facts: further rows on its training, such as seed, commit and versions.
    """
    rows = []
    for task, metrics in measured.items():
        target, flown = (
            Target(distance=TARGETS.get(task, 0.0)),
            (settings["vehicle"], settings.get("vehicles")),
        )
        limit = Scenario(
            name="card", target=target, vehicle=flown[0], vehicles=flown[1]
        ).physical_limit
        cells = {**metric_cells(metrics), LIMIT: Cell(limit, words="–")}
        if task == RECOVERY:  # begins at its target
            cells |= dict.fromkeys(TIMES, Cell(words="–"))
        rows.append(Row(task, "", [cells[row] for row in SHOWN]))
    columns = [Column(row.heading) for row in SHOWN]
    seen = ObservationSettings.model_validate(
        {key: settings[key] for key in ObservationSettings.model_fields if key in settings}
    )
    loader = jinja2.FileSystemLoader(Path(__file__).parent)
    options: Any = {"undefined": jinja2.StrictUndefined, "keep_trailing_newline": True}
    template = jinja2.Environment(loader=loader, **options).get_template("card.md.j2")
    return template.render(
        name=name,
        frames=", ".join(
            f"{key}={value!r}" for key, value in seen.model_dump(exclude_defaults=True).items()
        ),
        vehicle=f"the vehicle `{settings['vehicle'].name}`"
        if settings.get("vehicles") is None
        else str(settings["vehicles"]),
        noise=in_words(settings["noise"]),
        recoveries=f"{measured[RECOVERY].n:,}",
        targets=f"{next(metrics.n for task, metrics in measured.items() if task != RECOVERY):,}",
        table=Table(columns, rows).markdown(),
        command=command,
        facts=text_table("", ("", ""), facts.items()).markdown(),
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Run it as the commands of sb3-quad are run; returns the exit code."""
    app.COMMANDS["publish"] = sys.modules[__name__]
    try:
        return app.main(["publish", *(sys.argv[1:] if argv is None else argv)])
    finally:
        del app.COMMANDS["publish"]


if __name__ == "__main__":
    sys.exit(main())
