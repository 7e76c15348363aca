"""``enjoy``: watch controllers fly, in a window, a film, or a sequence of poses in one picture."""

from __future__ import annotations

import argparse
import io
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_quad.cli.arguments import pairs, whole
from sb3_quad.errors import ConfigError, unknown

if TYPE_CHECKING:
    from sb3_quad.show.episodes import Setting
    from sb3_quad.show.recording import Recording

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
SINGLE, PANEL = (640, 480), (480, 480)  # width and height of the only panel, and of one of several, pixels
DEFAULT_ENV = "QuadTargetTracking-v0"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The flags of rl-zoo's ``enjoy.py``, with their meanings, and those of what is flown and how it is shown."""
    add = parser.add_argument
    add("controllers", nargs="*", metavar="CONTROLLER", help="who flies, beside the agent of --algo")
    add("--algo", help="algorithm of a trained agent, looked up in the log folder")
    add("--env", help=f"environment id ({DEFAULT_ENV})")
    add("-f", "--folder", "--log-folder", default="logs", metavar="DIR", help="where run folders are (logs)")
    add("--exp-id", type=int, default=0, metavar="N", help="number of the run; 0: the latest (0)")
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--load-best", action="store_true", help="the best agent of the evaluations")
    which.add_argument("--load-checkpoint", type=whole, metavar="N", help="the checkpoint after N transitions")
    which.add_argument("--load-last-checkpoint", action="store_true", help="the last checkpoint")
    add("-n", "--n-timesteps", type=whole, metavar="N", help="control steps, over as many episodes as they last (one episode)")
    add("--seed", type=whole, default=0, metavar="N", help="of the first episode (0); the next has the next one")
    actions = parser.add_mutually_exclusive_group()
    actions.add_argument("--deterministic", action="store_true", help="the mean of a policy's actions (so it is anyhow)")
    actions.add_argument("--stochastic", action="store_true", help="a sample of them")
    add("--no-render", action="store_true", help="only fly, and print how it went")
    add("--env-kwargs", nargs="+", metavar="K:V", help="keywords of the environment, such as noise:0")
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
    add("--size", default="", metavar="WxH", help="of one controller's panel, pixels")
    add("--speed", type=float, default=1.0, metavar="X", help="of time in film and window; 0.5 is slow motion (1)")
    add("--overwrite", action="store_true", help="replace files that are there")


def run(options: argparse.Namespace) -> int:
    """Fly, show, tell how it went. Returns the exit code."""
    from sb3_quad.show.episodes import fly_all

    window = not (options.no_render or options.record or options.sequence)
    _check(options, window)
    size = _size(options)
    setting, controllers = _setting(options)
    episodes = []
    with _status("flying"):
        for episode in fly_all(controllers, setting, options.seed, options.n_timesteps, not options.stochastic):
            episodes.append(episode)
    _tell(episodes)
    if options.sequence:
        _write_sequence(options, episodes[0], size)
    if options.record:
        _write_film(options, episodes, size)
    if window:
        _show(options, episodes, size)
    return 0


def _check(options: argparse.Namespace, window: bool) -> None:
    """What can be refused before anything is flown."""
    from sb3_quad.show.video import check_video
    from sb3_quad.training.files import refuse_existing

    if not options.controllers and not options.algo:
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
    if window:
        from sb3_quad.show.window import check_window

        check_window()


def _setting(options: argparse.Namespace) -> tuple[Setting, dict[str, Any]]:
    """What is flown, and who flies, by label."""
    from sb3_quad.envs.registration import ENVIRONMENTS
    from sb3_quad.evaluation.controllers import build, parse_controllers
    from sb3_quad.experts.models import load_model
    from sb3_quad.show.agents import find_agent
    from sb3_quad.show.episodes import Setting, make_wrench, scenario_setting
    from sb3_quad.training.algorithms import get_algorithm

    env_id = options.env or DEFAULT_ENV
    if env_id not in ENVIRONMENTS:
        raise ConfigError(unknown("environment", env_id, ENVIRONMENTS) + "; others are shown by rl_zoo3.enjoy")
    given = pairs(options.env_kwargs, "--env-kwargs")
    agents, kept = {}, {}
    if options.algo:
        if not (Path(options.folder) / options.algo).is_dir():
            get_algorithm(options.algo)  # says so if there is none of that name
        which: str | int = "best" if options.load_best else "last checkpoint" if options.load_last_checkpoint else "result"
        which = which if options.load_checkpoint is None else options.load_checkpoint
        agent = find_agent(options.folder, options.algo, env_id, options.exp_id, which)
        print(f"agent: {agent.path}")
        agents[agent.label] = load_model(agent.path)
        kept = {"task": ENVIRONMENTS[env_id], **agent.env_kwargs}
    wrench = make_wrench(options.force, options.torque, options.at or 0.0, options.lasting)
    if options.scenario is not None:
        if given or options.target or wrench is not None:
            raise ConfigError("--scenario says all about a flight; leave --env-kwargs, --target, --force and --torque away")
        setting = scenario_setting(options.scenario)
    else:
        kwargs = {"task": ENVIRONMENTS[env_id], **kept, **({"task": options.task} if options.task else {}), **given}
        setting = Setting.from_keywords(kwargs, options.target, wrench)
    for spec in parse_controllers(options.controllers):
        agents[spec.label] = build(spec, setting.known_vehicle)
    return setting, agents


def _tell(episodes: Sequence[Sequence[Recording]]) -> None:
    for number, episode in enumerate(episodes, 1):
        for recording in episode:
            how = recording.lost or f"{recording.error[-1]:.3f} m from its target"
            head = f"episode {number}, {recording.name}" if len(episodes) > 1 else recording.name
            print(f"{head}: {how} after {recording.times[-1]:.2f} s, reward {recording.reward:.2f}")


def _write_sequence(options: argparse.Namespace, episode: Sequence[Recording], size: tuple[int, int] | None) -> None:
    from PIL import Image

    from sb3_quad.show.sequence import sequence
    from sb3_quad.training.files import write_bytes

    with _status("drawing"):
        picture = sequence(episode, options.times, size)
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, format="png", optimize=True)
    write_bytes(options.sequence, buffer.getvalue())
    print(f"saved {options.sequence}")


def _write_film(options: argparse.Namespace, episodes: Sequence[Sequence[Recording]], size: tuple[int, int] | None) -> None:
    from sb3_quad.show.film import FPS, Film
    from sb3_quad.show.video import write_video

    width, height = size or (PANEL if len(episodes[0]) > 1 else SINGLE)
    films = [Film(episode, width, height, options.speed) for episode in episodes]
    total = sum(film.n_frames for film in films)
    frames = (frame for film in films for frame in film.frames())
    try:
        write_video(Path(options.record), _progress(frames, total), FPS)
    finally:
        for film in films:
            film.close()
    print(f"saved {options.record}, {total / FPS:.1f} s")


def _show(options: argparse.Namespace, episodes: Iterable[Sequence[Recording]], size: tuple[int, int] | None) -> None:
    from sb3_quad.show.window import Window

    window = Window(*(size or SINGLE))
    try:
        for episode in episodes:
            if not window.show(episode, options.speed):
                break
    finally:
        window.close()


def _size(options: argparse.Namespace) -> tuple[int, int] | None:
    """The size that is asked for."""
    from sb3_quad.envs.checks import check_size

    if not options.size:
        return None
    try:
        width, height = (int(part) for part in options.size.lower().split("x"))
    except ValueError:
        raise ConfigError(f"--size {options.size}: must be width and height in pixels, such as 640x480") from None
    check_size(width, height)
    return width, height


def _status(what: str) -> Any:
    from contextlib import nullcontext

    from rich.console import Console

    console = Console(file=sys.stderr)
    return console.status(what) if console.is_terminal else nullcontext()


def _progress(frames: Iterable[Any], total: int) -> Iterable[Any]:
    """The frames, with a progress bar on stderr if that is a terminal."""
    from rich.console import Console
    from rich.progress import track

    console = Console(file=sys.stderr)
    return track(frames, "drawing", total, console=console, transient=True) if console.is_terminal else frames
