"""Record a film of a trained agent, as enjoy -o does, with the flags and folders of rl-zoo's record_video.

examples:
  sb3-quad record-video --algo ppo_bc --env QuadStateRecovery-v0                   the latest run, into its folder videos/
  sb3-quad record-video --algo ppo_bc --env QuadStateRecovery-v0 --exp-id 2 --load-best -n 500 -o films
  sb3-quad record-video --algo dagger --env QuadTargetTracking-v0 --load-checkpoint 500000 --n-envs 4 --seed 3
  sb3-quad record-video --env QuadStateRecovery-v0 -i path/to/agent.zip --stochastic --size 320x240

Without --load-…, the agent of a run is trimmed_model.zip, else best_model.zip, else <Env>.zip.
Films need: pip install '.[video]' from a clone. Several controllers, scenarios and pushes: sb3-quad enjoy -o FILE.
"""

import argparse
from pathlib import Path

from sb3_quad.base.errors import ConfigError
from sb3_quad.cli.commands import enjoy
from sb3_quad.cli.parser import Parser, positive
from sb3_quad.controllers.pretrained import agent_path

ONLY_ENJOY = ("task", "scenario", "target", "force", "torque", "start", "duration")


def add_arguments(parser: Parser) -> None:
    """Add the flags of rl-zoo's ``record_video.py``, with their meanings."""
    enjoy.add_flight_arguments(parser)
    add = parser.add_argument
    which = "an agent of any SB3 algorithm: a zip, a run folder or a name such as itm-recovery, instead of --algo"
    add("-i", "--trained-agent", type=agent_path, metavar="ZIP", help=which)
    add("-n", "--n-timesteps", type=positive, default=1000, metavar="N", help="control steps, over as many episodes (1000)")
    add("-o", "--output-folder", metavar="PATH", help="file or folder for the film (videos in the run folder; of -i: here)")
    parser.set_defaults(**dict.fromkeys(ONLY_ENJOY), controllers=[], no_render=False)


def run(options: argparse.Namespace) -> int:
    """Fly, draw, write. Returns the exit code."""
    from sb3_quad.cli.output import output_file

    if (options.trained_agent is None) == (options.algo is None):
        raise ConfigError("whose flight? Give a run by --algo and --env, or an agent by -i; one of both")
    env_id, path = enjoy.known_environment(options), Path(enjoy.chosen_agent(options)[1])
    name = f"{path.stem}-{env_id}-seed-{options.seed}-{options.n_timesteps}-steps.mp4"
    options.output = [str(output_file(options.output_folder or (path.parent / "videos" if options.algo else None), name))]
    return enjoy.run(options)
