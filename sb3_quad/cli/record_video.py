"""``record-video``: a trained agent's flights as a film, in the folder of its run."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from sb3_quad.base.errors import ConfigError
from sb3_quad.cli.arguments import pairs, whole
from sb3_quad.cli.flights import add_flight, agent_of_run, known_environment, make_size, status, tell, write_film
from sb3_quad.pretrained_policies import agent_path

HELP = "Record a trained agent as a film; as enjoy --record does, with the flags and folders of rl-zoo's record_video."
EXAMPLES = """examples:
  sb3-quad record-video --algo ppo_bc --env QuadStateRecovery-v0                   the latest run, into its folder videos/
  sb3-quad record-video --algo ppo_bc --env QuadStateRecovery-v0 --exp-id 2 --load-best -n 500 -o films
  sb3-quad record-video --algo dagger --env QuadTargetTracking-v0 --load-checkpoint 500000 --n-envs 4 --seed 3
  sb3-quad record-video --env QuadStateRecovery-v0 -i path/to/agent.zip --stochastic --size 320x240

Without --load-…, a run's agent is trimmed_model.zip, else best_model.zip, else <Env>.zip.
Films need pip install 'sb3_quad[video]'. Several controllers, scenarios and pushes: sb3-quad enjoy --record FILE.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The flags of rl-zoo's ``record_video.py``, with their meanings."""
    add = parser.add_argument
    add_flight(parser)
    agent = "an agent of any SB3 algorithm, or a name such as itm-recovery, instead of one of the log folder"
    add("-i", "--trained-agent", type=agent_path, metavar="ZIP", help=agent)
    add("-n", "--n-timesteps", type=whole, default=1000, metavar="N", help="control steps, over as many episodes (1000)")
    add("-o", "--output-folder", metavar="DIR", help="where the film goes (videos, beside the agent's zip)")


def run(options: argparse.Namespace) -> int:
    """Fly, draw, write. Returns the exit code."""
    from sb3_quad.base.files import refuse_existing
    from sb3_quad.envs.registration import ENVIRONMENTS
    from sb3_quad.experts.models import load_model
    from sb3_quad.show.episodes import Setting, fly_all
    from sb3_quad.show.video import check_video

    if (options.trained_agent is None) == (options.algo is None):
        raise ConfigError("whose flight? Give a run by --algo and --env, or an agent by -i; one of both")
    if options.speed <= 0:
        raise ConfigError(f"--speed {options.speed:g}: must be above 0")
    size, env_id = make_size(options), known_environment(options)
    kwargs: dict[str, Any] = {"task": ENVIRONMENTS[env_id]}
    if options.algo is not None:
        agent = agent_of_run(options)
        label, zip_file, kwargs = agent.label, agent.path, {**kwargs, **agent.env_kwargs}
    else:
        zip_file = Path(options.trained_agent)
        label = zip_file.stem
    folder = Path(options.output_folder) if options.output_folder else zip_file.parent / "videos"
    film = folder / f"{zip_file.stem}-{env_id}-seed-{options.seed}-{options.n_timesteps}-steps.mp4"
    check_video(film)
    refuse_existing(film, options.overwrite)
    setting = Setting.from_keywords({**kwargs, **pairs(options.env_kwargs, "--env-kwargs")})
    print(f"agent: {zip_file}")
    pilot = {label: load_model(zip_file)}
    with status("flying"):
        episodes = list(fly_all(pilot, setting, options.seed, options.n_timesteps, not options.stochastic, options.n_envs))
    tell(episodes)
    write_film(film, episodes, size, options.speed)
    return 0
