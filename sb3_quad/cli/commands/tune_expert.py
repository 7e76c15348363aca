"""Find the geometric expert's gains for a vehicle; write its YAML with them and the resulting metrics.

examples:
  sb3-quad tune-expert                                   for ITM, into itm_tuned.yaml
  sb3-quad tune-expert --vehicle my.yaml -o tuned.yaml   for your own vehicle
  sb3-quad tune-expert -n 2000 --overwrite               continues the first search, up to 2000 gains in all
  sb3-quad train --algo dagger --expert geometric --env-kwargs vehicle:tuned.yaml

The first gains stay where those found are no better on fresh episodes.
Ctrl-C writes the best gains so far; the same command with --overwrite continues. Needs pip install '.[tune]' from a clone.
"""

import argparse
from pathlib import Path

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import refuse_existing, write_text
from sb3_quad.base.signals import StopSignals
from sb3_quad.cli.parser import Parser, add_common, natural, positive

FRESH_EPISODES, FRESH_SETS = 960, 4


def add_arguments(parser: Parser) -> None:
    add = parser.add_argument
    add("--vehicle", default="itm", metavar="V", help="name or YAML file (itm); the search starts from its gains, if any")
    add("-o", "--output", metavar="FILE", help="YAML file to write (VEHICLE_tuned.yaml)")
    add("-n", "--trials", type=positive, default=800, metavar="N", help="gains to try, including those in the journal (800)")
    add("--journal", metavar="FILE", help="file that keeps the search (OUTPUT, ending in .journal)")
    add("--starts", type=positive, default=40_000, metavar="N", help="recoveries; the hardest sixtieth is flown (40000)")
    add("--targets", type=positive, default=300, metavar="N", help="tracking episodes (300)")
    add("--seed", type=natural, default=0, help="seed of the search and its episodes (0)")
    add_common(parser, "overwrite", "progress")


def run(options: argparse.Namespace) -> int:
    """Search, measure on fresh episodes, write. Returns the exit code."""
    from sb3_quad.base.seeds import row_seeds, seed_for
    from sb3_quad.cli.output import console, progress_bar
    from sb3_quad.evaluation.expert_metrics import measure_expert
    from sb3_quad.evaluation.tables import text_table
    from sb3_quad.experts.geometric import GeometricExpert
    from sb3_quad.tuning.expert import ExpertSearch, fresh_cost, with_gains
    from sb3_quad.vehicles.vehicle import VEHICLES, load_vehicle

    vehicle, (text, _) = load_vehicle(options.vehicle), VEHICLES.text(options.vehicle)
    output = Path(options.output or f"{vehicle.name}_tuned.yaml")
    if output.suffix not in (".yaml", ".yml"):
        raise ConfigError(f"--output {output}: must end in .yaml or .yml")
    journal = Path(options.journal) if options.journal else output.with_suffix(".journal")
    refuse_existing(output, options.overwrite)
    search = ExpertSearch(vehicle, journal, options.seed, options.starts, options.targets)

    with StopSignals() as signals, progress_bar(options.progress) as show:
        show(search.trials_done, options.trials, "choosing the hardest starts")

        def should_continue(done: int, least: float) -> bool:
            show(done, options.trials, f"least cost {least:.3f}")
            return signals.received is None

        try:
            search.run(options.trials, should_continue)
        except OSError as error:  # Optuna's, which does not say which file
            raise ConfigError(f"journal {journal}: cannot be written ({error.strerror or error})") from error
    if signals.received is not None:
        print(f"{signals.name}: writing the best of {search.trials_done} so far")
    seeds = row_seeds(seed_for("expert", options.seed), FRESH_SETS)
    tried = search.first, search.best
    measured = [measure_expert(GeometricExpert(vehicle, each), vehicle, seeds, FRESH_EPISODES) for each in tried]
    chosen = 1 if fresh_cost(measured[1]) < fresh_cost(measured[0]) else 0
    write_text(output, with_gains(text, tried[chosen].model_copy(update={"measured": measured[chosen]})))

    rows = [
        ("state recovery: survival", *(f"{100 * each.recovery_survival:.2f} %" for each in measured)),
        ("target tracking: survival", *(f"{100 * each.tracking_survival:.2f} %" for each in measured)),
        ("target tracking: mean time to 0.1 m", *(f"{each.time_to_0_1_m:.3f} s" for each in measured)),
        ("target tracking: mean reward", *(f"{each.tracking_reward:.3f}" for each in measured)),
    ]
    console().print(text_table("on fresh episodes, true state", ("gains", "before", "best of the search"), rows))
    if not chosen:
        print("the search found nothing better on fresh episodes: the file keeps the gains that it began with")
    print(f"{search.trials_done} gains tried, least cost {search.study.best_value:.3f}; journal: {journal}")
    print(f"saved {output}")
    return signals.exit_code
