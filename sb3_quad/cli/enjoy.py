"""``enjoy``: watch controllers fly, in a window, a film, or a sequence of poses in one picture."""

from __future__ import annotations

import argparse
import io
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_quad.base.errors import ConfigError, unknown
from sb3_quad.cli.arguments import pairs, whole

if TYPE_CHECKING:
    from sb3_quad.show.agents import Agent
    from sb3_quad.show.episodes import Setting
    from sb3_quad.show.recording import Recording

SINGLE, PANEL = (640, 480), (480, 480)  # width and height of the only panel, and of one of several, pixels
DEFAULT_ENV = "QuadTargetTracking-v0"

HELP = "Watch controllers fly: in PyBullet's window, as a film, or as poses in one picture; several side by side."
EXAMPLES = """examples:
  sb3-quad enjoy --algo ppo_bc --env QuadStateRecovery-v0 -f logs          the latest run's agent, in a window
  sb3-quad enjoy --algo ppo_bc --env QuadStateRecovery-v0 --exp-id 2 --load-best
  sb3-quad enjoy pid geometric agent=path/to/agent.zip --task state_recovery --seed 13 --record recovery.mp4
  sb3-quad enjoy agent.zip pid --scenario thesis:recovery_s1 --sequence s1.png
  sb3-quad enjoy agent.zip --target 5 0 20 --force -20 -20 0 --torque -5 -5 -5 --at 2.5 --for 0.02 --record hit.mp4 --speed 0.5
  sb3-quad enjoy geometric --env-kwargs noise:0 vehicle:my_vehicle.yaml -n 3000 --no-render

A controller is pid, geometric, the path of an SB3 zip, or package.module:factory; name=… in front labels it.
Without --load-…, a run's agent is trimmed_model.zip, else best_model.zip, else <Env>.zip.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The flags of rl-zoo's ``enjoy.py``, with their meanings, and those of what is flown and how it is shown."""
    add = parser.add_argument
    add("controllers", nargs="*", metavar="CONTROLLER", help="who flies, beside the agent of --algo")
    add_flight_arguments(parser)
    parser.set_defaults(trained_agent=None)
    add("-n", "--n-timesteps", type=whole, metavar="N", help="control steps, over as many episodes as they last (one episode)")
    add("--no-render", action="store_true", help="only fly, and print how it went")
    add("--task", metavar="NAME", help="target_tracking or state_recovery, instead of --env")
    add("--scenario", metavar="SUITE:NAME", help="a scenario of a suite, such as thesis:side_hit, instead of --env")
    add("--target", nargs=3, type=float, metavar=("X", "Y", "Z"), help="where to fly, m")
    add("--force", nargs=3, type=float, metavar=("X", "Y", "Z"), help="an external force, world frame, N")
    add("--torque", nargs=3, type=float, metavar=("X", "Y", "Z"), help="an external torque, body frame, N m")
    add("--at", type=float, metavar="S", help="when force and torque begin, s (0)")
    add("--for", dest="lasting", type=float, metavar="S", help="how long they act, s (to the end)")
    add("--record", metavar="FILE", help="write a film instead of opening a window: .mp4 or .gif")
    add("--sequence", metavar="FILE", help="write the first episode as poses in one picture: .png")
    add("--times", nargs="+", type=float, metavar="S", help="at which the sequence shows poses, s (where they do not overlap)")


def add_flight_arguments(parser: argparse.ArgumentParser) -> None:
    """The flags of rl-zoo's ``enjoy.py`` for an agent and its episodes, with their meanings, and those of a film."""
    add = parser.add_argument
    add("--algo", help="algorithm of a trained agent, looked up in the log folder")
    add("--env", help=f"environment id ({DEFAULT_ENV})")
    add("-f", "--folder", "--log-folder", default="logs", metavar="DIR", help="where run folders are (logs)")
    add("--exp-id", type=int, default=0, metavar="N", help="number of the run; 0: the latest (0)")
    which = parser.add_mutually_exclusive_group()
    which.add_argument(
        "--load-best", dest="which", action="store_const", const="best", help="the best agent of the evaluations"
    )
    which.add_argument("--load-checkpoint", dest="which", type=whole, metavar="N", help="the checkpoint after N timesteps")
    last = "last checkpoint"
    which.add_argument("--load-last-checkpoint", dest="which", action="store_const", const=last, help=f"the {last}")
    add("--n-envs", type=whole, default=1, metavar="N", help="episodes side by side, the next with the next seed (1)")
    add("--seed", type=whole, default=0, metavar="N", help="of the first episode (0); the next has the next one")
    actions = parser.add_mutually_exclusive_group()
    actions.add_argument("--deterministic", action="store_true", help="the mean of a policy's actions (the default)")
    actions.add_argument("--stochastic", action="store_true", help="a sample of them")
    add("--env-kwargs", nargs="+", metavar="K:V", help="keywords of the environment, such as noise:0")
    add("--size", default="", metavar="WxH", help="of one controller's panel, pixels")
    add("--speed", type=float, default=1.0, metavar="X", help="of time in film and window; 0.5 is slow motion (1)")
    add("--overwrite", action="store_true", help="replace files that are there")


def run(options: argparse.Namespace) -> int:
    """Fly, show, print how it went. Returns the exit code."""
    from rich.console import Console

    from sb3_quad.show.episodes import fly_all

    window = not (options.no_render or options.record or options.sequence)
    _check(options, window)
    size = _size(options.size)
    setting, controllers = _setting(options)
    how = options.seed, options.n_timesteps, not options.stochastic, options.n_envs
    with Console(file=sys.stderr).status("flying"):
        episodes = list(fly_all(controllers, setting, *how))
    _print_outcomes(episodes)
    if options.sequence:
        _write_sequence(options, episodes[0], size)
    if options.record:
        _write_film(Path(options.record), episodes, size or (PANEL if len(episodes[0]) > 1 else SINGLE), options.speed)
    if window:
        from sb3_quad.show.window import show_in_window

        show_in_window(episodes, *(size or SINGLE), options.speed)
    return 0


def known_environment(options: argparse.Namespace) -> str:
    """The environment that is asked for.

    :raises ConfigError: it is not of this package.
    """
    from sb3_quad.envs.registration import ENVIRONMENTS

    env_id = options.env or DEFAULT_ENV
    if env_id not in ENVIRONMENTS:
        raise ConfigError(unknown("environment", env_id, ENVIRONMENTS) + "; others are shown by rl_zoo3.enjoy")
    return str(env_id)


def chosen_agent(options: argparse.Namespace) -> Agent:
    """The agent of record-video's ``-i``, else of the run that ``--algo``, ``--env``, ``--exp-id`` and ``--load-…`` name.

    :raises ConfigError: there is no such run or agent.
    """
    from sb3_quad.settings.algorithms import get_algorithm
    from sb3_quad.settings.flight import FlightSettings
    from sb3_quad.show.agents import Agent, find_agent

    if options.trained_agent is not None:
        path = Path(options.trained_agent)
        return Agent(path.stem, path, FlightSettings())
    if not (Path(options.folder) / options.algo).is_dir():
        get_algorithm(options.algo)  # says so if there is none of that name
    return find_agent(options.folder, options.algo, known_environment(options), options.exp_id, options.which)


def _check(options: argparse.Namespace, window: bool) -> None:
    """What can be refused before anything is flown."""
    from sb3_quad.base.files import refuse_existing
    from sb3_quad.drawing.window import has_display
    from sb3_quad.show.video import check_video

    if not (options.controllers or options.algo or options.trained_agent):
        raise ConfigError("nobody to fly: name a controller, such as pid or agent.zip, or a run by --algo and --env")
    if sum(given is not None for given in (options.env, options.task, options.scenario)) > 1:
        raise ConfigError("--env, --task and --scenario each say what is flown; give one")
    if (options.at is not None or options.lasting is not None) and options.force is None and options.torque is None:
        raise ConfigError("--at and --for say when --force and --torque act; give one of these")
    if options.speed <= 0:
        raise ConfigError(f"--speed {options.speed:g}: must be above 0")
    if options.times is not None and not options.sequence:
        raise ConfigError("--times goes with --sequence")
    if options.times is not None and min(options.times) < 0:
        raise ConfigError("--times: must not be negative")
    if options.record:
        check_video(Path(options.record))
        refuse_existing(options.record, options.overwrite)
    if options.sequence:
        if Path(options.sequence).suffix.lower() != ".png":
            raise ConfigError(f"--sequence {options.sequence}: must end in .png")
        refuse_existing(options.sequence, options.overwrite)
    if window and not has_display():
        raise ConfigError("no display to open a window on (DISPLAY is not set); --record flight.mp4 makes a film instead")


def _setting(options: argparse.Namespace) -> tuple[Setting, dict[str, Any]]:
    """What is flown, and who flies, by label."""
    from sb3_quad.envs.registration import ENVIRONMENTS
    from sb3_quad.evaluation.controllers import build, parse_controllers
    from sb3_quad.experts.models import load_model
    from sb3_quad.settings.flight import FlightSettings
    from sb3_quad.show.episodes import Setting, make_wrench

    env_id = known_environment(options)
    given = pairs(options.env_kwargs, "--env-kwargs")
    agent = chosen_agent(options) if options.algo or options.trained_agent else None
    wrench = make_wrench(options.force, options.torque, options.at or 0.0, options.lasting)
    if options.scenario is not None:
        if given or options.target or wrench is not None:
            raise ConfigError("--scenario says all about a flight; leave --env-kwargs, --target, --force and --torque away")
        setting = Setting.of_scenario(options.scenario)
    else:
        named = {"task": options.task} if options.task else {}
        kept = agent.settings.given() if agent else {}
        settings = FlightSettings().with_changes(**{"task": ENVIRONMENTS[env_id], **kept, **named, **given})
        setting = Setting.fixed(settings, options.target, wrench)
    controllers: dict[str, Any] = {}
    if agent:
        print(f"agent: {agent.path}")
        controllers[agent.label] = load_model(agent.path)
    for spec in parse_controllers(options.controllers):
        controllers[spec.label] = build(spec, setting.settings.vehicle)
    return setting, controllers


def _write_sequence(options: argparse.Namespace, episode: Sequence[Recording], size: tuple[int, int] | None) -> None:
    from PIL import Image
    from rich.console import Console

    from sb3_quad.base.files import write_bytes
    from sb3_quad.show.sequence import sequence

    with Console(file=sys.stderr).status("drawing"):
        picture = sequence(episode, options.times, size)
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, format="png", optimize=True)
    write_bytes(options.sequence, buffer.getvalue())
    print(f"saved {options.sequence}")


def _write_film(path: Path, episodes: Sequence[Sequence[Recording]], size: tuple[int, int], speed: float) -> None:
    """Draw flights and write them as a film, with a progress bar; ``size`` of a panel, pixels."""
    from rich.console import Console
    from rich.progress import track

    from sb3_quad.show.film import FPS, film_frames, frame_times
    from sb3_quad.show.video import write_video

    total = sum(len(frame_times(episode, speed)) for episode in episodes)
    frames = (frame for episode in episodes for frame in film_frames(episode, *size, speed))
    write_video(path, track(frames, "drawing", total, console=Console(file=sys.stderr), transient=True), FPS)
    print(f"saved {path}, {total / FPS:.1f} s")


def _print_outcomes(episodes: Sequence[Sequence[Recording]]) -> None:
    for number, episode in enumerate(episodes, 1):
        for recording in episode:
            how = recording.lost or f"{recording.error[-1]:.3f} m from its target"
            head = f"episode {number}, {recording.name}" if len(episodes) > 1 else recording.name
            print(f"{head}: {how} after {recording.times[-1]:.2f} s, reward {recording.reward:.2f}")


def _size(text: str) -> tuple[int, int] | None:
    from sb3_quad.simulation.checks import check_size

    if not text:
        return None
    try:
        width, height = (int(part) for part in text.lower().split("x"))
    except ValueError:
        raise ConfigError(f"--size {text}: must be width and height in pixels, such as 640x480") from None
    check_size(width, height)
    return width, height
