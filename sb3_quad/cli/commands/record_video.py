"""``record-video``: a trained agent's flights as a film, in the folder of its run."""

import argparse
from pathlib import Path

from sb3_quad.base.errors import ConfigError
from sb3_quad.cli.commands import enjoy
from sb3_quad.cli.output import output_file


def run(options: argparse.Namespace) -> int:
    """Fly, draw, write. Returns the exit code."""
    if (options.trained_agent is None) == (options.algo is None):
        raise ConfigError("whose flight? Give a run by --algo and --env, or an agent by -i; one of both")
    env_id, agent = enjoy.known_environment(options), Path(enjoy.chosen_agent(options).spec)
    name = f"{agent.stem}-{env_id}-seed-{options.seed}-{options.n_timesteps}-steps.mp4"
    options.record = str(output_file(options.output_folder or (agent.parent / "videos" if options.algo else None), name))
    return enjoy.run(options)
