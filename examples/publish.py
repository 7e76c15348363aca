r"""Write a trained policy as a small zip for stock PPO, with a card.

The card holds measured metrics, the command that trained the policy, seed and versions.

    python examples/publish.py logs/ppo_bc/QuadStateRecovery-v0_1/corrected_model.zip \
        --name my-agent
    python examples/publish.py logs/ppo/QuadStateRecovery-v0_2/best_model.zip --name other \
        --command "my.py" -o published

The zip contains only the weights and plain numbers, so that other versions of Stable-Baselines3 can
read it, too. For the card the policy flies fresh episodes: 3,840 recoveries, 960 targets at each of
10, 15 and 20 m, and 960 figures of eight. The run folder says how it was trained; the card calls
anything else "not recorded". The agents of the package were made in this way.

With --hub it writes a folder for the Hugging Face Hub instead: the zip, the card as README.md, and
replay.mp4, the film that the Hub shows. Upload it by `hf upload ORG/my-agent my-agent`; then
anybody flies it as `hf:ORG/my-agent`, or loads it by `huggingface_sb3.load_from_hub`.

    python examples/publish.py logs/ppo_bc/QuadStateRecovery-v0_1 --name my-agent --hub
"""

import argparse
import io
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2
import yaml
from pydantic import PositiveInt
from stable_baselines3 import PPO

from sb3_quad.agents.agent_settings import agent_settings
from sb3_quad.agents.pretrained import agent_path
from sb3_quad.agents.zips import load_model, saved_algorithm, saved_data
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import read_text, refuse_existing, replacing
from sb3_quad.base.seeds import seed_for
from sb3_quad.cli import app
from sb3_quad.cli.parser import OVERWRITE, SWITCH, TRUST, Flags
from sb3_quad.envs.simulation.frames import ObservationSettings
from sb3_quad.envs.simulation.settings import FlightSettings, in_words
from sb3_quad.envs.vehicles.vehicle import load_vehicle
from sb3_quad.evaluation.flights import Flights, fly
from sb3_quad.evaluation.metric_tables import (
    FOLLOWING,
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
from sb3_quad.evaluation.scenarios.scenario import Scenario
from sb3_quad.evaluation.tables import Table
from sb3_quad.export.network import check_policy
from sb3_quad.training.runs import MADE_WITH, open_run

UNKNOWN = "not recorded"
COMMANDS = {
    "thrusts": "the thrusts of the rotors",
    "rates": "the collective thrust and the body rates (`action: rates`)",
}

N_RECOVERIES = 4  # times as many recoveries as targets at each distance
RECOVERY = "state recovery"
FIGURE_EIGHT = "figure eight, 2 m/s"
TARGETS = {"targets 10 m away": 10.0, "targets 15 m away": 15.0, "targets 20 m away": 20.0}  # m
RMS_ERROR = FOLLOWING[0]
TIMES = (settling_row(0.1), LIMIT, time_row(0.1))
SHOWN = (SUCCESS, SURVIVAL, REWARD, *TIMES, MEDIAN, QUANTILE, RMS_ERROR)


FLAGS: Flags = {
    "model MODEL": (
        "an agent of an on-policy algorithm (PPO, A2C, DAgger, PPOBC, APG) with MlpPolicy: "
        "a zip or a run folder"
    ),
    "--name NAME": ({"required": True}, "name of the files, NAME.zip and NAME.md"),
    "-o FOLDER": ({"dest": "folder"}, ".", "folder for both (here)"),
    "--command TEXT": (
        {"dest": "made_by"},
        "the command that trained it (command.txt of the run)",
    ),
    "--episodes N": (PositiveInt, 960, "episodes of each task (960; recoveries: 4 times as many)"),
    "--hub": (SWITCH, "write a folder NAME for the Hugging Face Hub, with a film"),
    **TRUST,
    **OVERWRITE,
}
# A flight of the film: control steps, and the panel's size.
FILM = ("--task", "state_recovery", "-n", "400", "--size", "480x480")


def run(options: argparse.Namespace) -> int:
    """Make the zip small, fly it, write zip and card. Returns the exit code."""
    if file_name(options.name) != options.name:
        raise ConfigError(
            f"--name {options.name!r}: letters, digits and, between them, '_', '.' and '-'; "
            "folders are for -o"
        )
    folder = Path(options.folder)
    card_name = f"{options.name}.md"
    if options.hub:
        folder /= options.name
        card_name = "README.md"
    zip_file = folder / f"{options.name}.zip"
    card_file = folder / card_name
    film = folder / "replay.mp4"
    for path in (zip_file, card_file, *[film] * options.hub):
        refuse_existing(path, options.overwrite)
    model = Path(agent_path(options.model))
    settings, source = agent_settings(model)
    content = slim_bytes(model, settings if source else None)
    command, facts = _origin(model)
    if not source:
        facts["vehicle"] = f"{UNKNOWN}; measured on `{settings.vehicle}`"
    how = {
        "noise": settings.noise,
        **settings.in_any_task(),
        "vehicle": load_vehicle(settings.vehicle),
    }
    # Both files are written, or none.
    with replacing(zip_file) as zip_stream, replacing(card_file) as card_stream:
        zip_stream.write(content)
        zip_stream.flush()
        flown = measure(load_model(zip_stream.name), options.episodes, **how)
        rows = {name: summarise(flights) for name, flights in flown.items()}
        text = write_card(options.name, rows, options.made_by or command, facts, how)
        front = hub_metadata(rows) if options.hub else ""
        card_stream.write((front + text).encode())
    if options.hub and app.main(["enjoy", str(zip_file), *FILM, "-o", str(film), "--overwrite"]):
        return 1
    print(text)
    print(f"saved {zip_file} ({len(content)} bytes) and {card_file}")
    return 0


def _origin(model: Path) -> tuple[str, dict[str, str]]:
    """Return the command that trained an agent, and further facts.

    Facts that are in neither its zip nor its run folder are UNKNOWN.
    """
    algorithm = saved_algorithm(model)
    timesteps = f"{saved_data(model)['num_timesteps']:,} timesteps"
    if not any(model.parent.glob("*/args.yml")):
        return f"# {UNKNOWN}", {"algorithm": f"`{algorithm}`, {timesteps}", "run": UNKNOWN}
    run = open_run(model.parent)
    settings, arguments = run.read_yaml()
    trained = f"`{_plain(arguments.get('algo', algorithm))}`, {timesteps}"
    start = arguments.get("initial_policy")
    if start:
        trained += f" from `{_plain(Path(start).name)}`"
    facts = {"algorithm": trained, "environment": f"`{_plain(arguments.get('env', run.name))}`"}
    # With bc_coef 0 the expert labels nothing.
    if settings.get("expert") and settings.get("bc_coef") != 0:
        facts["expert"] = f"`{_plain(settings['expert'])}`"
    for name in ("seed", *MADE_WITH):
        facts[name] = _plain(arguments.get(name, UNKNOWN))
    command = f"# {UNKNOWN}"
    if run.command.is_file():
        command = _plain(read_text(run.command))
    return command, facts


def _plain(text: Any) -> str:
    """One line that cannot end a code span or fence of the card, whatever a run folder contains."""
    return " ".join(str(text).split()).replace("`", "'")


def slim_bytes(path: str | Path, settings: FlightSettings | None = None) -> bytes:
    """Turn an on-policy agent's zip into one of stock PPO, which SB3 2.4 and later read.

    The weights are the same. The zip leaves out the optimizer's moments, the last observations and
    the episodes' statistics. Its settings are PPO's own, as plain numbers, since SB3's schedule
    classes differ between versions.

    :param settings: how the agent flies, for the zip to record; None: it records nothing.
    :raises ConfigError: if the file cannot be read, or if its policy is not ``MlpPolicy`` of an
        on-policy algorithm.
    """
    source: Any = load_model(path)
    check_policy(source.policy, f"model {path}")
    if source.use_sde:
        raise ConfigError(f"model {path}: was trained with gSDE (use_sde), which is not handed on")
    kwargs = {}
    for key in ("net_arch", "activation_fn"):
        if key in source.policy_kwargs:
            kwargs[key] = source.policy_kwargs[key]
    # Without an environment, whose spaces are set by hand, since nothing has to fly here.
    stock: Any = PPO
    model = stock("MlpPolicy", None, policy_kwargs=kwargs, device="cpu", _init_setup_model=False)
    model.observation_space = source.observation_space
    model.action_space = source.action_space
    model.n_envs = 1
    model._setup_model()
    model.policy.load_state_dict(source.policy.state_dict())
    model.num_timesteps = source.num_timesteps
    if settings is not None:
        settings.write_into(model)
    # A plain number, from which the version of SB3 that loads it makes its own schedule.
    model.clip_range = 0.2
    buffer = io.BytesIO()
    model.save(buffer, exclude=["lr_schedule", "clip_range_vf", "start_time"])
    return buffer.getvalue()


def measure(policy: Any, n_episodes: int, **settings: Any) -> dict[str, Flights]:
    """Fly for the rows of the table: recoveries, targets at each distance, figures of eight.

    :param n_episodes: episodes at each distance.
    :param settings: ``vehicle``, ``noise`` and ``observation_std``, as
        :func:`~sb3_quad.evaluation.flights.fly` takes them.
    :returns: flights by the name of the row.
    """
    parts = []
    for number in range(N_RECOVERIES):
        seed = seed_for("card", number)
        parts.append(fly(policy, "state_recovery", n_episodes, seed, **settings))
    rows = {RECOVERY: Flights.concatenate(parts)}
    for name, distance in TARGETS.items():
        task = {"target_distance": distance}
        seed = seed_for("card", int(1000 * distance))
        rows[name] = fly(policy, "target_tracking", n_episodes, seed, task_kwargs=task, **settings)
    # From a hover at its start.
    task = {"target_distance": 0.0}
    how = {**settings, "task_kwargs": task, "reference": {"curve": "figure_eight", "speed": 2.0}}
    rows[FIGURE_EIGHT] = fly(policy, "target_tracking", n_episodes, seed_for("card", 8), **how)
    return rows


def write_card(
    name: str,
    measured: Mapping[str, Metrics],
    command: str,
    facts: Mapping[str, str],
    settings: Mapping[str, Any],
) -> str:
    """Write the card of a policy in Markdown.

    :param measured: metrics of each row of :func:`measure` with ``settings``.
    :param command: command that trained it.
    :param facts: further rows about its training, such as seed, commit and versions.
    """
    vehicle = settings["vehicle"]
    vehicles = settings.get("vehicles")
    rows = []
    for task, metrics in measured.items():
        scenario = Scenario(
            name="card",
            task_kwargs={"target_distance": TARGETS.get(task, 0.0)},
            vehicle=vehicle,
            vehicles=vehicles,
        )
        cells = dict(metric_cells(metrics))
        if scenario.physical_limit is not None:
            cells[LIMIT] = LIMIT.number(scenario.physical_limit)
        # These begin at their targets, so times to them are meaningless.
        if task not in TARGETS:
            cells |= dict.fromkeys(TIMES, "–")
        rows.append([task, *(cells.get(row, "–") for row in SHOWN)])
    heads = ["", *(row.heading for row in SHOWN)]
    known = {key: settings[key] for key in ObservationSettings.model_fields if key in settings}
    seen = ObservationSettings.model_validate(known).model_dump(exclude_defaults=True)
    flies = f"the vehicle `{vehicle.name}`" if vehicles is None else str(vehicles)
    targets = measured[next(iter(TARGETS))].n
    text = read_text(Path(__file__).with_name("card.md.j2"))
    template = jinja2.Template(text, undefined=jinja2.StrictUndefined, keep_trailing_newline=True)
    return template.render(
        name=name,
        frames=", ".join(f"{key}={value!r}" for key, value in seen.items()),
        vehicle=flies,
        noise=in_words(settings["noise"]),
        commands=COMMANDS[settings.get("action", "thrusts")],
        recoveries=f"{measured[RECOVERY].n:,}",
        targets=f"{targets:,}",
        table=Table(heads, rows).markdown(),
        command=command,
        facts=Table(("", ""), [*facts.items()]).markdown(),
    )


def hub_metadata(measured: Mapping[str, Metrics]) -> str:
    """Return the front matter by which the Hub lists an agent, with its mean rewards."""
    results = []
    for task, metrics in measured.items():
        env = "QuadStateRecovery-v0" if task == RECOVERY else "QuadTargetTracking-v0"
        reward = {"type": "mean_reward", "name": task, "value": round(metrics.reward.value, 3)}
        results.append(
            {
                "task": {"type": "reinforcement-learning"},
                "dataset": {"name": env, "type": env},
                "metrics": [reward],
            }
        )
    data = {
        "library_name": "stable-baselines3",
        "tags": ["reinforcement-learning", "deep-reinforcement-learning", "stable-baselines3"],
        "model-index": [{"name": "PPO", "results": results}],
    }
    return f"---\n{yaml.safe_dump(data, sort_keys=False)}---\n\n"


def main(argv: Sequence[str] | None = None) -> int:
    """Run it as a command of sb3-quad. Returns the exit code."""
    if argv is None:
        argv = sys.argv[1:]
    app.COMMANDS["publish"] = sys.modules[__name__]
    try:
        return app.main(["publish", *argv])
    finally:
        del app.COMMANDS["publish"]


if __name__ == "__main__":
    sys.exit(main())
