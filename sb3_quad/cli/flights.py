"""What ``enjoy`` and ``record-video`` share: whose flights are shown, and how they become a film."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_quad.base.errors import ConfigError, unknown
from sb3_quad.cli.arguments import whole

if TYPE_CHECKING:
    from sb3_quad.show.agents import Agent
    from sb3_quad.show.recording import Recording

SINGLE, PANEL = (640, 480), (480, 480)  # width and height of the only panel, and of one of several, pixels
DEFAULT_ENV = "QuadTargetTracking-v0"


def add_flight(parser: argparse.ArgumentParser) -> None:
    """The flags of rl-zoo's ``enjoy.py`` for an agent and its episodes, with their meanings, and those of a film."""
    add = parser.add_argument
    add("--algo", help="algorithm of a trained agent, looked up in the log folder")
    add("--env", help=f"environment id ({DEFAULT_ENV})")
    add("-f", "--folder", "--log-folder", default="logs", metavar="DIR", help="where run folders are (logs)")
    add("--exp-id", type=int, default=0, metavar="N", help="number of the run; 0: the latest (0)")
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--load-best", action="store_true", help="the best agent of the evaluations")
    which.add_argument("--load-checkpoint", type=whole, metavar="N", help="the checkpoint after N transitions")
    which.add_argument("--load-last-checkpoint", action="store_true", help="the last checkpoint")
    add("--n-envs", type=whole, default=1, metavar="N", help="episodes side by side, the next with the next seed (1)")
    add("--seed", type=whole, default=0, metavar="N", help="of the first episode (0); the next has the next one")
    actions = parser.add_mutually_exclusive_group()
    actions.add_argument("--deterministic", action="store_true", help="the mean of a policy's actions (so it is anyhow)")
    actions.add_argument("--stochastic", action="store_true", help="a sample of them")
    add("--env-kwargs", nargs="+", metavar="K:V", help="keywords of the environment, such as noise:0")
    add("--size", default="", metavar="WxH", help="of one controller's panel, pixels")
    add("--speed", type=float, default=1.0, metavar="X", help="of time in film and window; 0.5 is slow motion (1)")
    add("--overwrite", action="store_true", help="replace files that are there")


def known_environment(options: argparse.Namespace) -> str:
    """The environment that is asked for.

    :raises ConfigError: it is not of this package.
    """
    from sb3_quad.envs.registration import ENVIRONMENTS

    env_id = options.env or DEFAULT_ENV
    if env_id not in ENVIRONMENTS:
        raise ConfigError(unknown("environment", env_id, ENVIRONMENTS) + "; others are shown by rl_zoo3.enjoy")
    return str(env_id)


def agent_of_run(options: argparse.Namespace) -> Agent:
    """The agent of a run that ``--algo``, ``--env``, ``--exp-id`` and ``--load-…`` name.

    :raises ConfigError: there is no such run or agent.
    """
    from sb3_quad.settings.algorithms import get_algorithm
    from sb3_quad.show.agents import find_agent

    if not (Path(options.folder) / options.algo).is_dir():
        get_algorithm(options.algo)  # says so if there is none of that name
    which: str | int = "best" if options.load_best else "last checkpoint" if options.load_last_checkpoint else "result"
    which = which if options.load_checkpoint is None else options.load_checkpoint
    return find_agent(options.folder, options.algo, known_environment(options), options.exp_id, which)


def tell(episodes: Sequence[Sequence[Recording]]) -> None:
    """Print how each flight ended."""
    for number, episode in enumerate(episodes, 1):
        for recording in episode:
            how = recording.lost or f"{recording.error[-1]:.3f} m from its target"
            head = f"episode {number}, {recording.name}" if len(episodes) > 1 else recording.name
            print(f"{head}: {how} after {recording.times[-1]:.2f} s, reward {recording.reward:.2f}")


def write_film(path: Path, episodes: Sequence[Sequence[Recording]], size: tuple[int, int] | None, speed: float) -> None:
    """Draw flights and write them as a film, with a progress bar; say where it is.

    :param size: of a panel, pixels; None: 640 x 480 of one alone, 480 x 480 of several.
    """
    from sb3_quad.show.film import FPS, Film
    from sb3_quad.show.video import write_video

    width, height = size or (PANEL if len(episodes[0]) > 1 else SINGLE)
    films = [Film(episode, width, height, speed) for episode in episodes]
    total = sum(film.n_frames for film in films)
    frames = (frame for film in films for frame in film.frames())
    try:
        write_video(path, _progress(frames, total), FPS)
    finally:
        for film in films:
            film.close()
    print(f"saved {path}, {total / FPS:.1f} s")


def make_size(options: argparse.Namespace) -> tuple[int, int] | None:
    """The size that is asked for."""
    from sb3_quad.simulation.checks import check_size

    if not options.size:
        return None
    try:
        width, height = (int(part) for part in options.size.lower().split("x"))
    except ValueError:
        raise ConfigError(f"--size {options.size}: must be width and height in pixels, such as 640x480") from None
    check_size(width, height)
    return width, height


def status(what: str) -> Any:
    """A spinner on stderr, if that is a terminal."""
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
