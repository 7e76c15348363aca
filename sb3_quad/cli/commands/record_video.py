"""``record-video``: a trained agent's flights as a film, in the folder of its run."""

import argparse
from pathlib import Path

from sb3_quad.base.errors import ConfigError
from sb3_quad.cli.commands import enjoy


def run(options: argparse.Namespace) -> int:
    """Fly, draw, write. Returns the exit code."""
    if (options.trained_agent is None) == (options.algo is None):
        raise ConfigError("whose flight? Give a run by --algo and --env, or an agent by -i; one of both")
    env_id, (_, agent, _) = enjoy.known_environment(options), enjoy.chosen_agent(options)
    folder = Path(options.output_folder) if options.output_folder else agent.parent / "videos"
    options.record = str(folder / f"{agent.stem}-{env_id}-seed-{options.seed}-{options.n_timesteps}-steps.mp4")
    return enjoy.run(options)
