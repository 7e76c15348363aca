"""``enjoy``: flights to look at, in a window, as a film or as poses in one picture."""

import argparse
import io
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from PIL import Image as Pillow
from rich.console import Console

from sb3_quad.base.arrays import Image
from sb3_quad.base.errors import ConfigError, unknown
from sb3_quad.base.files import refuse_existing, write_bytes
from sb3_quad.cli.arguments.enjoy import DEFAULT_ENV
from sb3_quad.cli.output import progress_bar
from sb3_quad.cli.parser import given
from sb3_quad.envs.registration import ENVIRONMENTS
from sb3_quad.envs.rendering.window import has_display
from sb3_quad.evaluation.controllers import ControllerSpec, build, parse_controllers
from sb3_quad.show.episodes import Recording, Setting, fixed_setting, fly_all, scenario_setting
from sb3_quad.show.film import FPS, check_film, film_frames, frame_times, show_in_window, write_film
from sb3_quad.show.sequence import sequence
from sb3_quad.simulation.checks import check_size
from sb3_quad.simulation.settings import FlightSettings
from sb3_quad.training.algorithms import get_algorithm
from sb3_quad.training.runs import find_run

SINGLE, PANEL = (640, 480), (480, 480)  # width and height of the only panel, and of one of several, pixels


def run(options: argparse.Namespace) -> int:
    """Fly, show, print how it went. Returns the exit code."""
    if options.output:
        vars(options)["sequence" if options.output.lower().endswith(".png") else "record"] = options.output
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
        _write_film(options, episodes, size or (PANEL if len(episodes[0]) > 1 else SINGLE))
    if window:
        show_in_window(episodes, *(size or SINGLE), options.speed)
    return 0


def known_environment(options: argparse.Namespace) -> str:
    """The environment that is asked for.

    :raises ConfigError: it is not of this package.
    """
    env_id = options.env or DEFAULT_ENV
    if env_id not in ENVIRONMENTS:
        raise ConfigError(unknown("environment", env_id, ENVIRONMENTS) + "; others are shown by rl_zoo3.enjoy")
    return str(env_id)


def chosen_agent(options: argparse.Namespace) -> ControllerSpec:
    """The agent of record-video's ``-i``, else of the run that ``--algo``, ``--env``, ``--exp-id`` and ``--load-…`` name.

    :raises ConfigError: no such run or file, settings that cannot be read, or a wrapper that flights to be shown lack.
    """
    if options.trained_agent is not None:
        return ControllerSpec(Path(options.trained_agent).stem, options.trained_agent)
    if not (Path(options.folder) / options.algo).is_dir():
        get_algorithm(options.algo)  # says so if there is none of that name
    run = find_run(options.folder, options.algo, known_environment(options), options.exp_id)
    if isinstance(options.which, int):
        path = run.checkpoint(options.which)
    elif options.which == "last checkpoint":
        path = run.latest_checkpoint()
    else:
        path = run.best_model if options.which == "best" else run.result
    if not path.is_file():
        zips = ", ".join(sorted(each.name for each in run.path.glob("*.zip")))
        raise ConfigError(f"{path}: no such file; the run holds {zips}")
    settings, _ = run.read_yaml()
    for key in ("env_wrapper", "vec_env_wrapper", "frame_stack", "normalize"):
        if settings.get(key):
            raise ConfigError(f"{run.path}: was trained with {key}, which enjoy does not put around the environment")
    return ControllerSpec(f"{options.algo} {path.name}", str(path))


def _check(options: argparse.Namespace, window: bool) -> None:
    """What can be refused before anything is flown."""
    if not (options.controllers or options.algo or options.trained_agent):
        raise ConfigError("nobody to fly: name a controller, such as pid or agent.zip, or a run by --algo and --env")
    if len(given(options, "env", "task", "scenario")) > 1:
        raise ConfigError("--env, --task and --scenario each say what is flown; give one")
    if (options.start is not None or options.duration is not None) and options.force is None and options.torque is None:
        raise ConfigError("--at and --for say when --force and --torque act; give one of these")
    FlightSettings().with_changes(**options.env_kwargs)  # says what does not fit
    if options.times is not None and not options.sequence:
        raise ConfigError("--times goes with --sequence")
    if options.times is not None and min(options.times) < 0:
        raise ConfigError("--times: must not be negative")
    if options.record:
        check_film(Path(options.record))
        refuse_existing(options.record, options.overwrite)
    if options.sequence:
        if Path(options.sequence).suffix.lower() != ".png":
            raise ConfigError(f"--sequence {options.sequence}: must end in .png")
        refuse_existing(options.sequence, options.overwrite)
    if window and not has_display():
        raise ConfigError("no display to open a window on (DISPLAY is not set); --record flight.mp4 makes a film instead")


def _setting(options: argparse.Namespace) -> tuple[Setting, dict[str, Any]]:
    """What is flown, and who flies, by label."""
    env_id = known_environment(options)
    chosen = [chosen_agent(options)] if options.algo or options.trained_agent else []
    specs = {spec.label: spec for spec in [*chosen, *parse_controllers(options.controllers)]}
    agents = [spec.own for spec in specs.values() if spec.own is not None]  # the first says how all are flown
    push = given(options, "force", "torque", "start", "duration")
    if options.scenario is not None:
        if options.env_kwargs or options.target or push:
            raise ConfigError("--scenario says all about a flight; leave --env-kwargs, --target, --force and --torque away")
        setting = scenario_setting(options.scenario, agents[0].vehicle if agents else None)
    else:
        kept = agents[0] if agents else FlightSettings(task=ENVIRONMENTS[env_id])
        task = options.task or (ENVIRONMENTS[env_id] if options.env and not options.algo else kept.task)
        changes = {"task": task} | ({} if task == kept.task else {"task_kwargs": None}) | options.env_kwargs
        setting = fixed_setting(kept.with_changes(**changes), options.target, push)
    for spec in chosen:
        print(f"agent: {spec.spec}")
    controllers = {label: build(spec, setting.vehicle) for label, spec in specs.items()}
    for line in filter(None, (spec.notice(setting.vehicle) for spec in specs.values())):
        print(f"warning: {line}", file=sys.stderr)
    own = {
        label: {name: value for name, value in spec.observed.items() if name not in options.env_kwargs}
        for label, spec in specs.items()
    }
    return setting._replace(own=own), controllers


def _write_sequence(options: argparse.Namespace, episode: Sequence[Recording], size: tuple[int, int] | None) -> None:
    with Console(file=sys.stderr).status("drawing"):
        picture = sequence(episode, options.times, size)
    buffer = io.BytesIO()
    Pillow.fromarray(picture).save(buffer, format="png", optimize=True)
    write_bytes(options.sequence, buffer.getvalue())
    print(f"saved {options.sequence}")


def _write_film(options: argparse.Namespace, episodes: Sequence[Sequence[Recording]], size: tuple[int, int]) -> None:
    """Draw flights and write them as a film, with a progress bar; ``size`` of a panel, pixels."""
    total = sum(len(frame_times(episode, options.speed)) for episode in episodes)

    def frames() -> Iterator[Image]:
        show(0, total, "frames")
        drawn = (frame for episode in episodes for frame in film_frames(episode, *size, options.speed))
        for number, frame in enumerate(drawn, 1):
            yield frame
            show(number, total, "frames")

    with progress_bar(options.progress) as show:
        write_film(Path(options.record), frames())
    print(f"saved {options.record}, {total / FPS:.1f} s")


def _print_outcomes(episodes: Sequence[Sequence[Recording]]) -> None:
    for number, episode in enumerate(episodes, 1):
        for recording in episode:
            how = recording.lost or f"{recording.state.distance[-1]:.3f} m from its target"
            head = f"episode {number}, {recording.name}" if len(episodes) > 1 else recording.name
            print(f"{head}: {how} after {recording.times[-1]:.2f} s, reward {recording.reward:.2f}")


def _size(text: str) -> tuple[int, int] | None:
    if not text:
        return None
    try:
        width, height = (int(part) for part in text.lower().split("x"))
    except ValueError:
        raise ConfigError(f"--size {text}: must be width and height in pixels, such as 640x480") from None
    check_size(width, height)
    return width, height
