r"""Train many seeds and settings by Ray Tune, and compare all agents on the same
episodes.

examples:
  # list the runs of your sweep, then train them, one core each
  sb3-quad sweep my_sweep.yaml --dry-run
  sb3-quad sweep my_sweep.yaml
  # a sweep of the package, such as pid or nominal
  sb3-quad sweep pid
  # on a Ray cluster
  sb3-quad sweep my_sweep.yaml --address auto
  # continue after Ctrl-C or a crash
  sb3-quad sweep --resume logs/sweep/my_sweep_1 --trust

The new folder receives the run folders and results.csv. For the keys of the
file, see docs/sweeps.md. Needs Ray: pip install '.[ray]' from a clone.
"""

import shlex
from argparse import Namespace
from pathlib import Path

from pydantic import PositiveInt

from sb3_quad.cli.parser import SWITCH, TRUST, Flags

FLAGS: Flags = {
    "what": {
        "sweep SWEEP": ({"nargs": "?"}, "YAML file, or the name of a sweep of the package"),
        "--resume FOLDER": "continue the sweep in its folder, with --trust",
    },
    "--workers N": (PositiveInt, "number of parallel runs (as many as there are cores)"),
    "--address WHERE": (
        "Ray cluster: auto, host:port or ray://host:port (a new one on this machine)"
    ),
    "--dry-run": (SWITCH, "list the runs and train nothing"),
    "-f --log-folder DIR": (str, "logs", "the sweep goes to DIR/sweep/SWEEP_N (logs)"),
    **TRUST,
}


def run(options: Namespace) -> int:
    """Train and compare, or list the runs. Returns the exit code."""
    from sb3_quad.base.errors import ConfigError
    from sb3_quad.base.files import locked, refuse_links, write_text
    from sb3_quad.base.process import trusted
    from sb3_quad.cli.output import console
    from sb3_quad.training.runs import claim_folder
    from sb3_quad.training.sweep import (
        SWEEPS,
        checked_configurations,
        connect_ray,
        load_sweep,
        run_name,
        run_sweep,
    )
    from sb3_quad.training.sweep_results import write_results

    source = options.sweep
    if options.resume:
        source = Path(options.resume) / "sweep.yaml"
        # Ray Tune keeps its state as pickles.
        if not trusted():
            raise ConfigError(
                f"sweep folder {options.resume}: its files can run code; "
                "if the sweep is yours, add --trust"
            )
        refuse_links(source.parent)
    if source is None:
        raise ConfigError("sweep: give its YAML file, or --resume with its folder")
    sweep = load_sweep(source)
    names = [
        run_name(configuration, seed)
        for configuration in checked_configurations(sweep)
        for seed in sweep.seed
    ]
    if options.dry_run:
        print(*names, sep="\n")
        return 0
    with connect_ray(options.address):
        if options.resume:
            folder = source.parent
        else:
            # A new folder only once it is known that Ray starts.
            folder = claim_folder(Path(options.log_folder) / "sweep", Path(source).stem)
            write_text(folder / "sweep.yaml", SWEEPS.text(source)[0])
        with locked(folder, "sweep folder"):
            flights = run_sweep(folder, sweep, options.workers)
            if flights:
                console().print(write_results(folder, flights))
    print(f"{len(flights)} of {len(names)} runs finished, saved in {folder}")
    if len(flights) < len(names):
        print(f"to continue: sb3-quad sweep --resume {shlex.quote(str(folder))} --trust")
    return int(len(flights) < len(names))
