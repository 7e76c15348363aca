"""``tune-expert``: gains of the geometric expert for a vehicle, into a copy of its YAML."""

import argparse
from pathlib import Path

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import refuse_existing, write_text
from sb3_quad.base.seeds import row_seeds, seed_for
from sb3_quad.base.signals import StopSignals
from sb3_quad.cli.output import console, progress_bar
from sb3_quad.evaluation.expert_metrics import measure_expert
from sb3_quad.evaluation.tables import text_table
from sb3_quad.experts.geometric import GeometricExpert
from sb3_quad.tuning.expert import ExpertSearch, with_gains
from sb3_quad.vehicles.vehicle import VEHICLES, load_vehicle

FRESH_EPISODES, FRESH_SETS = 960, 4


def run(options: argparse.Namespace) -> int:
    """Search, measure on fresh episodes, write. Returns the exit code."""
    vehicle, (text, _) = load_vehicle(options.vehicle), VEHICLES.text(options.vehicle)
    output = Path(options.output or f"{vehicle.name}_tuned.yaml")
    if output.suffix not in (".yaml", ".yml"):
        raise ConfigError(f"--output {output}: must end in .yaml or .yml")
    journal = Path(options.journal) if options.journal else output.with_suffix(".journal")
    refuse_existing(output, options.overwrite or journal.exists())
    search = ExpertSearch(vehicle, journal, options.seed, options.starts, options.targets)
    refuse_existing(output, options.overwrite or search.may_overwrite(output))

    with StopSignals() as signals, progress_bar(options.progress) as show:
        show(search.trials_done, options.trials, "choosing the hardest starts")

        def should_continue(done: int, least: float) -> bool:
            show(done, options.trials, f"least cost {least:.3f}")
            return signals.received is None

        search.run(options.trials, should_continue)
    if signals.received is not None:
        print(f"{signals.name}: writing the best of {search.trials_done} so far")
    seeds = row_seeds(seed_for("expert", options.seed), FRESH_SETS)
    measured, recoveries = measure_expert(GeometricExpert(vehicle, search.best), vehicle, seeds, FRESH_EPISODES)
    content = with_gains(text, search.best.model_copy(update={"measured": measured}))
    search.note_output(content.encode("utf-8"))
    write_text(output, content)

    heads = ("", "episodes", "success", "mean time to 0.1 m", "mean reward")
    recovery = (str(measured.recovery_episodes), f"{100 * measured.recovery_success:.2f} %", "", "")
    tracking = (str(measured.tracking_episodes), f"{100 * measured.tracking_success:.2f} %")
    times = (f"{measured.time_to_0_1_m:.2f} s", f"{measured.tracking_reward:.2f}")
    rows = [("state recovery", *recovery), ("target tracking", *tracking, *times)]
    console().print(text_table("on fresh episodes, true state", heads, rows))
    starts = []
    for start, (flown, lost) in recoveries.items():
        success = f"{100 * (1 - lost / flown):.2f} %" if flown else ""
        starts.append((start, str(flown), str(lost), success))
    console().print(text_table("state recovery, by how it starts", ("", "flown", "lost", "success"), starts))
    print(f"{search.trials_done} gains tried, least cost {search.study.best_value:.3f}; journal: {journal}")
    print(f"saved {output}")
    return signals.exit_code
