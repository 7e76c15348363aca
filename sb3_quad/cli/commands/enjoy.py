r"""Watch controllers fly, in a window or as a film.

Several controllers fly the same episodes side by side.

examples:
  # the agent of the latest run, in a window
  sb3-quad enjoy --algo ppo_bc --env QuadStateRecovery-v0 -f logs
  # the best agent of run 2
  sb3-quad enjoy --algo ppo_bc --env QuadStateRecovery-v0 --exp-id 2 --load-best
  # a film with a panel for each of three controllers
  sb3-quad enjoy pid geometric agent=path/to/agent.zip --task state_recovery \
    --seed 13 -o recovery.mp4
  # a scenario in slow motion
  sb3-quad enjoy agent.zip --scenario thesis:side_hit -o hit.mp4 --speed 0.5
  # along a curve, drawn in green
  sb3-quad enjoy itm-robust --env-kwargs reference:figure_eight -o eight.mp4
  # your own vehicle without noise, printed only
  sb3-quad enjoy geometric --vehicle my_vehicle.yaml --env-kwargs noise:0 \
    -n 3000 --no-render

A controller is pid, geometric, the path of an SB3 zip or a run folder, or
package.module:factory. NAME=CONTROLLER labels it. The settings of the first
agent (vehicle, task and observation) hold for all, unless you give --env,
--task, --scenario or --env-kwargs. Without --load-…, the agent of a run is
corrected_model.zip, else best_model.zip, else <Env>.zip.
"""

import sys
from argparse import ArgumentTypeError, Namespace
from itertools import chain
from pathlib import Path
from typing import Any

from pydantic import NonNegativeInt, PositiveFloat, PositiveInt

from sb3_quad.base.errors import ConfigError, refuse_unknown
from sb3_quad.base.files import refuse_existing
from sb3_quad.base.types import StrDict
from sb3_quad.cli.parser import (
    OVERWRITE,
    PAIRS,
    SWITCH,
    TRUST,
    Flags,
    given,
)
from sb3_quad.envs.registration import ENVIRONMENTS
from sb3_quad.training.options import DEFAULT_ENV

# Width and height of the only panel, and of one of several, pixels.
SINGLE = (640, 480)
PANEL = (480, 480)
# The flags that say which agent of --algo flies.
AGENT_OF_RUN = ("folder", "exp_id", "load_best", "load_checkpoint", "load_last_checkpoint")


def _size(text: str) -> tuple[int, int]:
    try:
        width, height = text.lower().split("x")
        return int(width), int(height)
    except ValueError:
        raise ArgumentTypeError(
            f"{text}: must be width and height in pixels, such as 640x480"
        ) from None


# Those of rl-zoo's ``enjoy.py``, with their meanings, and those of this command.
FLAGS: Flags = {
    # The run folder, and the agent in it.
    "--algo": "algorithm of a trained agent, which is looked up in the log folder",
    "-f --folder --log-folder DIR": (str, None, "folder that holds the run folders (logs)"),
    "--exp-id N": (NonNegativeInt, None, "number of the run (0: the latest one that has an agent)"),
    "agent": {
        "--load-best": (SWITCH, None, "fly the best agent of the evaluations"),
        "--load-checkpoint N": (NonNegativeInt, "fly the checkpoint after N timesteps"),
        "--load-last-checkpoint": (SWITCH, None, "fly the last checkpoint"),
    },
    "episode": {
        "--env": f"environment id ({DEFAULT_ENV})",
        "--task": "a task such as target_tracking, instead of --env",
        "--scenario SUITE:NAME": "a scenario such as thesis:side_hit, instead of --env",
    },
    "controllers CONTROLLER": (
        {"nargs": "*"},
        "controllers to fly, in addition to the agent of --algo",
    ),
    "-n --n-timesteps N": (
        PositiveInt,
        "control steps, in as many episodes as needed (one episode)",
    ),
    "--stochastic": (SWITCH, "sample a policy's actions instead of flying their mean"),
    "--seed N": (NonNegativeInt, 0, "seed of the first episode; later ones count up (0)"),
    "--env-kwargs": (
        PAIRS,
        {},
        "environment keywords, such as noise:0 or reference:figure_eight",
    ),
    "--vehicle": "vehicle, by name or YAML file (the scenario's, else the first agent's own)",
    "--no-render": (SWITCH, "only fly and print the results"),
    "-o --output FILE": "write a film of all episodes (.mp4, .webp or .gif)",
    "--size WxH": (_size, "size of one controller's panel, pixels"),
    "--speed X": (PositiveFloat, 1.0, "playback speed of film and window; 0.5 is slow motion (1)"),
    **TRUST,
    **OVERWRITE,
}


def run(options: Namespace) -> int:
    """Fly, print the results, show the flights. Returns the exit code."""
    from rich.console import Console

    from sb3_quad.show.episodes import fly_all
    from sb3_quad.show.film import film_frames, show_in_window, write_film

    window = not (options.no_render or options.output)
    _check(options, window)
    setting, controllers = _setting(options)
    console = Console(file=sys.stderr)
    with console.status("flying"):
        episodes = list(
            fly_all(controllers, setting, options.seed, options.n_timesteps, not options.stochastic)
        )
    for number, episode in enumerate(episodes, 1):
        for flight in episode:
            prefix = f"episode {number}, " if len(episodes) > 1 else ""
            print(f"{prefix}{flight.name}: {flight.end}, reward {flight.flights.reward[0]:.2f}")
    width, height = options.size or (PANEL if len(controllers) > 1 else SINGLE)
    films = (film_frames(episode, width, height, options.speed) for episode in episodes)
    frames = chain.from_iterable(films)
    if window:
        show_in_window(frames, width * len(controllers), height)
    elif options.output:
        with console.status("drawing"):
            write_film(Path(options.output), frames)
        print("saved", options.output)
    return 0


def _check(options: Namespace, window: bool) -> None:
    """Refuse what can be refused before anything flies.

    :raises ConfigError: No controller, a bad size or file, or no display for a window.
    """
    from sb3_quad.envs.rendering.window import has_display
    from sb3_quad.envs.simulation.checks import check_size
    from sb3_quad.show.film import check_film

    if not (options.controllers or options.algo):
        raise ConfigError(
            "no controller given: name one, such as pid or agent.zip, or a run by --algo and --env"
        )
    if not options.algo:
        for name in given(options, *AGENT_OF_RUN):
            flag = name.replace("_", "-")
            raise ConfigError(f"--{flag} chooses a run's agent, so it needs --algo; remove it")
    for name in given(options, "vehicle", "task").keys() & options.env_kwargs.keys():
        raise ConfigError(f"{name}: given by --{name} and by --env-kwargs; remove one of them")
    env_id = options.env or DEFAULT_ENV
    refuse_unknown("environment", [env_id], ENVIRONMENTS, "; rl_zoo3.enjoy shows others")
    if options.size:
        check_size(*options.size)
    if options.output:
        check_film(Path(options.output))
        refuse_existing(options.output, options.overwrite)
    if window and not has_display():
        raise ConfigError(
            "no display to open a window on (DISPLAY is not set); "
            "-o flight.mp4 makes a film instead"
        )


def _setting(options: Namespace) -> tuple[Any, StrDict]:
    """Return the :class:`~sb3_quad.show.episodes.Setting` of all, and the controllers by label."""
    from sb3_quad.agents.resolve import resolve_expert
    from sb3_quad.cli.output import warn
    from sb3_quad.envs.vehicles.vehicle import first_vehicle
    from sb3_quad.evaluation.controllers import ControllerSpec, parse_controllers
    from sb3_quad.show.episodes import Setting, scenario_setting

    specs = parse_controllers(options.controllers)
    if options.algo:
        specs.insert(0, ControllerSpec(*_agent_of_run(options)))
        print("agent:", specs[0].spec)
    # The settings of the first agent hold for all.
    first = next(filter(None, (spec.own for spec in specs)), None)
    if options.scenario is None:
        setting = Setting(_flight_settings(options, first))
    elif options.env_kwargs:
        raise ConfigError("--scenario describes a whole flight; remove --env-kwargs")
    else:
        setting = scenario_setting(options.scenario, first, options.vehicle)
    controllers = {}
    # What an agent observes stays as in its training, unless the command line says otherwise.
    observed = {}
    vehicle = first_vehicle(setting.settings.vehicle, options.env_kwargs.get("rotor_layout"))
    for spec in specs:
        warn(spec.notice(vehicle))
        action = options.env_kwargs.get("action", "thrusts")
        controllers[spec.label] = resolve_expert(spec.spec, vehicle, "controller", action=action)
        observed[spec.label] = {
            name: spec.observed[name] for name in spec.observed.keys() - options.env_kwargs.keys()
        }
    return setting._replace(own=observed), controllers


def _flight_settings(options: Namespace, first: Any) -> Any:
    """Return the :class:`~sb3_quad.envs.simulation.settings.FlightSettings` of all flights.

    :param first: Those of the first agent, or None.
    """
    from sb3_quad.envs.simulation.settings import FlightSettings

    env_task = ENVIRONMENTS[options.env or DEFAULT_ENV]
    settings = first or FlightSettings(task=env_task)
    changes = given(options, "vehicle")
    # With --algo, --env names the environment of the run rather than the task.
    task = options.task or (options.env and not options.algo and env_task)
    if task and task != settings.task:
        # The agent's changes to its own task do not fit another one.
        changes |= {"task": task, "task_kwargs": None}
    return settings.with_changes(**changes | options.env_kwargs)


def _agent_of_run(options: Namespace) -> tuple[str, str]:
    """Return label and path of the agent of the run that ``--algo``, ``--env``, ``--exp-id`` and
    ``--load-…`` name.

    :raises ConfigError: No such run or file.
    """
    from sb3_quad.training.algorithms import get_algorithm
    from sb3_quad.training.runs import find_run

    folder = options.folder or "logs"
    if not (Path(folder) / options.algo).is_dir():
        # Raises if there is no such algorithm.
        get_algorithm(options.algo)
    run = find_run(folder, options.algo, options.env or DEFAULT_ENV, options.exp_id or 0)
    if options.load_last_checkpoint:
        path = run.latest_checkpoint()
    elif options.load_best:
        path = run.best_model
    elif options.load_checkpoint is not None:
        path = run.checkpoint(options.load_checkpoint)
    else:
        path = run.result
    if not path.is_file():
        zips = sorted(file.name for file in run.path.glob("*.zip"))
        raise ConfigError(f"{path}: no such file; the run holds {', '.join(zips)}")
    return f"{options.algo} {path.name}", str(path)
