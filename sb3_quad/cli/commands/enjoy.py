"""Watch controllers fly: in PyBullet's window, as a film, or as poses in one picture; several side
by side.

examples:
  sb3-quad enjoy --algo ppo_bc --env QuadStateRecovery-v0 -f logs          the latest run's agent, in a window
  sb3-quad enjoy --algo ppo_bc --env QuadStateRecovery-v0 --exp-id 2 --load-best
  sb3-quad enjoy pid geometric agent=path/to/agent.zip --task state_recovery --seed 13 -o recovery.mp4
  sb3-quad enjoy agent.zip pid --scenario thesis:recovery_s1 -o s1.png
  sb3-quad enjoy agent.zip --scenario thesis:side_hit -o hit.mp4 --speed 0.5
  sb3-quad enjoy geometric --env-kwargs noise:0 vehicle:my_vehicle.yaml -n 3000 --no-render

A controller is pid, geometric, the path of an SB3 zip or a run folder, or package.module:factory;
name=… labels it. The first agent says which vehicle, task and observation all fly with, unless
--env, --task, --scenario or --env-kwargs do. Without --load-…, the agent of a run is
corrected_model.zip, else best_model.zip, else <Env>.zip.
"""

import argparse
import io
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sb3_quad.base.errors import ConfigError, unknown
from sb3_quad.base.files import refuse_existing, write_bytes
from sb3_quad.cli.parser import PAIRS, Parser, above_zero, add_common, natural, positive, whole
from sb3_quad.envs.registration import ENVIRONMENTS

DEFAULT_ENV = "QuadTargetTracking-v0"
LAST = "last checkpoint"
SINGLE, PANEL = (
    (640, 480),
    (480, 480),
)  # width and height of the only panel, and of one of several, pixels


def add_arguments(parser: Parser) -> None:
    """Add the flags of rl-zoo's ``enjoy.py``, with their meanings, and those of what is flown and
    how it is shown.
    """
    add = parser.add_argument
    add(
        "controllers",
        nargs="*",
        metavar="CONTROLLER",
        help="who flies, besides the agent of --algo",
    )
    add("--algo", help="algorithm of a trained agent, looked up in the log folder")
    task = parser.add_mutually_exclusive_group()
    task.add_argument("--env", help=f"environment id ({DEFAULT_ENV})")
    task.add_argument(
        "--task", metavar="NAME", help="a task such as target_tracking, instead of --env"
    )
    task.add_argument(
        "--scenario",
        metavar="SUITE:NAME",
        help="a scenario, such as thesis:side_hit, instead of --env",
    )
    add(
        "-f",
        "--folder",
        "--log-folder",
        default="logs",
        metavar="DIR",
        help="folder that holds the run folders (logs)",
    )
    add(
        "--exp-id",
        type=int,
        default=0,
        metavar="N",
        help="number of the run; 0: the latest with an agent (0)",
    )
    which = parser.add_mutually_exclusive_group()
    best: dict[str, Any] = {"dest": "which", "action": "store_const", "const": "best"}
    which.add_argument("--load-best", help="the best agent of the evaluations", **best)
    which.add_argument(
        "--load-checkpoint",
        dest="which",
        type=whole,
        metavar="N",
        help="the checkpoint after N timesteps",
    )
    which.add_argument("--load-last-checkpoint", help=f"the {LAST}", **{**best, "const": LAST})
    add(
        "-n",
        "--n-timesteps",
        type=positive,
        metavar="N",
        help="control steps, in as many episodes as needed (one episode)",
    )
    add(
        "--n-envs",
        type=positive,
        default=1,
        metavar="N",
        help="episodes side by side, with consecutive seeds (1)",
    )
    add(
        "--seed",
        type=natural,
        default=0,
        metavar="N",
        help="seed of the first episode (0); later ones count up",
    )
    actions = parser.add_mutually_exclusive_group()
    actions.add_argument(
        "--deterministic", action="store_true", help="fly the mean of a policy's actions (default)"
    )
    actions.add_argument("--stochastic", action="store_true", help="sample from a policy's actions")
    add("--env-kwargs", default={}, help="environment keywords, such as noise:0", **PAIRS)
    add("--target", nargs=3, type=float, metavar=("X", "Y", "Z"), help="where to fly to, m")
    add("--no-render", action="store_true", help="only fly and print how it went")
    output = "write films (.mp4, .webp, .gif) or the first episode as poses in one picture (.png) instead of opening a window"
    add("-o", "--output", nargs="+", default=[], metavar="FILE", help=output)
    add("--size", type=_size, metavar="WxH", help="size of one controller's panel, pixels")
    add(
        "--speed",
        type=above_zero,
        default=1.0,
        metavar="X",
        help="playback speed of film and window; 0.5 is slow motion (1)",
    )
    add_common(parser, "trust", "overwrite", "progress")


def _size(text: str) -> tuple[int, int]:
    try:
        width, height = (int(part) for part in text.lower().split("x"))
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"{text}: must be width and height in pixels, such as 640x480"
        ) from None
    return width, height


def run(options: argparse.Namespace) -> int:
    """Fly, show, print how it went. Returns the exit code."""
    from rich.console import Console

    from sb3_quad.show.episodes import fly_all
    from sb3_quad.show.film import show_in_window

    window = not (options.no_render or options.output)
    _check(options, window)
    setting, controllers = _setting(options)
    how = options.seed, options.n_timesteps, not options.stochastic, options.n_envs
    with Console(file=sys.stderr).status("flying"):
        episodes = list(fly_all(controllers, setting, *how))
    for number, episode in enumerate(episodes, 1):
        for recording in episode:
            end = recording.lost or f"{recording.state.distance[-1]:.3f} m from its target"
            head = f"episode {number}, {recording.name}" if len(episodes) > 1 else recording.name
            print(f"{head}: {end} after {recording.times[-1]:.2f} s, reward {recording.reward:.2f}")
    size = options.size or (PANEL if len(episodes[0]) > 1 else SINGLE)
    for file in options.output:
        if file.lower().endswith(".png"):
            _write_sequence(file, episodes[0], size)
        else:
            _write_film(file, episodes, size, options)
    if window:
        width, height = options.size or SINGLE
        show_in_window(episodes, width, height, options.speed)
    return 0


def _agent_of_run(options: argparse.Namespace, env_id: str) -> tuple[str, str]:
    """Name and path of the agent of the run that ``--algo``, ``--env``, ``--exp-id`` and
    ``--load-…`` name.

    :raises ConfigError: no such run or file, settings that cannot be read, or a wrapper that enjoy
        does not have.
    """
    from sb3_quad.training.algorithms import get_algorithm
    from sb3_quad.training.runs import find_run

    if not (Path(options.folder) / options.algo).is_dir():
        get_algorithm(options.algo)  # raises if there is none of that name
    run = find_run(options.folder, options.algo, env_id, options.exp_id)
    if isinstance(options.which, int):
        path = run.checkpoint(options.which)
    elif options.which == LAST:
        path = run.latest_checkpoint()
    else:
        path = run.best_model if options.which == "best" else run.result
    if not path.is_file():
        zips = ", ".join(sorted(each.name for each in run.path.glob("*.zip")))
        raise ConfigError(f"{path}: no such file; the run holds {zips}")
    settings, _ = run.read_yaml()
    for key in ("env_wrapper", "vec_env_wrapper", "frame_stack", "normalize"):
        if settings.get(key):
            raise ConfigError(
                f"{run.path}: was trained with {key}, which enjoy does not put around the environment"
            )
    return f"{options.algo} {path.name}", str(path)


def _check(options: argparse.Namespace, window: bool) -> None:
    """Refuse what can be refused before anything is flown."""
    from sb3_quad.envs.rendering.window import has_display
    from sb3_quad.show.film import check_film
    from sb3_quad.simulation.checks import check_size

    if not (options.controllers or options.algo):
        raise ConfigError(
            "nobody to fly: name a controller, such as pid or agent.zip, or a run by --algo and --env"
        )
    if options.size:
        check_size(*options.size)
    for file in options.output:
        if not file.lower().endswith(".png"):
            check_film(Path(file))
        refuse_existing(file, options.overwrite)
    if window and not has_display():
        raise ConfigError(
            "no display to open a window on (DISPLAY is not set); -o flight.mp4 makes a film instead"
        )


def _setting(options: argparse.Namespace) -> tuple[Any, dict[str, Any]]:
    """What is flown, a :class:`~sb3_quad.show.episodes.Setting`, and who flies, by label."""
    from sb3_quad.cli.output import warn
    from sb3_quad.controllers.resolve import resolve_expert
    from sb3_quad.evaluation.controllers import ControllerSpec, parse_controllers
    from sb3_quad.show.episodes import fixed_setting, scenario_setting
    from sb3_quad.simulation.settings import FlightSettings
    from sb3_quad.vehicles.vehicle import first_vehicle

    env_id, specs = options.env or DEFAULT_ENV, parse_controllers(options.controllers)
    if env_id not in ENVIRONMENTS:
        raise ConfigError(
            unknown("environment", env_id, ENVIRONMENTS) + "; others are shown by rl_zoo3.enjoy"
        )
    if options.algo:
        specs.insert(0, ControllerSpec(*_agent_of_run(options, env_id)))
        print(f"agent: {specs[0].spec}")
    agents = [
        spec.own for spec in specs if spec.own is not None
    ]  # the first says how all are flown
    if options.scenario is not None:
        if options.env_kwargs or options.target:
            raise ConfigError(
                "--scenario says all about a flight; leave --env-kwargs and --target away"
            )
        setting = scenario_setting(options.scenario, agents[0].vehicle if agents else None)
    else:
        kept = agents[0] if agents else FlightSettings(task=ENVIRONMENTS[env_id])
        task = options.task or (
            ENVIRONMENTS[env_id] if options.env and not options.algo else kept.task
        )
        changes = (
            {"task": task}
            | ({} if task == kept.task else {"task_kwargs": None})
            | options.env_kwargs
        )
        setting = fixed_setting(kept.with_changes(**changes), options.target)
    controllers, own = {}, {}
    vehicle = first_vehicle(setting.vehicle, options.env_kwargs.get("rotor_layout"))
    for spec in specs:
        warn(spec.notice(vehicle))
        controllers[spec.label] = resolve_expert(spec.spec, vehicle, "controller")
        own[spec.label] = {
            name: value for name, value in spec.observed.items() if name not in options.env_kwargs
        }
    return setting._replace(own=own), controllers


def _write_sequence(file: str, episode: Sequence[Any], size: tuple[int, int]) -> None:
    from PIL import Image

    from sb3_quad.show.sequence import sequence

    buffer = io.BytesIO()
    Image.fromarray(sequence(episode, *size)).save(buffer, format="png", optimize=True)
    write_bytes(file, buffer.getvalue())
    print(f"saved {file}")


def _write_film(
    file: str, episodes: Sequence[Sequence[Any]], size: tuple[int, int], options: argparse.Namespace
) -> None:
    from rich.console import Console
    from rich.progress import track

    from sb3_quad.cli.output import shows_progress
    from sb3_quad.show.film import FPS, film_frames, frame_times, write_film

    total = sum(len(frame_times(episode, options.speed)) for episode in episodes)
    frames = (frame for episode in episodes for frame in film_frames(episode, *size, options.speed))
    where: dict[str, Any] = {
        "console": Console(file=sys.stderr, force_terminal=options.progress or None),
        "transient": True,
    }
    write_film(
        Path(file),
        track(frames, "frames", total, disable=not shows_progress(options.progress), **where),
    )
    print(f"saved {file}, {total / FPS:.1f} s")
