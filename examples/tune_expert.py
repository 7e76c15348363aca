"""Search for the geometric expert's gains for a vehicle, by CMA-ES (Hansen, through Optuna), on the
batched environment.

    pip install '.[tune]'                                                     # from a clone
    python examples/tune_expert.py my.yaml -o tuned.yaml -n 300
    sb3-quad train --algo dagger --expert geometric --env-kwargs vehicle:tuned.yaml

Gains are judged by recoveries first, then by the time after which they stay at targets 7 to 20 m
away, and by how many flights leave them again, on the same episodes each time. The file that is
written is the vehicle with the gains found, or with those that it began with where these are as
good on episodes that the search has not seen. Ctrl-C writes the best so far; the study is kept in
OUTPUT.journal, and the same command continues it.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import yaml
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend

from sb3_quad.base.seeds import row_seeds, seed_for
from sb3_quad.evaluation.flights import Flights, Hook, fly, fly_settings
from sb3_quad.experts.geometric import GeometricExpert
from sb3_quad.simulation.settings import FlightSettings
from sb3_quad.vehicles.gains import GAIN_NAMES, GeometricGains
from sb3_quad.vehicles.vehicle import Vehicle, load_vehicle

NEAR = 0.1  # m
CLOSE = 1.5  # m; the height above ground over which coming close to it loses its weight, by e
# Weights, in seconds of the way to a target: per share lost, per share that comes close to the
# ground, per share that leaves its target again, per reward of a recovery.
LOST, TOO_LOW, LEFT, RECOVERY_REWARD = 1500.0, 1000.0, 0.5, 0.25
WAYS = {"target_distance": 20.0, "nearest_target": 7.0}  # m
DESCENT, WAY, RECOVERY = 400, 800, 1000  # control steps flown of each kind
# Slow descents are for agents that imitate the expert imprecisely; the expert itself could do
# without, and is not asked.
SEARCHED = tuple(name for name in GAIN_NAMES if name != "descent_deceleration")
RANGE = 2.0  # each gain between its first value divided by this and multiplied by it


class Lowest(Hook):
    """The lowest height of each flight, m."""

    def on_start(self, state, vehicle) -> None:
        self.height = state.position[:, 2].copy()

    def after_step(self, step, state, actions, flying) -> None:
        self.height = np.minimum(self.height, np.where(flying, state.position[:, 2], 0.0))


class Objective:
    """The cost of gains, to be minimised; 1500 per share of recoveries lost, then seconds.

    Nearly all starts are recovered by any sensible gains and do not tell them apart: of ``starts``
    recoveries, the sixtieth on which the first gains come closest to the ground is flown, and the
    others taken as recovered.
    """

    def __init__(self, vehicle: Vehicle, starts: int, targets: int, seed: int) -> None:
        self.vehicle, self.starts = vehicle, starts
        begun = row_seeds(seed_for("search", seed), starts + max(targets // 2, 1))
        heights = self.fly(GeometricExpert(vehicle), "state_recovery", begun[:starts], DESCENT)[
            1
        ].height
        self.hardest = [begun[row] for row in np.sort(np.argsort(heights)[: max(starts // 60, 1)])]
        self.tracking, self.recovery = begun[:targets], begun[starts:]

    def __call__(self, gains: GeometricGains) -> float:
        expert = GeometricExpert(self.vehicle, gains)
        hard, lowest = self.fly(expert, "state_recovery", self.hardest, DESCENT)
        tracking, _ = self.fly(expert, "target_tracking", self.tracking, WAY)
        recovery, _ = self.fly(expert, "state_recovery", self.recovery, RECOVERY)
        # Recoveries that are not chosen for being hard find gains that lose other starts than the
        # hardest.
        lost = (~hard.survival).sum() / self.starts + (~recovery.survival).mean()
        low = (
            np.exp(-np.maximum(lowest.height, 0.0) / CLOSE).sum() / self.starts
        )  # tells near losses apart
        settling = np.nan_to_num(
            tracking.settling_time[NEAR], nan=2 * WAY * self.vehicle.control_step
        ).mean()
        left, reward = (
            (tracking.survival & (tracking.overshoot > NEAR)).mean(),
            recovery.reward.mean(),
        )
        return float(
            LOST * lost + TOO_LOW * low + settling + LEFT * left - RECOVERY_REWARD * reward
        )

    def fly(self, expert, task, seeds, steps):
        """The first episode of each seed, on the true state."""
        keywords = {
            "task": task,
            "task_kwargs": WAYS if task == "target_tracking" else None,
            "max_episode_steps": steps,
        }
        settings, lowest = FlightSettings(vehicle=self.vehicle, noise=0.0, **keywords), Lowest()
        return fly_settings(expert, settings, seeds, hooks=[lowest]), lowest


def with_values(gains: GeometricGains, values: dict[str, float]) -> GeometricGains:
    """The gains with some replaced, of four digits."""
    rounded = {name: float(f"{value:.4g}") for name, value in values.items()}
    return GeometricGains.model_validate({**gains.model_dump(exclude={"measured"}), **rounded})


def measure_expert(
    expert: Any, vehicle: Vehicle, seeds: Sequence[int], episodes: int = 960, time_limit: int = 1500
) -> dict[str, Any]:
    """Fly ``episodes`` recoveries per seed, and as many targets 10 m away with the first seed.

    A tracking flight that never comes, or never stays, within 0.1 m counts as ``time_limit``
    control steps.
    """
    keywords: dict[str, Any] = {"vehicle": vehicle, "noise": 0.0, "max_steps": time_limit}
    recovery = Flights.concatenate(
        [fly(expert, "state_recovery", episodes, seed, **keywords) for seed in seeds]
    )
    tracking = fly(expert, "target_tracking", episodes, seeds[0], **keywords)
    times, stays = (
        np.nan_to_num(each[NEAR], nan=time_limit * vehicle.control_step)
        for each in (tracking.time_to, tracking.settling_time)
    )
    return {
        "recovery_survival": round(float(recovery.survival.mean()), 5),
        "recovery_episodes": recovery.n,
        "tracking_survival": round(float(tracking.survival.mean()), 5),
        "tracking_episodes": tracking.n,
        "time_to_0_1_m": round(float(times.mean()), 3),  # mean time until 0.1 m from the target, s
        "settling_time": round(float(stays.mean()), 3),  # until it stays there, s
        "tracking_reward": round(float(tracking.reward.mean()), 3),  # mean (Eqs. 4.5-4.9)
        "observation_noise": 0.0,
        "seeds": [*seeds],
    }


def fresh_cost(metrics: dict[str, Any]) -> float:
    """What gains cost on fresh episodes, with the same weights, s."""
    lost = LOST * (1.0 - metrics["recovery_survival"])
    return lost + metrics["settling_time"]


def main() -> None:
    """Search, measure, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("vehicle", nargs="?", default="itm", help="name or YAML file (itm)")
    parser.add_argument("-o", "--output", type=Path, help="YAML file to write (VEHICLE_tuned.yaml)")
    parser.add_argument(
        "-n", "--trials", type=int, default=800, help="gains to try, earlier ones included (800)"
    )
    parser.add_argument(
        "--starts", type=int, default=40_000, help="recoveries to choose from (40000)"
    )
    parser.add_argument("--targets", type=int, default=300, help="tracking episodes (300)")
    parser.add_argument(
        "--episodes", type=int, default=960, help="fresh episodes at the end, of four sets (960)"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the search and its episodes (0)")
    options = parser.parse_args()

    vehicle = load_vehicle(options.vehicle)
    output = options.output or Path(f"{vehicle.name}_tuned.yaml")
    first = GeometricExpert(vehicle).gains
    start = {name: getattr(first, name) for name in SEARCHED}
    sampler = optuna.samplers.CmaEsSampler(x0=start, seed=options.seed, popsize=16)
    storage = JournalStorage(JournalFileBackend(str(output.with_suffix(".journal"))))
    name = (
        f"{vehicle.name}, seed {options.seed}, {options.starts} starts, {options.targets} targets"
    )
    study = optuna.create_study(
        study_name=name, storage=storage, sampler=sampler, load_if_exists=True
    )
    if not study.trials:
        study.enqueue_trial(start)
    objective = Objective(vehicle, options.starts, options.targets, options.seed)

    def cost(trial: optuna.Trial) -> float:
        values = {
            name: trial.suggest_float(name, x / RANGE, x * RANGE, log=True)
            for name, x in start.items()
        }
        return objective(with_values(first, values))

    try:
        study.optimize(
            cost, n_trials=max(options.trials - len(study.trials), 0), show_progress_bar=True
        )
    except KeyboardInterrupt:
        print("interrupted: writing the best so far")

    tried = [first, with_values(first, study.best_params)]
    seeds = row_seeds(seed_for("expert", options.seed), 4)
    measured = [
        measure_expert(GeometricExpert(vehicle, each), vehicle, seeds, options.episodes)
        for each in tried
    ]
    for word, metrics in zip(("before", "found"), measured, strict=True):
        print(f"{word}: {metrics!r}")
    best = 1 if fresh_cost(measured[1]) < fresh_cost(measured[0]) else 0
    print(
        ""
        if best
        else "the search found nothing better on fresh episodes: the file keeps the gains that it began with"
    )
    chosen = tried[best].model_copy(update={"measured": measured[best]})
    tuned = vehicle.model_copy(update={"geometric_gains": chosen})
    output.write_text(
        yaml.safe_dump(tuned.model_dump(mode="json", exclude_none=True), sort_keys=False)
    )
    print(f"{len(study.trials)} gains tried, least cost {study.best_value:.3f}; saved {output}")


if __name__ == "__main__":
    main()
