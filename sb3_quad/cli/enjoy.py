"""``enjoy``: watch controllers fly, in a window, a film, or a sequence of poses in one picture."""

from __future__ import annotations

import argparse
import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_quad.base.errors import ConfigError
from sb3_quad.cli.arguments import pairs, whole
from sb3_quad.cli.flights import (
    SINGLE,
    add_flight,
    agent_of_run,
    known_environment,
    make_size,
    status,
    tell,
    write_film,
)

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


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The flags of rl-zoo's ``enjoy.py``, with their meanings, and those of what is flown and how it is shown."""
    add = parser.add_argument
    add("controllers", nargs="*", metavar="CONTROLLER", help="who flies, beside the agent of --algo")
    add_flight(parser)
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


def run(options: argparse.Namespace) -> int:
    """Fly, show, tell how it went. Returns the exit code."""
    from sb3_quad.show.episodes import fly_all

    window = not (options.no_render or options.record or options.sequence)
    _check(options, window)
    size = make_size(options)
    setting, controllers = _setting(options)
    episodes = []
    with status("flying"):
        how = options.seed, options.n_timesteps, not options.stochastic, options.n_envs
        for episode in fly_all(controllers, setting, *how):
            episodes.append(episode)
    tell(episodes)
    if options.sequence:
        _write_sequence(options, episodes[0], size)
    if options.record:
        write_film(Path(options.record), episodes, size, options.speed)
    if window:
        _show(options, episodes, size)
    return 0


def _check(options: argparse.Namespace, window: bool) -> None:
    """What can be refused before anything is flown."""
    from sb3_quad.base.files import refuse_existing
    from sb3_quad.show.video import check_video

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
    from sb3_quad.show.episodes import Setting, make_wrench, scenario_setting

    env_id = known_environment(options)
    given = pairs(options.env_kwargs, "--env-kwargs")
    agents, kept = {}, {}
    if options.algo:
        agent = agent_of_run(options)
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


def _write_sequence(options: argparse.Namespace, episode: Sequence[Recording], size: tuple[int, int] | None) -> None:
    from PIL import Image

    from sb3_quad.base.files import write_bytes
    from sb3_quad.show.sequence import sequence

    with status("drawing"):
        picture = sequence(episode, options.times, size)
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, format="png", optimize=True)
    write_bytes(options.sequence, buffer.getvalue())
    print(f"saved {options.sequence}")


def _show(options: argparse.Namespace, episodes: Iterable[Sequence[Recording]], size: tuple[int, int] | None) -> None:
    from sb3_quad.show.window import Window

    window = Window(*(size or SINGLE))
    try:
        for episode in episodes:
            if not window.show(episode, options.speed):
                break
    finally:
        window.close()
